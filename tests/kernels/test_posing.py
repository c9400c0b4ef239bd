"""Posing in one launch: against float64 twins of its parts, and the network's output against its definition."""

from __future__ import annotations

import pytest
import torch
from torch.nn.functional import normalize

from reference.finishing import finish
from reference.skinning import skin
from scgs_warp.ops import correctives, shading, skinning
from scgs_warp.ops.activations import exponential, sigmoid
from scgs_warp.ops.posing import pose_gaussians, unit_pose
from scgs_warp.types import Pose

HEADS = {
    "control points": {"rotations": 4, "translations": 3},
    "tints": {"rotations": 4, "translations": 3, "tints": 3},
    "official": {"rotations": 4, "translations": 3, "shape_rotations": 4, "log_scales": 3},
    "another order": {"tints": 3, "translations": 3, "rotations": 4},
}


def motion_of(heads: dict[str, int], nodes: int, device: str) -> torch.Tensor:
    return torch.randn(nodes, sum(heads.values()), generator=torch.Generator().manual_seed(3)).to(device)


@pytest.mark.parametrize("heads", HEADS.values(), ids=HEADS)
@pytest.mark.parametrize("nodes", [0, 1, 300])
def test_the_networks_output_becomes_a_pose(heads, nodes, device):
    motion = motion_of(heads, nodes, device)
    pose = unit_pose(motion, heads)
    parts = dict(zip(heads, motion.double().split(list(heads.values()), dim=1)))
    for name in ("rotations", "shape_rotations"):
        if name in parts:
            parts[name] = normalize(parts[name] + torch.tensor([1.0, 0.0, 0.0, 0.0], device=device), dim=1)
    for name, value in vars(pose).items():
        assert (value is None) == (name not in heads)
        if value is not None:
            torch.testing.assert_close(value.double(), parts[name], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("heads", HEADS.values(), ids=HEADS)
@pytest.mark.parametrize("used", [None, *range(4)], ids=["all", "translations", "rotations", "shapes", "extras"])
def test_gradients_of_a_pose_reach_the_networks_output(heads, used, device):
    fields = [field for field in ("translations", "rotations", "shape_rotations", "log_scales", "tints")]
    fields = fields if used is None else [fields[used], *fields[used + 1 : used + 2] * (used == 3)]
    fields = [field for field in fields if field in heads]
    mix = {field: torch.randn(60, heads[field], generator=torch.Generator().manual_seed(4)) for field in fields}
    if not fields:
        pytest.skip("the network has no such head")
    motion = motion_of(heads, 60, device).requires_grad_()
    pose = unit_pose(motion, heads)
    sum((getattr(pose, field) * mix[field].to(device)).sum() for field in fields).backward()
    exact = motion.detach().cpu().double().requires_grad_()
    parts = dict(zip(heads, exact.split(list(heads.values()), dim=1)))
    for name in ("rotations", "shape_rotations"):
        if name in parts:
            parts[name] = normalize(parts[name] + torch.tensor([1.0, 0.0, 0.0, 0.0]), dim=1)
    sum((parts[field] * mix[field].double()).sum() for field in fields).backward()
    torch.testing.assert_close(motion.grad.cpu().double(), exact.grad, rtol=1e-5, atol=1e-5)


def test_a_rotation_that_vanishes_has_no_gradient(device):
    motion = torch.tensor([[-1.0, 0, 0, 0, 0, 0, 0], [0.5, 0, 0, 1, 0, 0, 0]], device=device, requires_grad=True)
    unit_pose(motion, HEADS["control points"]).rotations[:, 3].sum().backward()
    assert motion.grad is not None
    assert motion.grad[0].tolist() == [0.0] * 7
    assert motion.grad[1, 3] > 0


def test_a_rotation_that_vanishes_is_the_identity(device):
    motion = torch.zeros(2, 7, device=device)
    motion[0, 0] = -1.0
    assert unit_pose(motion, HEADS["control points"]).rotations.tolist() == [[1.0, 0.0, 0.0, 0.0]] * 2


@pytest.mark.parametrize("columns, heads", [
    (4, {"rotations": 4, "translations": 3}),
    (12, {"rotations": 4, "translations": 3}),
    (8, {"rotations": 4, "translations": 4}),
    (9, {"rotations": 4, "translations": 3, "colors": 2}),
])  # fmt: skip
def test_output_of_other_heads_is_refused(columns, heads, device):
    with pytest.raises(ValueError, match=r"motion must be|heads: "):
        unit_pose(torch.zeros(3, columns, device=device), heads)


def rest_of(count: int, corrected: bool, shaded: bool) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(5)
    widths = (3, 4, 3, 1, 3, 27 * corrected, 10 * shaded)
    values = [torch.randn(count, width, generator=g) for width in widths]
    return [*values[:3], values[3][:, 0], *values[4:]]


def binding_of(count: int, nodes: int, k: int) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(6)
    indices = torch.randint(nodes, (count, k), generator=g, dtype=torch.int32)
    return indices, torch.rand(count, k, generator=g).softmax(dim=1)


def twin(rest, nodes: torch.Tensor, pose: Pose, indices, weights, own=None) -> tuple[torch.Tensor, ...]:
    """Pose in float64 by the twins of the parts."""
    moved, turned, extras = skin(rest[0], rest[1], nodes, pose, indices, weights)
    log_scales, tints = (extras, None) if pose.tints is None else (None, extras)
    means, *others = finish(moved, turned, tuple(rest), log_scales, tints, own)
    return means, turned, *others


def forms(device: str) -> list[str]:
    return ["plain", "cpu"] if device == "cpu" else ["plain"]


@pytest.mark.parametrize("edited", [False, True])
@pytest.mark.parametrize(("corrected", "shaded"), [(False, False), (True, False), (False, True), (True, True)])
@pytest.mark.parametrize("heads", HEADS.values(), ids=HEADS)
@pytest.mark.parametrize(("count", "k"), [(1, 1), (257, 4), (40, 5)])
def test_gaussians_are_those_of_the_parts(count, k, heads, corrected, shaded, edited, device):
    rest, nodes = rest_of(count, corrected, shaded), torch.randn(20, 3, generator=torch.Generator().manual_seed(7))
    pose = unit_pose(0.7 * motion_of(heads, 20, "cpu"), heads)
    binding = binding_of(count, 20, k)
    own = torch.randn(count, 4, generator=torch.Generator().manual_seed(8)) if edited else None
    exact = Pose(**{name: None if value is None else value.double() for name, value in vars(pose).items()})
    expected = twin(
        [x.double() for x in rest],
        nodes.double(),
        exact,
        binding[0],
        binding[1].double(),
        None if own is None else own.double(),
    )
    there = Pose(**{name: None if value is None else value.to(device) for name, value in vars(pose).items()})
    on_device = tuple(x.to(device) for x in rest), nodes.to(device), there, *(x.to(device) for x in binding)
    for form in forms(device):
        found = pose_gaussians(*on_device, None if own is None else own.to(device), form=form)
        for name, a, b in zip(("means", "quats", "scales", "opacities", "sh_dc"), found, expected, strict=True):
            assert a.device.type == device
            where = f"{form}, {name}"
            torch.testing.assert_close(
                a.cpu().double(), b, rtol=1e-4, atol=2e-5, msg=lambda m, where=where: f"{where}: {m}"
            )


def test_nothing_is_posed_by_what_is_not_finite(device):
    """A broken Gaussian stays one: its neighbours in the same vector do not change."""
    heads = HEADS["tints"]
    rest, nodes = rest_of(35, True, True), torch.randn(20, 3, generator=torch.Generator().manual_seed(7)).to(device)
    rest, binding = [x.to(device) for x in rest], [x.to(device) for x in binding_of(35, 20, 4)]
    pose = unit_pose(0.7 * motion_of(heads, 20, device), heads)
    sound = pose_gaussians(tuple(rest), nodes, pose, *binding)
    broken = [x.clone() for x in rest]
    for number, value in enumerate(broken):
        value[17 + number % 3] = float("nan") if number % 2 else float("inf")
    others = torch.tensor([i for i in range(35) if not 17 <= i <= 19], device=device)
    for form in forms(device):
        for a, b in zip(pose_gaussians(tuple(broken), nodes, pose, *binding, form=form), sound, strict=True):
            torch.testing.assert_close(a[others], b[others], rtol=1e-4, atol=2e-5)


@pytest.mark.parametrize("edited", [False, True])
@pytest.mark.parametrize("heads", HEADS.values(), ids=HEADS)
@pytest.mark.parametrize("turns", [0.05, 0.7], ids=["aligned", "large"])
@pytest.mark.parametrize(("count", "k"), [(257, 4), (33, 1), (15, 5)])
@torch.no_grad()
def test_one_pass_has_the_bits_of_its_parts(count, k, turns, heads, edited):
    """Frames are drawn in one pass, training steps in parts: what is trained is what is shown."""
    rest, nodes = rest_of(count, True, True), torch.randn(20, 3, generator=torch.Generator().manual_seed(7))
    pose, binding = unit_pose(turns * motion_of(heads, 20, "cpu"), heads), binding_of(count, 20, k)
    own = torch.randn(count, 4, generator=torch.Generator().manual_seed(8)) if edited else None
    means, quats, log_scales, logits, sh_dc, matrices, gains = rest
    moved, turned, extras = skinning.skin(means, quats, nodes, pose, *binding)
    moved = correctives.correct(moved, matrices, quats, turned, own)
    if pose.log_scales is not None:
        log_scales = log_scales + extras
    if pose.tints is not None:
        sh_dc = shading.tint(sh_dc, extras)
    sh_dc = shading.shade(sh_dc, gains, quats, turned if own is None else own)
    parts = moved, turned, exponential(log_scales), sigmoid(logits), sh_dc
    found = pose_gaussians(tuple(rest), nodes, pose, *binding, own)
    assert all(torch.equal(a, b) for a, b in zip(found, parts, strict=True))


def test_what_does_not_fit_is_refused(device):
    heads = HEADS["tints"]
    rest = tuple(x.to(device) for x in rest_of(20, True, True))
    nodes, pose = torch.zeros(8, 3, device=device), unit_pose(motion_of(heads, 8, device), heads)
    indices, weights = (x.to(device) for x in binding_of(20, 8, 4))
    both = Pose(pose.translations, pose.rotations, log_scales=pose.tints, tints=pose.tints)
    refused = [
        ("pose.translations must be", (rest, torch.zeros(9, 3, device=device), pose, indices, weights)),
        ("weights must be", (rest, nodes, pose, indices, weights[:, :2])),
        ("not both", (rest, nodes, both, indices, weights)),
        ("quats_own must be", (rest, nodes, pose, indices, weights, rest[1][:5])),
    ]
    for number, name in ((2, "log_scales"), (3, "opacity_logits"), (4, "sh_dc"), (5, "correctives"), (6, "shading")):
        short = [x[:-1] if i == number else x for i, x in enumerate(rest)]
        refused.append((f"{name} must be", (tuple(short), nodes, pose, indices, weights)))
    for text, arguments in refused:
        with pytest.raises(ValueError, match=text):
            pose_gaussians(*arguments)


def test_the_cpus_form_takes_16_neighbours():
    heads = HEADS["control points"]
    pose, rest = unit_pose(motion_of(heads, 20, "cpu"), heads), tuple(rest_of(3, True, True))
    binding = binding_of(3, 20, 17)
    with pytest.raises(ValueError, match="up to 16 neighbours, got 17"):
        pose_gaussians(rest, torch.zeros(20, 3), pose, *binding, form="cpu")
    assert len(pose_gaussians(rest, torch.zeros(20, 3), pose, *binding)[0]) == 3


def test_nothing_to_pose(device):
    heads = HEADS["tints"]
    rest = tuple(x.to(device) for x in rest_of(0, True, True))
    binding = (x.to(device) for x in binding_of(0, 5, 3))
    found = pose_gaussians(
        rest, torch.zeros(5, 3, device=device), unit_pose(motion_of(heads, 5, device), heads), *binding
    )
    assert [len(value) for value in found] == [0] * 5
