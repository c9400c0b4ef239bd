"""Functions of the step: learning rates, degree of spherical harmonics, frozen motion, noise on times."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.config import presets as C
from scgs_warp.training.density_control import control_density
from scgs_warp.training.frames import Frames
from scgs_warp.training.state import TrainState
from scgs_warp.training.step import (
    SETTLED,
    motion_frozen,
    set_rates,
    settling,
    training_step,
)
from scgs_warp.training.view import log_weight, noisy_time, sh_degree


def test_constant_rates_settle_in_the_last_share_of_the_run():
    config = C.preset("best")
    begin = round(0.85 * config.main_steps)
    factors = [settling(step, config) for step in range(0, config.main_steps + 1, 500)]
    assert factors[begin // 500] == 1.0 and factors == sorted(factors, reverse=True)
    assert factors[-1] == SETTLED < settling(begin + 100, config) < 1.0
    assert settling(config.main_steps, C.with_field(config, "optim.settle", 0.0, "test")) == 1.0


@pytest.mark.parametrize(
    ("begin", "step", "weight"),
    [
        *((0.5, step, 0.0) for step in (0, 9, 10, 29)),
        *((0.5, step, 2e-3) for step in (30, 49)),
        *((0.0, 9, 0.0), (0.0, 10, 2e-3), (1.0, 49, 0.0)),
    ],
)
def test_logarithm_of_the_error_begins_within_the_main_stage(begin, step, weight):
    """Stage 1 has 10 steps, the main stage 40."""
    schedule = {**SCHEDULE, "loss": {"log_error": 2e-3, "log_error_from": begin}}
    state = TrainState.begin(tiny_config(50, **schedule), tiny_dataset(3), "cpu")
    if step >= 10:
        state.begin_main()
    state.step = step
    assert log_weight(state) == weight


def test_logarithm_of_the_error_reaches_the_gradients():
    """The step's loss holds the term, and its gradient is that of the sum."""
    losses, gradients = [], []
    for weight in (0.0, 0.1):
        config = tiny_config(50, **SCHEDULE, loss={"log_error": weight, "log_error_from": 0.0})
        data = tiny_dataset(3)
        state = TrainState.begin(config, data, "cpu")
        state.begin_main()
        state.step = 10
        before = state.gaussians.sh_dc.detach().clone()
        result = training_step(state, Frames(data, state.normalisation, config, "cpu"))
        error = (result.render - result.truth).square().mean()
        losses.append(float(result.loss) - weight * float(error.log()))
        gradients.append(state.gaussians.sh_dc.detach() - before)
    assert losses[0] == pytest.approx(losses[1], abs=1e-5)
    assert not torch.equal(*gradients)


SCHEDULE = {
    "pretrain": {"steps": 10, "warm_up": 4},
    "freeze": 5,
    "optim": {"means_until": 40, "network_until": 20, "settle": 0.5, "cameras": 1e-3},
    "densify": {"sh_every": 15},
}
"""Of a run of 50 steps, 40 of them main steps."""


def state_at(step: int) -> TrainState:
    """A state at ``step`` with its rates set."""
    state = TrainState.begin(tiny_config(50, **SCHEDULE), tiny_dataset(3), "cpu")
    if step >= 10:
        state.begin_main()
    state.step = step
    set_rates(state)
    return state


@pytest.mark.parametrize(
    "step, means, sh_dc, network, positions, cameras",
    [
        (0, 8e-4, 1e-2, 8e-4, None, None),
        (4, 8e-4 * 0.01 ** (4 / 40), 1e-2, 8e-4, None, None),
        (9, 8e-4 * 0.01 ** (9 / 40), 1e-2, 8e-4 * 0.002 ** (5 / 20), None, None),
        (10, 8e-4, 2.5e-3, 8e-4, 8e-5, 0.0),
        (15, 8e-4 * 0.01 ** (5 / 40), 2.5e-3, 8e-4, 8e-5, 1e-3),
        (35, 8e-4 * 0.01 ** (25 / 40), 2.5e-3 * SETTLED ** (5 / 20), 1.6e-6, 1.6e-7, 1e-3 * 0.01 ** (20 / 35)),
        (50, 8e-6, 2.5e-3 * SETTLED, 1.6e-6, 1.6e-7, 1e-5),
    ],
)
def test_learning_rates_follow_their_schedules(step, means, sh_dc, network, positions, cameras):
    """Stage 1 ends at step 10; control points, network and poses join five steps later."""
    state = state_at(step)
    assert state.motion_optimizer is not None
    gaussians, motion = state.gaussian_optimizer.groups, state.motion_optimizer.groups
    assert gaussians["means"].rate == pytest.approx(means)
    assert gaussians["sh_dc"].rate == pytest.approx(sh_dc)
    assert motion["network.head.weight"].rate == pytest.approx(network)
    assert ("positions" in motion) == (positions is not None)
    assert positions is None or motion["positions"].rate == pytest.approx(positions)
    assert state.refines_cameras == bool(cameras)
    assert cameras is None or state.camera_optimizer.groups["twists"].rate == pytest.approx(cameras)


def test_spherical_harmonics_grow_and_motion_thaws():
    state = state_at(10)
    degrees, frozen = [], []
    for step in range(10, 50):
        state.step = step
        degrees.append(sh_degree(state, state.stage_step))
        frozen.append(motion_frozen(state))
    assert degrees == [0] * 15 + [1] * 15 + [2] * 10
    assert frozen == [True] * 5 + [False] * 35
    assert not motion_frozen(state_at(3)), "stage 1 trains the network"


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


@pytest.mark.parametrize("model", ["hexplane", "per-gaussian"])
def test_the_motion_rests_through_the_coarse_steps(model):
    data, config = tiny_dataset(6), tiny_config(30, motion={"model": model}, coarse=6)
    state = TrainState.begin(config, data, "cpu")
    frames = Frames(data, state.normalisation, config, "cpu")
    before = [parameter.detach().clone() for parameter in state.motion.parameters()]
    for step in range(config.coarse + 2):
        training_step(state, frames)
        control_density(state, (48, 48))
        state.step += 1
        same = [torch.equal(old, new) for old, new in zip(before, state.motion.parameters())]
        assert all(same) if step < config.coarse else not all(same), step


def test_rates_of_a_long_stage_1_do_not_settle():
    """Constant rates settle from step 10 of the 20 main steps on; stage 1 has 30 steps."""
    schedule = {**SCHEDULE, "pretrain": {"steps": 30, "warm_up": 4}}
    state = TrainState.begin(tiny_config(50, **schedule), tiny_dataset(3), "cpu")
    for stage, step, factor in (("pretrain", 9, 1.0), ("pretrain", 25, 1.0), ("main", 35, 1.0), ("main", 45, None)):
        if stage == "main" and state.stage == "pretrain":
            state.begin_main()
        state.step = step
        set_rates(state)
        rates, base = state.gaussian_optimizer.groups, state.gaussian_rates()
        wanted = SETTLED**0.5 if factor is None else factor
        assert rates["sh_dc"].rate == pytest.approx(base["sh_dc"] * wanted), step
