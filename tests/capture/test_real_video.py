"""What real video adds to training: a share of the motion for each Gaussian, noisy times, points on bare walls."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch

from helpers.tiny import blobs, tiny_camera, tiny_config
from scgs_warp.data.dataset import spread
from scgs_warp.gaussians import gaussians_from_points
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.motion import ControlPoints, build_motion
from scgs_warp.rendering.render import render
from scgs_warp.training.background_points import FARTHEST, backdrop
from scgs_warp.training.step import noisy_time
from scgs_warp.types import Camera, Frame, Pose


def posed(mask: bool, logit: float, seed: int):
    """Gaussians turned and moved by control points that all turn and move alike; and the pose."""
    random = torch.Generator().manual_seed(seed)
    config = tiny_config(20, motion={"mask": mask})
    motion = build_motion("control-points", config)
    assert isinstance(motion, ControlPoints)
    motion.positions.data[:] = torch.rand(16, 3, generator=random)
    gaussians = gaussians_from_points(torch.rand(30, 3, generator=random), None, sh_degree=0, hyper_dim=int(mask))
    gaussians.hyper.data[:] = logit
    gaussians.quats.data[:] = -torch.randn(30, 4, generator=random)
    turn = torch.tensor([math.cos(0.3), 0.0, 0.0, math.sin(0.3)]).expand(16, 4).contiguous()
    pose = Pose(torch.rand(16, 3, generator=random), turn)
    return gaussians, motion.bind_and_pose(gaussians, pose, frozen=False)


@pytest.mark.parametrize("seed", range(3))
def test_the_mask_is_a_share_of_the_motion(seed):
    gaussians, whole = posed(False, 0.0, seed)
    full, none = (posed(True, logit, seed)[1] for logit in (30.0, -30.0))
    halfway, half = posed(True, 0.0, seed)
    unit = torch.nn.functional.normalize(gaussians.quats, dim=1)
    torch.testing.assert_close(full.means, whole.means)
    torch.testing.assert_close((full.quats * whole.quats).sum(1).abs(), torch.ones(30))
    torch.testing.assert_close(none.means, gaussians.means)
    torch.testing.assert_close((none.quats * unit).sum(1).abs(), torch.ones(30))
    torch.testing.assert_close(half.means, 0.5 * (gaussians.means + whole.means))
    # Of a share s = sigmoid(l): d(rest + s (moved - rest)) / dl = s (1 - s) (moved - rest); quats, too, on one side.
    weights = [torch.randn(30, width, generator=torch.Generator().manual_seed(seed)) for width in (3, 4)]
    sum((x * weight).sum() for x, weight in zip((half.means, half.quats), weights)).backward()
    unit = unit * (unit * whole.quats).sum(1, keepdim=True).sign()
    moved = (whole.means - gaussians.means, whole.quats - unit)
    expected = 0.25 * sum((x * weight).sum(1, keepdim=True) for x, weight in zip(moved, weights))
    assert expected.abs().min() > 1e-4
    torch.testing.assert_close(halfway.hyper.grad, expected, rtol=1e-4, atol=1e-6)


def test_noisy_times_fade_and_repeat():
    config = tiny_config(1000, motion={"time_noise": 0.5}, optim={"network_until": 500})

    def spread(stage_step: int) -> float:
        times = [
            noisy_time(0.5, SimpleNamespace(config=config, stage_step=stage_step, step=step), 11) for step in range(200)
        ]
        return float(torch.tensor(times).std())

    assert spread(0) == pytest.approx(0.05, rel=0.2) and spread(250) == pytest.approx(0.025, rel=0.2)
    assert spread(500) == 0.0 and spread(0) == spread(0)
    state = SimpleNamespace(config=tiny_config(1000), stage_step=0, step=0)
    assert noisy_time(0.3, state, 11) == 0.3


def masked_frames(count: int) -> list[Frame]:
    """Each of another tint; the left half of each is not valid."""
    frames = []
    for index in range(count):
        camera = tiny_camera(index, count, 32)
        image = render(blobs(0.0), camera, torch.full((3,), (index + 1) / count)).rgb
        mask = torch.ones(32, 32, dtype=torch.bool)
        mask[:, :16] = False
        frames.append(Frame(camera, 0.0, image, mask=mask))
    return frames


def seen_by(
    frame: Frame, points: torch.Tensor, colors: torch.Tensor, known: torch.Tensor, normalisation: Normalisation
):
    """[B] whether each point may be one of this frame's: on a valid pixel of its colour, behind the known points."""
    camera = normalisation.apply_camera(frame.camera)
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = (local @ camera.K.T)[:, :2] / local[:, 2:]
    inside = ((pixels >= 0) & (pixels < 32)).all(1) & (local[:, 2] > 0)
    columns, rows = pixels.floor().long().clamp(0, 31).unbind(1)
    depths = known @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    between = (local[:, 2] > 0.999 * depths.min()) & (local[:, 2] < 1.001 * FARTHEST * depths.max())
    assert frame.mask is not None
    return inside & frame.mask[rows, columns] & (frame.image[rows, columns] == colors).all(1) & between


@pytest.mark.parametrize("seed", range(3))
def test_backdrop_lies_on_rays_behind_the_points(seed):
    frames = masked_frames(5)
    normalisation = Normalisation.fit([frame.camera for frame in frames])
    known = normalisation.apply(blobs(0.0).means)
    found, colors = backdrop(43, known, frames, normalisation, seed, 1)
    assert found.shape == colors.shape == (43, 3)
    owned = torch.stack([seen_by(frame, found, colors, known, normalisation) for frame in frames])
    assert owned.any(0).all() and (owned.sum(1) >= 43 // 5).all()
    assert owned[:, :15].any(1).all(), "the first of them come from all frames"
    again = backdrop(43, known, frames, normalisation, seed, 1)
    assert torch.equal(found, again[0]) and not torch.equal(found, backdrop(43, known, frames, normalisation, 9, 1)[0])


def test_a_frame_without_a_valid_pixel_adds_nothing_to_the_backdrop():
    frames = masked_frames(4)
    assert frames[1].mask is not None
    frames[1].mask[:] = False
    normalisation = Normalisation.fit([frame.camera for frame in frames])
    known = normalisation.apply(blobs(0.0).means)
    assert len(backdrop(40, known, frames, normalisation, 0, 1)[0]) == 30
    assert len(backdrop(40, known, frames[1:2], normalisation, 0, 1)[0]) == 0


def test_backdrop_of_images_beyond_2_to_the_24_pixels():
    size = 4100
    K = torch.tensor([[1.4 * size, 0, size / 2], [0, 1.4 * size, size / 2], [0, 0, 1]])
    camera = Camera(tiny_camera(0, 1, 32).viewmat, K, size, size)
    frame = Frame(camera, 0.0, torch.full((1, 1, 3), 0.3).expand(size, size, 3))
    normalisation = Normalisation.fit([camera])
    found, colors = backdrop(50, normalisation.apply(blobs(0.0).means), [frame], normalisation, 0, 1)
    assert len(found) == 50 and (colors == 0.3).all()


@pytest.mark.parametrize(("count", "most"), [(0, 24), (1, 24), (24, 24), (25, 24), (47, 24), (1000, 24), (5, 1)])
def test_spread_takes_no_more_than_it_may(count, most):
    chosen = spread(count, most)
    assert len(chosen) == len(set(chosen)) == min(count, most)
    assert chosen == sorted(chosen) and all(0 <= index < count for index in chosen)
    if count and most > 1:
        assert chosen[0] == 0 and chosen[-1] == count - 1
