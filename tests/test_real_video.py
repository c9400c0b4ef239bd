"""What real video adds to training: a share of the motion for each Gaussian, noisy times, points on bare walls."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch
from tiny import blobs, tiny_camera, tiny_config

from scgs_warp.backdrop import FARTHEST, backdrop
from scgs_warp.data.normalise import Normalisation
from scgs_warp.gaussians import gaussians_from_points
from scgs_warp.motion import ControlPoints, build_motion
from scgs_warp.render import render
from scgs_warp.train import noisy_time
from scgs_warp.types import Frame, Pose


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
    full, half, none = (posed(True, logit, seed)[1] for logit in (30.0, 0.0, -30.0))
    unit = torch.nn.functional.normalize(gaussians.quats, dim=1)
    torch.testing.assert_close(full.means, whole.means)
    torch.testing.assert_close((full.quats * whole.quats).sum(1).abs(), torch.ones(30))
    torch.testing.assert_close(none.means, gaussians.means)
    torch.testing.assert_close((none.quats * unit).sum(1).abs(), torch.ones(30))
    torch.testing.assert_close(half.means, 0.5 * (gaussians.means + whole.means))
    half.means.sum().backward()


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


@pytest.mark.parametrize("seed", range(3))
def test_backdrop_lies_on_rays_behind_the_points(seed):
    points = blobs(0.0).means
    frames = []
    for index in range(5):
        camera = tiny_camera(index, 5, 32)
        image = render(blobs(0.0), camera, torch.zeros(3)).rgb
        mask = torch.ones(32, 32, dtype=torch.bool)
        mask[:, :16] = False
        frames.append(Frame(camera, 0.0, image, mask=mask))
    normalisation = Normalisation.fit([frame.camera for frame in frames])
    known = normalisation.apply(points)
    found, colors = backdrop(43, known, frames, normalisation, seed, 1)
    assert found.shape == colors.shape == (43, 3)
    for place, frame in enumerate(frames):
        own = slice(43 * place // 5, 43 * (place + 1) // 5)
        camera = normalisation.apply_camera(frame.camera)
        local = found[own] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixels = local @ camera.K.T
        columns, rows = (pixels[:, :2] / pixels[:, 2:]).floor().long().unbind(1)
        assert frame.mask is not None and frame.mask[rows, columns].all()
        assert torch.equal(colors[own], frame.image[rows, columns])
        depths = known @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
        assert (local[:, 2] > 0.999 * depths.min()).all() and (local[:, 2] < 1.001 * FARTHEST * depths.max()).all()
    again = backdrop(43, known, frames, normalisation, seed, 1)
    assert torch.equal(found, again[0]) and not torch.equal(found, backdrop(43, known, frames, normalisation, 9, 1)[0])
