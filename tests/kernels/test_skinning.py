"""Skinning against rotation matrices in float64, and the laws every pose obeys."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch.nn.functional import normalize

from reference import neighbors as neighbors_twin
from reference import skinning as twin
from reference.neighbors import nearest
from scgs_warp.ops import skinning as ops
from scgs_warp.ops.neighbors import node_lists
from scgs_warp.ops.skinning import skin, skin_rbf
from scgs_warp.runtime import environment
from scgs_warp.types import Pose

FIELDS = ("translations", "rotations", "shape_rotations", "log_scales")


def inputs(seed: int, n: int, m: int, k: int, *, shape: bool = False, scales: bool = False, near: bool = False):
    """[means, quats, nodes, weights, pose fields ...] and indices; quaternions are far from unit, on purpose. ``near``:
    no control point turns by 90 degrees, as in most scenes; the SIMD kernels have a shorter way then."""
    generator = torch.Generator().manual_seed(seed)

    def randn(*size):
        return torch.randn(*size, generator=generator)

    means, nodes = randn(n, 3), randn(m, 3)
    indices = nearest(means, nodes, k)[0].int()
    weights = torch.softmax(randn(n, k), 1)
    fields = [0.3 * randn(m, 3), randn(m, 4), randn(m, 4) if shape else None, randn(m, 3) if scales else None]
    if near:
        identity = torch.tensor([1.0, 0.0, 0.0, 0.0])
        fields[1:3] = [None if x is None else 3 * identity + (x / x.norm(dim=1, keepdim=True)) for x in fields[1:3]]
    return [means, 2 * randn(n, 4), nodes, weights, *fields], indices


def run(function, tensors, indices, seed=7, **options):
    """Outputs and gradients of a random weighting of them."""
    leaves = [None if t is None else t.detach().clone().requires_grad_() for t in tensors]
    means, quats, nodes, weights, *fields = leaves
    outputs = [o for o in function(means, quats, nodes, Pose(*fields), indices, weights, **options) if o is not None]
    generator = torch.Generator().manual_seed(seed)
    v = [torch.randn(o.shape, generator=generator).to(o) for o in outputs]
    torch.autograd.backward(outputs, v)
    return [o.detach() for o in outputs], [leaf.grad for leaf in leaves if leaf is not None]


def to(tensors, *args):
    return [None if t is None else t.to(*args) for t in tensors]


def assert_gradients(actual, expected):
    assert len(actual) == len(expected)
    for i, (a, e) in enumerate(zip(actual, expected)):
        message = f"gradient {i}"
        scale = float(e.abs().max()) if e.numel() else 0.0
        torch.testing.assert_close(
            a.cpu().double(), e, rtol=2e-4, atol=2e-5 * scale + 1e-9, msg=lambda s, m=message: f"{m}: {s}"
        )


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(("shape", "scales"), [(False, False), (True, False), (False, True), (True, True)])
@pytest.mark.parametrize(
    ("n", "m", "k"), [(333, 40, 4), (5001, 20, 3), (1, 1, 1), (50, 6, 6), (60, 30, 1), (47, 40, 8)]
)
def test_values_and_gradients(device, seed, n, m, k, shape, scales):
    tensors, indices = inputs(seed, n, m, k, shape=shape, scales=scales)
    outputs, grads = run(skin, to(tensors, device), indices.to(device))
    expected, expected_grads = run(twin.skin, to(tensors, torch.float64), indices)
    for a, e in zip(outputs, expected, strict=True):
        torch.testing.assert_close(a.cpu().double(), e, rtol=1e-5, atol=2e-5)
    assert_gradients(grads, expected_grads)
    if k > 1:
        assert all(float(e.abs().max()) > 1e-3 for e in expected_grads)


@pytest.mark.parametrize(
    "options", [{}, {"shape": True}, {"scales": True}, {"shape": True, "scales": True}, {"near": True, "shape": True}]
)
@pytest.mark.parametrize(
    ("n", "m", "k"), [(333, 40, 4), (64, 20, 3), (1, 1, 1), (15, 6, 4), (50, 6, 6), (47, 40, 16), (40, 30, 17)]
)
def test_values_without_gradients(device, n, m, k, options):
    """What renders: on a CPU another kernel."""
    tensors, indices = inputs(11, n, m, k, **options)
    means, quats, nodes, weights, *fields = to(tensors, device)
    with torch.no_grad():
        outputs = skin(means, quats, nodes, Pose(*fields), indices.to(device), weights)
    expected, _ = run(twin.skin, to(tensors, torch.float64), indices)
    assert (outputs[2] is None) == (fields[3] is None)
    for a, e in zip((o for o in outputs if o is not None), expected, strict=True):
        torch.testing.assert_close(a.cpu().double(), e, rtol=1e-5, atol=2e-5)


@torch.no_grad()
def test_poison_without_gradients(device):
    tensors, indices = inputs(4, 300, 20, 4, scales=True)
    means, quats, nodes, weights, *fields = to(tensors, device)
    assert means is not None and quats is not None and weights is not None
    rest = nodes, Pose(*fields), indices.to(device), weights
    clean = skin(means, quats, *rest)
    means, quats = means.clone(), quats.clone()
    means[7, 1], quats[40], quats[41] = float("nan"), float("inf"), 0.0
    good = [i for i in range(300) if i not in (7, 40, 41)]
    moved = skin(means, quats, *rest)
    assert all(a is not None and b is not None and torch.equal(a[good], b[good]) for a, b in zip(moved, clean))
    assert moved[1][41].isfinite().all()
    assert [o.shape[0] for o in skin(means[:0], quats[:0], *rest[:2], rest[2][:0], rest[3][:0]) if o is not None] == [
        0
    ] * 3


def test_nothing_to_skin(device):
    tensors, indices = inputs(0, 0, 5, 2, shape=True, scales=True)
    outputs, grads = run(skin, to(tensors, device), indices.to(device))
    assert [tuple(o.shape) for o in outputs] == [(0, 3), (0, 4), (0, 3)]
    assert all(g.isfinite().all() and not g.any() for g in grads)


def test_identity_pose_changes_nothing(device):
    tensors, indices = inputs(2, 200, 30, 4)
    means, quats, nodes, weights, *_ = to(tensors, device)
    rotations = torch.zeros(30, 4, device=device)
    rotations[:, 0] = torch.where(torch.arange(30, device=device) % 2 == 0, 1.0, -1.0)  # both signs are the identity
    pose = Pose(torch.zeros(30, 3, device=device), rotations)
    moved, turned, log_scales = skin(means, quats, nodes, pose, indices.to(device), weights)
    torch.testing.assert_close(moved, means, rtol=1e-6, atol=1e-6)
    cosine = (turned * normalize(quats, dim=1)).sum(1).abs()
    torch.testing.assert_close(cosine, torch.ones_like(cosine), rtol=0, atol=1e-6)
    assert log_scales is None


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_rigid_pose_moves_everything_rigidly(device, seed):
    tensors, indices = inputs(seed, 200, 30, 4)
    means, quats, nodes, weights, *_ = to(tensors, device)
    generator = torch.Generator().manual_seed(100 + seed)
    q, t = normalize(torch.randn(4, generator=generator), dim=0).to(device), torch.randn(3, generator=generator)
    R, t = twin.matrix(q), t.to(device)
    signs = torch.where(torch.rand(30, 1, generator=generator) < 0.5, -1.0, 1.0).to(device)
    pose = Pose(nodes @ R.T + t - nodes, 3.0 * signs * q)
    moved, turned, _ = skin(means, quats, nodes, pose, indices.to(device), weights)
    torch.testing.assert_close(moved, means @ R.T + t, rtol=1e-5, atol=1e-5)
    expected = R @ twin.matrix(normalize(quats, dim=1))
    torch.testing.assert_close(twin.matrix(turned), expected, rtol=1e-5, atol=1e-5)


def test_shape_rotations_leave_the_means_alone(device):
    tensors, indices = inputs(3, 100, 30, 4, shape=True)
    means, quats, nodes, weights, *fields = to(tensors, device)
    pose = Pose(*fields)
    plain = dataclasses.replace(pose, shape_rotations=None)
    with_shape = skin(means, quats, nodes, pose, indices.to(device), weights)
    without = skin(means, quats, nodes, plain, indices.to(device), weights)
    assert torch.equal(with_shape[0], without[0]) and not torch.equal(with_shape[1], without[1])


def test_poison_stays_where_it_is(device):
    tensors, indices = inputs(4, 300, 20, 4, shape=True, scales=True)
    clean_outputs, clean = run(skin, to(tensors, device), indices.to(device))
    tensors[0][7, 1], tensors[1][40] = float("nan"), float("inf")
    bad = [7, 40]
    good = [i for i in range(300) if i not in bad]
    outputs, grads = run(skin, to(tensors, device), indices.to(device))
    for a, b in zip(outputs, clean_outputs):
        assert torch.equal(a[good], b[good])
    assert all(g.isfinite().all() for g in grads)
    for a, b in zip(grads[:2], clean[:2]):
        assert torch.equal(a[good], b[good]) and not a[bad].any()


def test_vanishing_quaternions(device):
    tensors, indices = inputs(5, 50, 10, 2)
    tensors[1][3] = 0.0
    tensors[5][2] = 0.0
    outputs, grads = run(skin, to(tensors, device), indices.to(device))
    assert all(o.isfinite().all() for o in outputs) and all(g.isfinite().all() for g in grads)
    torch.testing.assert_close(outputs[1].norm(dim=1), torch.ones(50, device=device))


def test_node_gradients_by_lists_and_by_chunks():
    tensors, indices = inputs(6, 9000, 50, 4, shape=True, scales=True)
    by_chunks = run(skin, tensors, indices)[1]
    by_lists = run(skin, tensors, indices, lists=node_lists(indices, 50))[1]
    for a, b in zip(by_chunks, by_lists, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5 * float(b.abs().max()))


def test_same_bits_for_any_number_of_threads(all_threads):
    tensors, indices = inputs(8, 20_001, 512, 4, shape=True, scales=True)
    results = []
    for threads in (1, 2, 3):
        environment.configure(threads=threads)
        outputs, grads = run(skin, tensors, indices)
        results.append(outputs + grads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_shapes_that_do_not_fit():
    tensors, indices = inputs(0, 5, 3, 2)
    means, quats, nodes, weights, translations, rotations, *_ = tensors
    pose = Pose(translations, rotations)
    with pytest.raises(ValueError, match="weights"):
        skin(means, quats, nodes, pose, indices, weights[:, :1])
    with pytest.raises(ValueError, match=r"pose\.rotations"):
        skin(means, quats, nodes, Pose(translations, rotations[:, :3]), indices, weights)
    with pytest.raises(ValueError, match="indices"):
        skin(means, quats, nodes, pose, indices.long(), weights)
    with pytest.raises(ValueError, match=r"pose\.tints"):
        skin(means, quats, nodes, Pose(translations, rotations, tints=rotations), indices, weights)
    with pytest.raises(ValueError, match="log_scales or tints"):
        both = Pose(translations, rotations, log_scales=translations, tints=translations)
        skin(means, quats, nodes, both, indices, weights)


def test_tints_are_blended_as_log_scales(device):
    tensors, indices = inputs(4, 300, 12, 4, scales=True)
    tensors = [None if x is None else x.to(device).requires_grad_() for x in tensors]
    means, quats, nodes, weights, translations, rotations, shapes, values = tensors
    results = []
    for name in ("log_scales", "tints"):
        pose = Pose(translations, rotations, shapes, **{name: values})
        outputs = skin(means, quats, nodes, pose, indices.to(device), weights)
        leaves = means, quats, nodes, weights, translations, rotations, values
        results.append((*outputs, *torch.autograd.grad(sum((x * x).sum() for x in outputs), leaves)))
    assert results[0][2] is not None and results[0][-1].any()
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def fused_inputs(seed, n, m, k, *, shape=False, scales=False, strong=False, hyper=0, near=False):
    """The tensors of ``skin_rbf`` by name, and indices."""
    tensors, indices = inputs(seed, n, m, k, shape=shape, scales=scales, near=near)
    generator = torch.Generator().manual_seed(1000 + seed)
    names = "means", "quats", "nodes", None, *FIELDS
    named = {name: t for name, t in zip(names, tensors, strict=True) if name and t is not None}
    named["radii"] = 0.4 + torch.rand(m, generator=generator)
    if strong:
        named["strengths"] = 0.05 + torch.rand(m, generator=generator)
    if hyper:
        named["hyper_points"] = 0.3 * torch.randn(n, hyper, generator=generator)
        named["hyper_nodes"] = 0.3 * torch.randn(m, hyper, generator=generator)
    return named, indices


def fused_twin(means, quats, nodes, radii, pose, indices, strengths=None, hyper_points=None, hyper_nodes=None):
    points = means if hyper_points is None else torch.cat([means, hyper_points], 1)
    centers = nodes if hyper_nodes is None else torch.cat([nodes, hyper_nodes], 1)
    return twin.skin(
        means, quats, nodes, pose, indices, neighbors_twin.rbf_weights(points, centers, radii, indices, strengths)
    )


def run_fused(function, named, indices, seed=7):
    leaves = {name: tensor.detach().clone().requires_grad_() for name, tensor in named.items()}
    pose = Pose(**{name: leaves[name] for name in FIELDS if name in leaves})
    rest = {name: leaf for name, leaf in leaves.items() if name not in FIELDS}
    outputs = [o for o in function(**rest, pose=pose, indices=indices) if o is not None]
    generator = torch.Generator().manual_seed(seed)
    torch.autograd.backward(outputs, [torch.randn(o.shape, generator=generator).to(o) for o in outputs])
    return [o.detach() for o in outputs], {name: leaf.grad for name, leaf in leaves.items()}


@pytest.mark.parametrize(
    "options",
    [{}, {"shape": True}, {"scales": True}, {"strong": True}, {"hyper": 2},
     {"shape": True, "scales": True, "strong": True, "hyper": 8}, {"hyper": 9, "strong": True},
     {"near": True}, {"near": True, "shape": True, "scales": True, "hyper": 5}],
)  # fmt: skip
@pytest.mark.parametrize(
    ("n", "m", "k"), [(333, 40, 4), (5001, 20, 3), (1, 1, 1), (50, 6, 6), (60, 30, 1), (47, 40, 16)]
)
def test_weights_and_skinning_in_one_pass(device, n, m, k, options):
    named, indices = fused_inputs(3, n, m, k, **options)
    outputs, grads = run_fused(skin_rbf, {x: t.to(device) for x, t in named.items()}, indices.to(device))
    expected, expected_grads = run_fused(fused_twin, {x: t.double() for x, t in named.items()}, indices)
    for a, e in zip(outputs, expected, strict=True):
        torch.testing.assert_close(a.cpu().double(), e, rtol=1e-5, atol=2e-5)
    for name, e in expected_grads.items():
        scale = float(e.abs().max())
        torch.testing.assert_close(
            grads[name].cpu().double(), e, rtol=3e-4, atol=3e-5 * scale + 1e-6, msg=lambda s, n=name: f"{n}: {s}"
        )
        assert k == 1 or scale > 1e-3, name


@pytest.mark.parametrize("nodes", [512, 513, 515, 518])
def test_every_gaussian_counts_once_for_its_nodes(device, nodes):
    """However many nodes there are: a shift of all of them shifts every Gaussian by as much."""
    named, indices = fused_inputs(6, 5000, nodes, 3, scales=True)
    leaves = {name: tensor.to(device).requires_grad_() for name, tensor in named.items()}
    pose = Pose(**{name: leaves[name] for name in FIELDS if name in leaves})
    rest = {name: leaf for name, leaf in leaves.items() if name not in FIELDS}
    means, _, log_scales = skin_rbf(**rest, pose=pose, indices=indices.to(device))
    (means.sum() + log_scales.sum()).backward()
    for name in ("translations", "log_scales"):
        assert abs(float(leaves[name].grad.double().sum()) - 15_000.0) < 0.5


def test_rotations_on_one_side_take_a_shorter_way_to_the_same_bits(monkeypatch):
    near, indices = fused_inputs(5, 3000, 64, 4, scales=True, near=True)
    far = fused_inputs(5, 3000, 64, 4)[0]
    results = []
    for limit in (ops.SAME_SIDE, 2.0):
        monkeypatch.setattr(ops, "SAME_SIDE", limit)
        pose = tuple(near.get(name) for name in FIELDS)
        assert ops.pack_palette(near["nodes"], pose).aligned == (limit < 1.0)
        assert not ops.pack_palette(far["nodes"], tuple(far.get(name) for name in FIELDS)).aligned
        outputs, grads = run_fused(skin_rbf, near, indices)
        results.append([*outputs, *grads.values()])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_one_pass_of_nothing_and_of_shapes_that_do_not_fit(device):
    named, indices = fused_inputs(0, 0, 5, 2, scales=True, strong=True, hyper=2)
    outputs, grads = run_fused(skin_rbf, {x: t.to(device) for x, t in named.items()}, indices.to(device))
    assert [tuple(o.shape) for o in outputs] == [(0, 3), (0, 4), (0, 3)]
    assert all(not g.any() for g in grads.values())
    for bad in ("radii", "strengths", "hyper_nodes"):
        with pytest.raises(ValueError, match=bad):
            run_fused(skin_rbf, {**named, bad: named[bad][1:]}, indices)


def test_poison_in_one_pass(device):
    named, indices = fused_inputs(4, 300, 20, 4, shape=True, scales=True, strong=True, hyper=2)
    clean_outputs, _ = run_fused(skin_rbf, {x: t.to(device) for x, t in named.items()}, indices.to(device))
    named["means"][7, 1], named["quats"][40], named["means"][41] = float("nan"), float("inf"), 1e30
    named["radii"][3], named["quats"][50] = 1e-30, 0.0
    outputs, grads = run_fused(skin_rbf, {x: t.to(device) for x, t in named.items()}, indices.to(device))
    good = [i for i in range(300) if i not in (7, 40, 41, 50) and 3 not in indices[i].tolist()]
    for a, b in zip(outputs, clean_outputs, strict=True):
        assert torch.equal(a[good], b[good])
    for name, grad in grads.items():
        assert grad.isfinite().all(), name
    assert not grads["means"][[7, 40]].any() and not grads["quats"][[7, 40, 50]].any()


def test_one_pass_gives_the_same_bits_for_any_number_of_threads(all_threads):
    named, indices = fused_inputs(8, 20_001, 512, 4, scales=True, strong=True)
    means, quats, nodes, weights, *fields = inputs(8, 20_001, 512, 4, scales=True)[0]
    results = []
    for threads in (1, 2, 3):
        environment.configure(threads=threads)
        outputs, grads = run_fused(skin_rbf, named, indices)
        with torch.no_grad():
            stored = skin(means, quats, nodes, Pose(*fields), indices, weights)
        results.append([*outputs, *grads.values(), *(o for o in stored if o is not None)])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))
