"""The schedules of the presets as tables: step -> rates, harmonics, ARAP weight, resets, rounds.

``test_paper_schedule.py`` has those of ``paper``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import pytest

from helpers.schedules import at_step, begun, rates_at
from helpers.tiny import tiny_config
from scgs_warp.config.presets import PresetName, preset
from scgs_warp.motion.rigidity import arap_weight
from scgs_warp.training.density_control import (
    control_points_due,
    density_due,
    opacity_reset_due,
    round_due,
    spheres_due,
    visibility_pruning_due,
)
from scgs_warp.training.frames import view_number
from scgs_warp.training.step import motion_frozen
from scgs_warp.training.view import log_weight, seeks_silhouettes, sh_degree, varies_background

STEADY = {"sh_dc": 2.5e-3, "sh_rest": 1.25e-4, "opacity_logits": 0.05, "log_scales": 5e-3, "quats": 1e-3}
STEADY |= {"shading": 2.5e-3, "correctives": 8e-4}
SPHERES = {**STEADY, "opacity_logits": 0.02, "sh_dc": 0.01, "hyper": 2.5e-3 * 8**0.5}


class Row(NamedTuple):
    """Learning rates at a step; those in ``STEADY`` are multiplied by ``settled``."""

    step: int
    means: float
    network: float
    settled: float = 1.0


STAGE_2: dict[PresetName, list[Row]] = {
    "quick": [
        Row(0, 8e-4, 8e-4),
        Row(117, 7.3263e-4, 8e-4),
        Row(118, 7.3208e-4, 7.9919e-4),
        Row(2_600, 1.1327e-4, 6.4411e-5),
        Row(4_420, 2.8829e-5, 1.0162e-5),
        Row(4_810, 2.1502e-5, 6.8411e-6, 0.05**0.5),
        Row(5_199, 1.6049e-5, 4.6102e-6, 0.05 ** (779 / 780)),
    ],
    "cpu": [
        Row(0, 8e-4, 8e-4),
        Row(400, 7.3282e-4, 8e-4),
        Row(401, 7.3266e-4, 7.9976e-4),
        Row(10_500, 8e-5, 4.0273e-5),
        Row(17_850, 1.5962e-5, 4.5748e-6),
        Row(19_425, 1.1300e-5, 2.8705e-6, 0.05**0.5),
        Row(20_999, 8.0018e-6, 1.8016e-6, 0.05 ** (3_149 / 3_150)),
    ],
    "best": [
        Row(0, 8e-4, 8e-4),
        Row(1_500, 6.4890e-4, 8e-4),
        Row(1_501, 6.4881e-4, 7.9985e-4),
        Row(17_500, 6.9580e-5, 3.9310e-5),
        Row(29_750, 1.2591e-5, 3.9139e-6),
        Row(32_375, 8.7291e-6, 2.3874e-6, 0.05**0.5),
        Row(33_000, 8e-6, 2.1223e-6, 0.05 ** (3_250 / 5_250)),
        Row(34_999, 8e-6, 1.6e-6, 0.05 ** (5_249 / 5_250)),
    ],
}
STAGE_1: dict[PresetName, list[Row]] = {
    "quick": [
        Row(0, 8e-4, 8e-4),
        Row(100, 7.4206e-4, 8e-4),
        Row(101, 7.4150e-4, 7.9919e-4),
        Row(900, 4.0664e-4, 3.5528e-4),
        Row(1_799, 2.0685e-4, 1.4270e-4),
    ],
    "cpu": [
        Row(0, 8e-4, 8e-4),
        Row(100, 7.8265e-4, 8e-4),
        Row(101, 7.8248e-4, 7.9976e-4),
        Row(1_500, 5.7575e-4, 5.2864e-4),
        Row(2_999, 4.1445e-4, 3.3924e-4),
    ],
    "best": [
        Row(0, 8e-4, 8e-4),
        Row(50, 7.9444e-4, 8e-4),
        Row(51, 7.9433e-4, 7.9985e-4),
        Row(2_500, 5.6438e-4, 5.0433e-4),
        Row(4_999, 3.9822e-4, 3.1501e-4),
    ],
}


def rows(table: dict[PresetName, list[Row]]) -> list[Any]:
    return [pytest.param(name, row, id=f"{name}-{row.step}") for name, listed in table.items() for row in listed]


def expected(steady: dict[str, float], factor: float) -> dict[str, Any]:
    return {name: pytest.approx(rate * factor, rel=1e-4) for name, rate in steady.items()}


@pytest.mark.parametrize(("name", "row"), rows(STAGE_2))
def test_rates_of_the_main_stage(name, row):
    rates = rates_at(name, "main", row.step)
    networks = {rates.pop(key) for key in list(rates) if key.startswith("network.")}
    assert len(networks) == 1 and networks.pop() == pytest.approx(row.network, rel=1e-4)
    assert rates.pop("means") == pytest.approx(row.means, rel=1e-4)
    assert rates.pop("positions") == pytest.approx(0.1 * row.network, rel=1e-4)
    nodes = {rates.pop(key) for key in ("log_radii", "strength_logits") if key in rates}
    assert rates.pop("hyper") == pytest.approx(row.network * 8**0.5, rel=1e-4), "stretched"
    assert len(nodes) == 1 and nodes.pop() == pytest.approx(row.network, rel=1e-4)
    assert rates == expected(STEADY, row.settled)


@pytest.mark.parametrize(("name", "row"), rows(STAGE_1))
def test_rates_of_stage_1(name, row):
    rates = rates_at(name, "pretrain", row.step)
    networks = {rates.pop(key) for key in list(rates) if key.startswith("network.")}
    assert len(networks) == 1 and networks.pop() == pytest.approx(row.network, rel=1e-4)
    assert rates.pop("means") == pytest.approx(row.means, rel=1e-4)
    assert rates.pop("log_radius") == 5e-3
    assert rates == SPHERES


class Milestones(NamedTuple):
    """Steps of a stage at which something changes."""

    main_steps: int
    pretrain_steps: int
    freeze: int
    sh: tuple[int, int, int]
    """First steps with harmonics of degree 1, 2 and 3."""
    log_error: int
    """First step with the logarithm of the error in the loss."""
    rounds: range
    resets: list[int]
    control_points: list[int]
    warm_up: int
    """First step at which spheres move and silhouettes draw them."""
    spheres: list[int]


MILESTONES: dict[PresetName, Milestones] = {
    "quick": Milestones(
        5_200, 1_800, 117, (146, 292, 438), 2_600, range(200, 3_501, 100), [875, 1_750, 2_625],
        [600, 1_200, 1_800, 2_400], 100, [*range(100, 1_500, 100)],
    ),
    "cpu": Milestones(
        21_000, 3_000, 400, (500, 1_000, 1_500), 10_500, range(400, 12_001, 100), [3_000, 6_000, 9_000],
        [2_000, 4_000, 6_000, 8_000], 100, [*range(100, 2_000, 100)],
    ),
    "best": Milestones(
        35_000, 5_000, 1_500, (750, 1_500, 2_250), 20_300, range(300, 19_951, 150), [5_000, 10_000, 15_000],
        [2_550, 5_100, 7_500, 10_050, 12_600], 50, [50, *range(100, 3_750, 100)],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", MILESTONES)
def test_milestones_of_the_main_stage(name):
    table, config = MILESTONES[name], preset(name)
    growth, steps = config.densify, range(1, config.main_steps + 1)
    assert (config.main_steps, config.pretrain_steps) == (table.main_steps, table.pretrain_steps)
    assert [done for done in steps if round_due(growth, done)] == list(table.rounds)
    assert [done for done in steps if opacity_reset_due(growth, done)] == table.resets
    assert [done for done in steps if visibility_pruning_due(growth, done)] == [*table.resets, growth.until]
    assert [done for done in table.rounds if control_points_due(config, done)] == table.control_points
    state = begun(name, "main")
    assert [min(k for k in steps if sh_degree(state, k) == degree) for degree in (1, 2, 3)] == list(table.sh)
    assert sh_degree(state, 0) == 0 and sh_degree(state, config.main_steps - 1) == 3
    changes, varied = {}, []
    for step in range(config.main_steps):
        state.step = config.pretrain_steps + step
        changes.setdefault(("frozen", motion_frozen(state)), step)
        changes.setdefault(("log error", log_weight(state)), step)
        varied.append(varies_background(state))
        changes.setdefault(("density", density_due(state)), step)
        assert not (density_due(state) and step + 1 > growth.until), "densification ends"
    assert changes["frozen", False] == table.freeze and changes["frozen", True] == 0
    assert changes["log error", config.loss.log_error] == table.log_error and changes["log error", 0.0] == 0
    assert varied == [step % 10 == 9 for step in range(config.main_steps)]
    assert changes["density", True] == table.rounds[0] - 1


@pytest.mark.parametrize("name", MILESTONES)
def test_milestones_of_stage_1(name):
    table, config = MILESTONES[name], preset(name)
    steps = range(1, config.pretrain_steps + 1)
    assert [done for done in steps if spheres_due(config.pretrain, done)] == table.spheres
    state = begun(name, "pretrain")
    sought, weights = [], {}
    for step in (0, table.warm_up - 1, table.warm_up, table.warm_up + 4, table.warm_up + 5, table.warm_up + 6):
        state = at_step(name, "pretrain", step)
        sought.append(seeks_silhouettes(state))
        weights[step - table.warm_up] = state.motion.plan(state.gaussians, 0.3, step, config).weight
    assert sought == [False, False, True, True, True, True]
    assert weights[0] == weights[5] == pytest.approx(5e-3) and weights[4] == weights[6] == weights[-1] == 0.0
    state.step = config.pretrain.densify_until - 1
    assert density_due(state), "spheres are thinned"
    state.step = config.pretrain.densify_until
    assert not density_due(state)


ARAP: dict[PresetName, list[tuple[int, float]]] = {
    "quick": [(0, 0.05), (1, 0.0), (4, 0.0), (5, 0.05), (2_600, 0.05), (5_195, 0.05), (5_199, 0.0)],
    "cpu": [(0, 0.05), (1, 0.0), (4, 0.0), (5, 0.05), (10_000, 0.05), (20_995, 0.05), (20_999, 0.0)],
    "best": [(0, 0.05), (1, 0.0), (4, 0.0), (5, 0.05), (10_000, 0.05), (34_995, 0.05), (34_999, 0.0)],
}


@pytest.mark.parametrize("name", ARAP)
def test_arap_is_in_every_fifth_step_to_the_end(name):
    """The term is in every fifth step, with five times the weight. ``test_paper_schedule.py`` tests its decay."""
    loss = preset(name).loss
    assert [arap_weight(step, loss) for step, _ in ARAP[name]] == pytest.approx([w for _, w in ARAP[name]], rel=1e-4)
    present = [step for step in range(preset(name).main_steps) if arap_weight(step, loss) > 0.0]
    assert present == list(range(0, min(loss.arap_until, preset(name).main_steps), 5))


def test_views_are_numbered_over_batches():
    config = tiny_config(60, batch=3)
    assert [view_number(step, config, view) for step in (0, 1, 7) for view in range(3)] == [
        0,
        1,
        2,
        3,
        4,
        5,
        21,
        22,
        23,
    ]
