"""Synthetic scenes, their cameras and the load of an image."""

from __future__ import annotations

import pytest
import torch

from scgs_warp.benchmark import scenes
from scgs_warp.config.presets import MOTIONS
from scgs_warp.ops.binning import bin_splats
from scgs_warp.ops.compositing import composite
from scgs_warp.ops.projection import project

pytestmark = pytest.mark.usefixtures("all_threads")


def test_a_wide_camera_sees_as_wide_and_the_middle():
    scene = scenes.synthetic_scene("static", 60, 12, "cpu")
    square, wide = (scenes.scene_camera(scene, size) for size in (64, (64, 36)))
    assert torch.equal(square.viewmat, wide.viewmat)
    assert wide.K.tolist() == [[square.K[0, 0], 0, 32], [0, square.K[0, 0], 18], [0, 0, 1]]
    same = scenes.scene_camera(scene, (64, 64))
    assert torch.equal(square.K, same.K) and (same.width, same.height) == (square.width, square.height)


@pytest.mark.parametrize("motion", MOTIONS)
def test_synthetic_scenes_repeat_and_move_mildly(motion):
    first, second = (scenes.synthetic_scene(motion, 400, 20, "cpu") for _ in range(2))
    early, late = first.gaussians_at(0.1), first.gaussians_at(0.9)
    assert torch.equal(late.means, second.gaussians_at(0.9).means)
    moved = float((late.means - early.means).norm(dim=1).mean())
    assert moved == 0.0 if motion == "static" else 1e-3 < moved < 0.2
    assert bool(torch.isfinite(late.scales).all())
    if motion != "static":
        layers = [layer for layer in first.motion.modules() if isinstance(layer, torch.nn.Linear)]
        assert len(layers) >= 4
    if motion in ("control-points", "per-gaussian"):
        assert [layer.out_features for layer in layers[:8]] == [256] * 8


@pytest.mark.parametrize("motion", ["control-points", "per-gaussian"])
def test_as_many_hidden_values_are_zero_as_in_trained_networks(motion):
    """The kernels of the CPU leave out products with zeros."""
    scene = scenes.synthetic_scene(motion, 400, 40, "cpu")
    positions = scene.motion.positions if motion == "control-points" else scene.gaussians.means
    shares: list[float] = []
    hooks = [
        layer.register_forward_hook(lambda module, given, out: shares.append(float((out <= 0).float().mean())))
        for layer in scene.motion.network.layers
    ]
    for time in (0.1, 0.6):
        scene.motion.network(positions.detach().requires_grad_(), torch.tensor([time]))
    for hook in hooks:
        hook.remove()
    assert len(shares) == 16 and 0.75 < sum(shares) / 16 < 0.85 and max(shares) < 0.95


@pytest.mark.parametrize("seed", range(3))
def test_contributors_are_those_that_compositing_blends(seed, device):
    """A channel of ones over alpha * T hides the count; twin: every splat on its own, in the order of depth."""
    scene = scenes.synthetic_scene("static", 60, 12, device, seed)
    camera = scenes.scene_camera(scene, 40)
    gaussians = scene.gaussians_at(0.5)
    load = scenes.load_of(gaussians, camera)
    with torch.no_grad():
        geometry = gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities
        splats = project(*geometry, camera.viewmat, camera.K, 40, 40)
        tiles = bin_splats(splats)
        assert load.pairs == len(tiles.splats)
        y, x = torch.meshgrid(torch.arange(40.0) + 0.5, torch.arange(40.0) + 0.5, indexing="ij")
        transmittance, count = torch.ones(40, 40, dtype=torch.float64), torch.zeros(40, 40)
        ended = torch.zeros(40, 40, dtype=torch.bool)
        for i in splats.depths.argsort(stable=True).tolist():
            if int(splats.radii[i].min()) == 0:
                continue
            a, b, c = splats.conics[i].cpu()
            dx, dy = x - float(splats.means2d[i, 0]), y - float(splats.means2d[i, 1])
            alpha = float(splats.opacities[i]) * torch.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
            alpha = alpha.clamp(max=0.999).double()
            after = transmittance * (1 - alpha)
            ended |= (alpha >= 1 / 255) & (after <= 1e-4)
            blended = (alpha >= 1 / 255) & ~ended
            transmittance = torch.where(blended, after, transmittance)
            count += blended
        alpha = composite(splats, gaussians.sh_dc, tiles)[1].cpu()
    assert torch.allclose(1 - transmittance.float(), alpha, atol=1e-3)
    assert load.contributors == pytest.approx(float(count[count > 0].mean()), rel=5e-3)


def test_an_empty_picture_has_no_contributors():
    scene = scenes.synthetic_scene("static", 60, 12, "cpu")
    gaussians = scene.gaussians_at(0.0)
    camera = scenes.scene_camera(scene, 32)
    behind = type(camera)(torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])) @ camera.viewmat, camera.K, 32, 32)
    assert scenes.load_of(gaussians, behind) == scenes.Load(0, 0.0)


@pytest.mark.parametrize("count", [2_000, 8_000])
def test_what_the_figure_covers_does_not_depend_on_its_size(count):
    scene = scenes.synthetic_scene("static", count, 12, "cpu")
    camera = scenes.scene_camera(scene, 128)
    assert 0.1 < float((scene.render(camera, 0.0).alpha > 0.1).float().mean()) < 0.4
