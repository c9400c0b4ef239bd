"""Each Gaussian's learnt share of the motion."""

from __future__ import annotations

import math

import pytest
import torch

from helpers.tiny import tiny_config
from scgs_warp.gaussians import gaussians_from_points
from scgs_warp.motion import ControlPoints, build_motion
from scgs_warp.types import Pose


def posed(mask: bool, logit: float, seed: int, corrected: bool = False):
    """Gaussians turned and moved by control points that all turn and move alike; and the pose."""
    random = torch.Generator().manual_seed(seed)
    config = tiny_config(20, motion={"mask": mask, "hyper_dim": 0})
    motion = build_motion("control-points", config)
    assert isinstance(motion, ControlPoints)
    motion.positions.data[:] = torch.rand(16, 3, generator=random)
    points = torch.rand(30, 3, generator=random)
    gaussians = gaussians_from_points(points, None, sh_degree=0, hyper_columns=int(mask), corrected=corrected)
    gaussians.hyper.data[:] = logit
    gaussians.quats.data[:] = -torch.randn(30, 4, generator=random)
    turn = torch.tensor([math.cos(0.3), 0.0, 0.0, math.sin(0.3)]).expand(16, 4).contiguous()
    pose = Pose(torch.rand(16, 3, generator=random), turn)
    gaussians.correctives.data[:] = torch.randn(gaussians.correctives.shape, generator=random)
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


def test_correctives_belong_to_the_motion():
    """A Gaussian that takes all of it is displaced as without a mask: once."""
    (_, whole), (_, straight) = (posed(False, 0.0, 5, corrected) for corrected in (True, False))
    full, half = (posed(True, logit, 5, corrected=True) for logit in (30.0, 0.0))
    assert (whole.means - straight.means).norm(dim=1).min() > 1e-3
    torch.testing.assert_close(full[1].means, whole.means)
    torch.testing.assert_close(half[1].means, 0.5 * (half[0].means + whole.means))
    half[1].means.sum().backward()
    assert half[0].correctives.grad.any()
