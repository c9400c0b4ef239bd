"""Training states that hold the schedule of a preset and few Gaussians, and the learning rates at a step."""

from __future__ import annotations

from functools import cache

from helpers.tiny import tiny_dataset
from scgs_warp.config.presets import PresetName, from_dict, preset
from scgs_warp.training.state import Stage, TrainState
from scgs_warp.training.step import set_rates

SMALL = {"init_points": 300, "motion": {"nodes": 16, "layers": 3, "width": 32, "skip": 2}}


@cache
def begun(name: PresetName, stage: Stage) -> TrainState:
    """Return a state with the schedule of a preset, at the beginning of a stage."""
    state = TrainState.begin(from_dict(SMALL, "test", preset(name)), tiny_dataset(3), "cpu")
    if stage == "main":
        state.begin_main()
    return state


def at_step(name: PresetName, stage: Stage, step: int) -> TrainState:
    """Return the state at a step of a stage, with the learning rates of that step."""
    state = begun(name, stage)
    state.step = step + (state.config.pretrain_steps if stage == "main" else 0)
    set_rates(state)
    return state


def rates_at(name: PresetName, stage: Stage, step: int) -> dict[str, float]:
    """Return the learning rates of the Gaussians (or spheres) and of the motion at a step of a stage."""
    state = at_step(name, stage, step)
    assert state.motion_optimizer is not None
    groups = {**state.gaussian_optimizer.groups, **state.motion_optimizer.groups}
    return {name: group.rate for name, group in groups.items()}
