"""What a scene of control points remembers between frames and between steps, and when it forgets it."""

from __future__ import annotations

import pytest
import torch

from helpers.tiny import tiny_config, trained_pose
from scgs_warp.benchmark import scenes
from scgs_warp.motion import ControlPoints
from scgs_warp.scene.scene import scene_from
from scgs_warp.types import Gaussians


@pytest.fixture
def scene(device):
    return scenes.synthetic_scene("control-points", 700, 40, device)


@pytest.fixture
def untinted(device):
    """A moving scene whose colours change by shading alone."""
    scene = scenes.synthetic_scene("control-points", 700, 40, device)
    with torch.no_grad():
        rows = head_rows(scene.motion, "tints")
        scene.motion.network.head.weight[rows] = 0.0
        scene.motion.network.head.bias[rows] = 0.0
    scene.motion.network.train(False)
    return scene


def head_rows(motion: ControlPoints, name: str) -> slice:
    """Return the rows of the network's last layer that a head takes."""
    heads = motion.network.heads
    first = sum(width for _, width in list(heads.items())[: list(heads).index(name)])
    return slice(first, first + heads[name])


def fresh(scene, time: float) -> Gaussians:
    """Posed without anything remembered."""
    motion = scene.motion
    with torch.no_grad():
        return motion.apply_pose(
            scene.gaussians, motion.poses(torch.tensor([time]))[0], motion.binding(scene.gaussians)
        )


def assert_same(actual: Gaussians, expected: Gaussians) -> None:
    for name, value in expected.tensors().items():
        assert torch.equal(getattr(actual, name), value), name


def test_a_frozen_scene_poses_as_one_that_remembers_nothing(scene):
    motion = scene.motion
    assert isinstance(motion, ControlPoints)
    frozen = [scene.gaussians_at(time) for time in (0.2, 0.7)]
    assert not torch.equal(frozen[0].means, frozen[1].means)
    for time, posed in zip((0.2, 0.7), frozen):
        assert_same(posed, fresh(scene, time))
    motion.cache_binding(None)
    posed = scene.gaussians_at(0.2)  # weights and skinning in one pass: the same up to rounding
    for name in ("means", "quats", "scales"):
        torch.testing.assert_close(getattr(posed, name), getattr(frozen[0], name), rtol=1e-5, atol=1e-5)


@torch.no_grad()
def test_what_is_edited_is_bound_anew(scene, monkeypatch):
    gaussians, motion = scene.gaussians, scene.motion

    def jump():
        gaussians.means[: len(gaussians) // 2] *= -1.0

    def replace():
        gaussians.means = torch.nn.Parameter(gaussians.means + 0.3)

    def overwrite():
        gaussians.means.data = gaussians.means.data.flip(0).clone()

    for edit in (jump, replace, overwrite, lambda: motion.log_radii.add_(1.0), lambda: motion.positions.add_(0.2)):
        before = scene.gaussians_at(0.4)
        edit()
        after = scene.gaussians_at(0.4)
        assert not torch.equal(before.means, after.means)
        assert_same(after, fresh(scene, 0.4))
    with monkeypatch.context() as patch:
        patch.setattr(motion, "binding", lambda _: pytest.fail("bound again without an edit"))
        scene.gaussians_at(0.9)


def test_edited_numbers_of_gaussians(scene):
    other = scenes.figure(300).to(scene.device)
    scene.gaussians_at(0.4)
    scene.gaussians = other
    assert_same(scene.gaussians_at(0.4), fresh(scene, 0.4))


def test_training_sees_the_neighbours_of_the_step(scene):
    """Neighbours follow Gaussians and control points as an optimiser moves them, and those of another set."""
    motion = scene.motion
    motion.cache_binding(None)
    generator = torch.Generator().manual_seed(0)
    for step in range(12):
        found = motion.neighbors(scene.gaussians)
        points = torch.cat([scene.gaussians.means, scene.gaussians.hyper], dim=1)
        distances = torch.cdist(points.double(), torch.cat([motion.positions, motion.hyper], dim=1).double())
        nearest = distances.gather(1, found.long())
        torch.testing.assert_close(
            nearest, distances.topk(found.shape[1], dim=1, largest=False)[0], rtol=1e-4, atol=1e-5
        )
        with torch.no_grad():
            for tensor in (scene.gaussians.means, motion.positions):
                tensor += (0.004 * step * torch.randn(tensor.shape, generator=generator)).to(tensor)
            if step == 6:
                scene.gaussians.means.data = scene.gaussians.means.data.flip(0).clone()


def test_shading_turns_with_the_surface_and_nothing_else_changes(untinted):
    scene = untinted
    gaussians, motion = scene.gaussians, scene.motion
    assert isinstance(motion, ControlPoints) and gaussians.shading.shape[1] == 10
    shaded = fresh(scene, 0.6)
    with torch.no_grad():
        gaussians.shading.zero_()
    plain = fresh(scene, 0.6)
    assert not torch.allclose(shaded.sh_dc, plain.sh_dc, atol=1e-3)
    torch.testing.assert_close(plain.sh_dc, gaussians.sh_dc, rtol=1e-5, atol=1e-5)
    for name in ("means", "quats", "scales", "opacities", "sh_rest"):
        assert torch.equal(getattr(shaded, name), getattr(plain, name)), name


def test_shading_learns_and_rotations_do_not_follow_brightness(untinted):
    gaussians, motion = untinted.gaussians, untinted.motion
    motion.cache_binding(None)
    posed = motion.gaussians_at(gaussians, 0.6)
    posed.sh_dc.sum().backward()
    assert gaussians.shading.grad is not None and (gaussians.shading.grad != 0).any()
    assert motion.network.head.weight.grad[head_rows(motion, "tints")].any()
    for name in ("translations", "rotations"):
        assert not motion.network.head.weight.grad[head_rows(motion, name)].any(), name
    assert gaussians.quats.grad is None or not gaussians.quats.grad.any()


def test_tints_change_colours_and_nothing_else(scene, untinted):
    tinted, plain = fresh(scene, 0.6), fresh(untinted, 0.6)
    for name in ("means", "quats", "scales", "opacities", "sh_rest"):
        assert torch.equal(getattr(tinted, name), getattr(plain, name)), name
    assert not torch.allclose(tinted.sh_dc, plain.sh_dc, atol=1e-2)
    pose = scene.motion.poses(torch.tensor([0.6]))[0]
    indices, weights = scene.motion.binding(scene.gaussians)
    blended = (weights[..., None] * pose.tints[indices.long()]).sum(1)
    grey = 0.5 / 0.28209479177387814
    expected = (plain.sh_dc + grey) * blended.clamp(-3.0, 1.0).exp() - grey
    torch.testing.assert_close(tinted.sh_dc, expected, rtol=1e-4, atol=1e-4)


def test_a_scene_from_before_tints_still_opens(scene):
    metadata = scene.metadata()
    del metadata["config"]["motion"]["tints"]
    tensors = {name: value.detach().clone() for name, value in scene.tensors().items()}
    rows = head_rows(scene.motion, "tints")
    assert rows.stop == len(tensors["motion.network.head.bias"])
    for name in ("weight", "bias"):
        tensors[f"motion.network.head.{name}"] = tensors[f"motion.network.head.{name}"][: rows.start].clone()
    opened = scene_from(tensors, metadata, str(scene.device), "old run")
    assert opened.motion.poses(torch.tensor([0.3]))[0].tints is None
    torch.testing.assert_close(opened.gaussians_at(0.3).means, scene.gaussians_at(0.3).means, rtol=1e-4, atol=1e-4)


def test_a_scene_from_before_shading_still_opens(untinted):
    """It lacks every newer field, too, and the tints' rows of the network's last layer."""
    scene = untinted
    later = ("gaussians.shading", "gaussians.correctives")
    tensors = {name: value.detach().clone() for name, value in scene.tensors().items() if name not in later}
    rows = head_rows(scene.motion, "tints")
    for name in ("weight", "bias"):
        tensors[f"motion.network.head.{name}"] = tensors[f"motion.network.head.{name}"][: rows.start].clone()
    metadata = scene.metadata()
    for name in ("shading", "tints", "correctives"):
        del metadata["config"]["motion"][name]
    opened = scene_from(tensors, metadata, str(scene.device), "old run")
    assert opened.gaussians.shading.shape == (len(scene.gaussians), 0)
    torch.testing.assert_close(opened.gaussians_at(0.3).sh_dc, scene.gaussians.sh_dc)


@pytest.fixture
def corrected(device):
    """A moving scene with correctives that differ from Gaussian to Gaussian."""
    scene = scenes.synthetic_scene("control-points", 700, 40, device)
    generator = torch.Generator().manual_seed(1)
    values = 0.2 * torch.randn(len(scene.gaussians), 27, generator=generator)
    scene.gaussians.correctives = torch.nn.Parameter(values.to(device))
    return scene


def test_correctives_move_means_and_nothing_else(corrected):
    gaussians = corrected.gaussians
    moved = fresh(corrected, 0.6)
    with torch.no_grad():
        gaussians.correctives.zero_()
    plain = fresh(corrected, 0.6)
    assert float((moved.means - plain.means).norm(dim=1).max()) > 1e-3
    for name in ("quats", "scales", "opacities", "sh_dc", "sh_rest"):
        assert torch.equal(getattr(moved, name), getattr(plain, name)), name


def test_correctives_learn_and_surfaces_do_not_turn_for_them(corrected):
    gaussians, motion = corrected.gaussians, corrected.motion
    motion.cache_binding(None)
    weights = torch.randn(len(gaussians), 3, generator=torch.Generator().manual_seed(2)).to(gaussians.means)
    (motion.gaussians_at(gaussians, 0.6).means * weights).sum().backward()
    with_correctives = {name: p.grad.clone() for name, p in motion.named_parameters() if p.grad is not None}
    assert gaussians.correctives.grad is not None and (gaussians.correctives.grad != 0).any()
    motion.zero_grad()
    with torch.no_grad():
        gaussians.correctives.zero_()
    (motion.gaussians_at(gaussians, 0.6).means * weights).sum().backward()
    for name, parameter in motion.named_parameters():
        if parameter.grad is not None:
            assert torch.equal(parameter.grad, with_correctives[name]), name


def test_a_scene_from_before_correctives_still_opens(scene):
    with torch.no_grad():
        scene.gaussians.correctives.zero_()
    names = ("gaussians.correctives",)
    tensors = {name: value.detach().clone() for name, value in scene.tensors().items() if name not in names}
    metadata = scene.metadata()
    del metadata["config"]["motion"]["correctives"], metadata["config"]["optim"]["correctives"]
    opened = scene_from(tensors, metadata, str(scene.device), "old run")
    assert opened.gaussians.correctives.shape == (len(scene.gaussians), 0)
    assert not opened.config.motion.correctives
    torch.testing.assert_close(opened.gaussians_at(0.3).means, scene.gaussians_at(0.3).means, rtol=1e-5, atol=1e-6)


def test_under_an_edit_learning_sees_what_is_drawn(scene):
    """Shading and correctives follow the trained motion, not the edit, with gradients and without."""
    gaussians, motion = scene.gaussians, scene.motion
    with torch.no_grad():
        own, edited = motion.poses(torch.tensor([0.2, 0.7]))
        binding = motion.binding(gaussians)
        drawn = motion.apply_pose(gaussians, edited, binding, own)
        unedited = motion.apply_pose(gaussians, edited, binding)
    learnt = motion.apply_pose(gaussians, edited, binding, own)
    assert learnt.means.requires_grad and learnt.sh_dc.requires_grad
    for name in ("means", "quats", "scales", "opacities", "sh_dc"):
        torch.testing.assert_close(getattr(learnt, name), getattr(drawn, name), rtol=1e-4, atol=1e-5)
    for name in ("means", "sh_dc"):
        assert (getattr(drawn, name) - getattr(unedited, name)).abs().max() > 1e-3, name


def test_neighbours_for_rigidity_are_found_anew_now_and_then():
    """At the first step, and at the first step with the term after each multiple of ``arap_refresh``."""
    motion = scenes.synthetic_scene("control-points", 60, 20, "cpu").motion
    assert isinstance(motion, ControlPoints)
    loss = {"arap": 1e-2, "arap_every": 5, "arap_refresh": 17, "arap_until": 60}
    config = tiny_config(60, freeze=0, loss=loss)
    motion.graph = None
    assert motion.refresh_due(0, config) and not motion.refresh_due(1, config)
    motion.refresh_graph(0, config.loss)
    assert motion.graph is not None
    before = motion.graph.neighbors.clone()
    assert [step for step in range(60) if motion.refresh_due(step, config)] == [0, 20, 35, 55]
    with torch.no_grad():
        motion.positions.copy_(motion.positions.flip(0) ** 3)
    motion.refresh_graph(15, config.loss)
    assert torch.equal(motion.graph.neighbors, before)
    motion.refresh_graph(20, config.loss)
    assert not torch.equal(motion.graph.neighbors, before)


def test_the_slack_of_the_settings_spares_edges_of_control_points():
    motion = scenes.synthetic_scene("control-points", 60, 20, "cpu").motion
    assert isinstance(motion, ControlPoints)
    weights = {}
    for slack in (0.0, 0.5):
        motion.graph = None
        motion.refresh_graph(0, tiny_config(60, loss={"arap_slack": slack}).loss)
        assert motion.graph is not None
        weights[slack] = motion.graph.weights.clone()
    torch.testing.assert_close(weights[0.0].sum(1), torch.ones(20))
    assert bool((weights[0.5] < weights[0.0]).all())


def test_control_points_rest_until_the_gaussians_have_settled():
    scene = scenes.synthetic_scene("control-points", 60, 20, "cpu")
    motion, config = scene.motion, tiny_config(60, freeze=3)
    for step, learns in ((0, False), (2, False), (3, True)):
        pose = trained_pose(motion, scene.gaussians, 0.3, step, config)
        motion.zero_grad()
        pose.gaussians.means.square().sum().backward()
        for name in ("positions", "log_radii", "network.head.weight"):
            assert (dict(motion.named_parameters())[name].grad is not None) == learns, (step, name)
