"""The schedule of the preset ``paper``, as a table of steps and values: those of the supplement and the official
code."""

from __future__ import annotations

import pytest

from helpers.schedules import SMALL, at_step, rates_at
from helpers.tiny import tiny_dataset
from scgs_warp.config.presets import from_dict, preset, with_steps
from scgs_warp.motion.rigidity import arap_weight
from scgs_warp.training.density_control import (
    control_points_due,
    gradient_threshold,
    opacity_reset_due,
    round_due,
    sphere_reset_due,
    spheres_due,
    visibility_pruning_due,
)
from scgs_warp.training.loop import fit
from scgs_warp.training.step import motion_frozen
from scgs_warp.training.view import sh_degree

PAPER = preset("paper")


@pytest.mark.parametrize(
    ("step", "weight"),
    [
        *((0, 1e-4), (3_000, 1.2589e-5), (5_000, 3.1623e-6), (5_001, 3.1601e-6), (7_500, 5.6234e-7)),
        *((9_999, 1.0007e-7), (10_000, 0.0), (69_999, 0.0)),
    ],
)
def test_arap_decays_over_10000_steps(step, weight):
    assert arap_weight(step, PAPER.loss) == pytest.approx(weight, rel=1e-4)


@pytest.mark.parametrize(
    ("step", "means", "network", "positions"),
    [
        (0, 8e-4, 8e-4, 8e-5),
        (3_000, 5.0477e-4, 5.0196e-4, 5.0196e-5),
        (15_000, 8e-5, 7.7799e-5, 7.7799e-6),
        (20_000, 3.7133e-5, 3.5777e-5, 3.5777e-6),
        (30_000, 8e-6, 7.5659e-6, 7.5659e-7),
        (39_999, 8e-6, 1.6002e-6, 1.6002e-7),
        (40_000, 8e-6, 1.6e-6, 1.6e-7),
        (69_999, 8e-6, 1.6e-6, 1.6e-7),
    ],
)
def test_rates_of_the_main_stage(step, means, network, positions):
    rates = rates_at("paper", "main", step)
    assert rates["means"] == pytest.approx(means, rel=1e-4)
    assert rates["network.head.weight"] == pytest.approx(network, rel=1e-4)
    assert rates["positions"] == pytest.approx(positions, rel=1e-4)
    constant = {name: rates[name] for name in ("sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")}
    assert constant == {"sh_dc": 2.5e-3, "sh_rest": 1.25e-4, "opacity_logits": 0.05, "log_scales": 5e-3, "quats": 1e-3}
    assert rates["log_radii"] == 8e-4


@pytest.mark.parametrize(
    ("step", "means", "network"),
    [(0, 8e-4, 8e-4), (2_000, 5.8852e-4, 5.8632e-4), (7_500, 2.5298e-4, 2.4948e-4), (9_999, 1.7239e-4, 1.6920e-4)],
)
def test_rates_of_stage_1(step, means, network):
    """Spheres learn like Gaussians; the count of the network's rate begins with the stage, not after the warm-up."""
    rates = rates_at("paper", "pretrain", step)
    assert rates["means"] == pytest.approx(means, rel=1e-4)
    assert rates["network.head.weight"] == pytest.approx(network, rel=1e-4)
    assert (rates["opacity_logits"], rates["sh_dc"], rates["log_radius"]) == (0.05, 2.5e-3, 5e-3)


@pytest.mark.parametrize(
    ("step", "degree", "frozen"),
    [(0, 0, True), (999, 0, True), (1_000, 1, True), (2_000, 2, True), (2_999, 2, True), (3_000, 3, False)],
)
def test_harmonics_grow_every_1000_steps_and_the_motion_thaws_at_3000(step, degree, frozen):
    state = at_step("paper", "main", step)
    assert sh_degree(state, step) == degree and motion_frozen(state) is frozen
    assert sh_degree(state, 69_999) == 3


def test_density_of_the_main_stage():
    steps = range(1, PAPER.main_steps + 1)
    assert len(steps) == 70_000
    assert [done for done in steps if round_due(PAPER.densify, done)] == list(range(500, 50_001, 100))
    assert [done for done in steps if opacity_reset_due(PAPER.densify, done)] == list(range(3_000, 48_001, 3_000))
    assert [done for done in steps if round_due(PAPER.densify, done) and control_points_due(PAPER, done)] == [10_000]
    assert not any(visibility_pruning_due(PAPER.densify, done) for done in steps)
    assert {gradient_threshold(PAPER.densify, size, size) for size in (100, 400, 800)} == {2e-4}


def test_density_of_stage_1():
    steps = range(1, PAPER.pretrain_steps + 1)
    assert len(steps) == 10_000 and PAPER.pretrain.densify_until == 7_500
    assert [done for done in steps if spheres_due(PAPER.pretrain, done)] == list(range(100, 7_500, 100))
    assert [done for done in steps if sphere_reset_due(PAPER, done)] == [3_000, 6_000]
    assert not any(sphere_reset_due(preset("cpu"), done) for done in steps), "a share of the spheres is cloned there"


def test_a_short_run_shows_the_scene(tmp_path):
    """Of random grey points, those that show nothing go, and those that show the blobs stay: the image is not empty."""
    config = from_dict({**SMALL, "init_points": 5_000, "checkpoint_seconds": 1e9}, "test", with_steps(PAPER, 400))
    data = tiny_dataset(6)
    scene = fit(config, data, output=tmp_path)
    assert 20 < len(scene.gaussians) < 5_000 and scene.motion.control_points_at(0.5).shape[0] > 4
    for frame in data:
        image = scene.render(frame.camera, frame.time).rgb
        assert (image - frame.image).square().mean() < 0.5 * frame.image.square().mean()
