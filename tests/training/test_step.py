"""A step of training: noise on the time of a frame."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from helpers.tiny import tiny_config
from scgs_warp.training.step import noisy_time


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
