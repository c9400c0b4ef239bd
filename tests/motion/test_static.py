"""The static model: the same Gaussians at all times, and nothing to train."""

from __future__ import annotations

import torch

from helpers.tiny import tiny_config, trained_pose
from scgs_warp.gaussians import gaussians_from_points
from scgs_warp.motion import Static, build_motion


def test_gaussians_stay():
    config = tiny_config(20)
    motion = build_motion("static", config)
    assert isinstance(motion, Static) and not motion.moves and motion.optimizer(config) is None
    gaussians = gaussians_from_points(torch.rand(5, 3), None, sh_degree=1, hyper_columns=0)
    rest = gaussians.activate()
    for time in (0.0, 0.5, torch.tensor([1.0])):
        posed = motion.gaussians_at(gaussians, time)
        for name, value in rest.tensors().items():
            assert torch.equal(getattr(posed, name), value), name
    pose = trained_pose(motion, gaussians, 0.3, 0, config)
    assert pose.regulariser is None and motion.control_points_at(0.5).shape == (0, 3)
