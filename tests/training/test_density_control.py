"""Adaptive density control: the schedule, the choice of rows, visibility pruning."""

from __future__ import annotations

import math

import pytest
import torch

from helpers.gaussian_rows import make
from helpers.hidden_gaussian import state_with_hidden_gaussian
from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.config.presets import DensifyConfig, PretrainConfig, preset, with_steps
from scgs_warp.runtime.memory import NotEnoughMemory
from scgs_warp.seeding import generator
from scgs_warp.training import density_control
from scgs_warp.training.density_control import (
    control_density,
    control_points_due,
    density_due,
    gradient_threshold,
    grow_and_prune,
    opacity_reset_due,
    round_due,
    spheres_due,
    visibility_pruning_due,
    visible_gaussians,
)
from scgs_warp.training.loop import fit
from scgs_warp.training.visibility import Seen, faintest, seen_by
from scgs_warp.types import Stats, plain_scale


def test_schedule_of_a_short_run():
    """Rounds, resets and visibility pruning as functions of the main steps that are done."""
    config = DensifyConfig(start=10, until=40, every=5, rounds=100, opacity_reset_every=12)
    steps = range(1, 60)
    assert [done for done in steps if round_due(config, done)] == [10, 15, 20, 25, 30, 35, 40]
    assert [done for done in steps if opacity_reset_due(config, done)] == [12, 24], "36 has no time to heal"
    assert [done for done in steps if visibility_pruning_due(config, done)] == [12, 24, 40]
    off = DensifyConfig(start=10, until=40, opacity_reset_every=12, min_contribution=0.0)
    assert not any(visibility_pruning_due(off, done) for done in steps)
    stage1 = PretrainConfig(densify_until=20, densify_every=6, warm_up=3)
    assert [done for done in steps if spheres_due(stage1, done)] == [3, 6, 12, 18]


@pytest.mark.parametrize(
    "name, first, last, rounds, resets",
    [
        ("best", 300, 19_950, 132, [5_000, 10_000, 15_000]),
        ("paper", 500, 50_000, 496, list(range(3_000, 48_001, 3_000))),
        ("cpu", 400, 12_000, 117, [3_000, 6_000, 9_000]),
        ("quick", 200, 3_500, 34, [875, 1_750, 2_625]),
    ],
)
def test_schedule_of_the_presets(name, first, last, rounds, resets):
    config = preset(name)
    steps = range(1, config.main_steps + 1)
    due = [done for done in steps if round_due(config.densify, done)]
    assert (due[0], due[-1], len(due)) == (first, last, rounds)
    assert [done for done in steps if opacity_reset_due(config.densify, done)] == resets


@pytest.mark.parametrize(
    "name, steps, due",
    [
        ("best", 80_000, [5_100, 10_200, 15_000, 20_100, 25_200]),
        ("best", 40_000, [2_550, 5_100, 7_500, 10_050, 12_600]),
        ("cpu", 24_000, [2_000, 4_000, 6_000, 8_000]),
        ("paper", 80_000, [10_000]),
    ],
)
def test_control_points_change_at_the_first_round_after_each_milestone(name, steps, due):
    config = with_steps(preset(name), steps)
    rounds = range(config.densify.interval, config.densify.until + 1, config.densify.interval)
    assert [done for done in rounds if control_points_due(config, done)] == due


def test_threshold_follows_the_resolution():
    config = DensifyConfig(grad_threshold=2e-4, resolution_exponent=0.66)
    assert gradient_threshold(config, 800, 800) == pytest.approx(2e-4)
    assert 4.8e-4 < gradient_threshold(config, 200, 200) < 5.2e-4


def test_threshold_grows_as_sharp_splats_become_narrower():
    config = DensifyConfig(grad_threshold=2e-4)
    thresholds = [gradient_threshold(config, 800, 800, sharpness) for sharpness in (0.0, 0.5, 2.0)]
    assert thresholds[0] == pytest.approx(2e-4)
    assert thresholds[1] == pytest.approx(2e-4 / plain_scale(0.5)) and thresholds[1] < thresholds[2]


def run_round(gaussians, optimizer, gradient, config, **options):
    stats = Stats.zeros(len(gaussians), gradient.device)
    stats.count.fill_(2.0)
    stats.grad_norm.copy_(gradient * 2.0)
    defaults = {"grad_threshold": 0.5, "extent": 1.0, "prune_large": False, "random": generator(0, 1)}
    grow_and_prune(gaussians, optimizer, stats, config, **{**defaults, **options})


def test_small_ones_are_cloned_large_ones_split(device):
    gaussians, optimizer = make(4, device)
    with torch.no_grad():
        gaussians.log_scales.copy_(torch.tensor([0.001, 0.001, 0.5, 0.5]).log()[:, None].expand(4, 3))
    before = gaussians.means.detach().clone()
    run_round(gaussians, optimizer, torch.tensor([1.0, 0.0, 1.0, 0.0], device=device), DensifyConfig())
    # rows: 0 1 3 kept, clone of 0, two halves of 2
    assert len(gaussians) == 6
    assert torch.equal(gaussians.means[:4], before[[0, 1, 3, 0]])
    assert torch.allclose(gaussians.scales()[4:], torch.full((2, 3), 0.5 / 1.6, device=device))
    assert not torch.equal(gaussians.means[4], gaussians.means[5])


def test_budget_takes_the_largest_gradients(device):
    gaussians, optimizer = make(10, device)
    gradient = torch.arange(10, device=device).float() + 1.0
    marks = gaussians.means.detach().clone()
    run_round(gaussians, optimizer, gradient, DensifyConfig(max_gaussians=12, percent_dense=10.0))
    assert len(gaussians) == 12
    assert torch.equal(gaussians.means[10:], marks[[8, 9]])


def test_transparent_large_and_broken_ones_go(device):
    gaussians, optimizer = make(5, device)
    with torch.no_grad():
        gaussians.log_scales.fill_(-4.0)
        gaussians.opacity_logits[0] = -9.0
        gaussians.log_scales[1] = 3.0
        gaussians.means[2, 1] = float("nan")
    run_round(gaussians, optimizer, torch.zeros(5, device=device), DensifyConfig(), prune_large=True)
    assert len(gaussians) == 2


@pytest.mark.parametrize(("max_screen", "left"), [(0.05, 3), (0.4, 4), (0.0, 5)])
def test_size_on_screen_may_be_of_no_account(max_screen, left):
    gaussians, optimizer = make(5, "cpu")
    with torch.no_grad():
        gaussians.log_scales.fill_(-4.0)
    stats = Stats.zeros(5, "cpu")
    stats.max_radii[:] = torch.tensor([0.01, 0.02, 0.04, 0.3, 9.0])
    options = {"grad_threshold": 0.5, "extent": 1.0, "prune_large": True, "random": generator(0, 1)}
    grow_and_prune(gaussians, optimizer, stats, DensifyConfig(max_screen=max_screen), **options)
    assert len(gaussians) == left


class Many:
    """A hundred and fifty frames, of which nothing is asked."""

    data = None

    def __len__(self) -> int:
        return 150


def seen_by_all(count: int) -> Seen:
    """Every Gaussian fills a pixel of many views, far away."""
    return Seen(torch.ones(count), torch.full((count,), 99, dtype=torch.int32), torch.full((count,), 9.0))


def test_the_look_takes_views_at_random_and_not_more_than_it_may(monkeypatch):
    """Of a rig whose cameras come in the same order at every instant, others each time."""
    state, frames = state_with_hidden_gaussian(opacity_reset_every=16)
    taken = []
    monkeypatch.setattr(
        density_control, "seen_by", lambda state, frames, indices, least: taken.append(indices) or seen_by_all(1)
    )
    monkeypatch.setattr(density_control, "FEWEST_VIEWS", 3)
    for per_view, step in ((4, 15), (4, 32), (4, 39), (5, 15), (6, 15)):
        monkeypatch.setattr(density_control, "STEPS_PER_VIEW", per_view)
        state.step = step
        assert (visible_gaussians(state, frames) is None) == (per_view == 6 or step == 32), (
            "4, none due, all, 3, 2 are too few"
        )
    assert [len(set(indices)) for indices in taken] == [len(indices) for indices in taken] == [4, 6, 3]
    assert all(index in range(6) for indices in taken for index in indices)
    monkeypatch.setattr(density_control, "MOST_VIEWS", 3)
    state.step = 39
    visible_gaussians(state, frames)
    assert len(taken[-1]) == 3
    assert taken[0] != taken[2][: len(taken[0])] or taken[0] != taken[1][: len(taken[0])], "the same ones at every look"


@pytest.mark.parametrize("step, due", [(18, False), (19, True), (38, False), (39, True), (40, False), (59, False)])
def test_the_unseen_go_before_a_reset_and_at_the_end_of_densification(step, due, monkeypatch):
    monkeypatch.setattr(density_control, "STEPS_PER_VIEW", 1)
    state, frames = state_with_hidden_gaussian()
    least = state.config.densify.min_contribution
    kept = seen_by(state, frames, list(range(6)), least).most >= least
    assert 0 < int(kept.sum()) < len(kept)
    before = state.gaussians.means.detach().clone()
    state.stats.count[:] = torch.arange(len(kept))
    state.step = step
    found = visible_gaussians(state, frames)
    assert (found is not None) == due and (found is None or torch.equal(found, kept))
    control_density(state, (48, 48), found)
    stay = torch.where(kept if due else torch.ones_like(kept))[0]
    assert torch.equal(state.gaussians.means, before[stay])
    assert torch.equal(state.stats.count, stay.float()), "the others' statistics go on"
    faint = bool((state.gaussians.opacities() < 0.02).all())
    assert faint == (step == 19), "reset where it was due, after the look at the images"


@pytest.mark.parametrize(
    "share, found", [(0.0, []), (0.05, []), (0.1, [2]), (0.49, [1, 2]), (0.5, [1, 2, 3]), (1.0, [0, 1, 2, 3])]
)
def test_the_faintest_share_is_counted_from_below(share, found):
    """No view can judge the last one."""
    assert torch.where(faintest(torch.tensor([5.0, 2.0, 1.0, 2.0, torch.inf]), share))[0].tolist() == found


@pytest.mark.parametrize("step, at, due", [(19, "end", False), (19, "resets", True), (39, "end", True)])
def test_the_faintest_go_before_resets_or_at_the_end_of_densification(step, at, due, monkeypatch):
    monkeypatch.setattr(density_control, "STEPS_PER_VIEW", 1)
    state, frames = state_with_hidden_gaussian(faint_share=0.2, faint_at=at)
    least = state.config.densify.min_contribution
    seen = seen_by(state, frames, list(range(6)), least).most
    state.step = step
    found = visible_gaussians(state, frames)
    faint = faintest(seen, 0.2)
    assert int((faint & (seen >= least)).sum()) > 0
    assert torch.equal(found, (seen >= least) & ~faint if due else seen >= least)


def test_those_that_stay_are_judged_for_densification_by_all_their_steps(monkeypatch):
    """Newborn ones are not judged by the look: a clone is hidden behind its parent."""
    state, _ = state_with_hidden_gaussian(every=40)
    state.step = 39
    kept = torch.ones(len(state.gaussians), dtype=torch.bool)
    kept[0] = False
    state.stats.count.fill_(2.0)
    state.stats.grad_norm[:2] = 1e3
    parent = state.gaussians.means[1].detach().clone()
    control_density(state, (48, 48), kept)
    assert len(state.gaussians) == len(kept), "one gone, one of those that stay doubled"
    assert float((state.gaussians.means[-1].detach() - parent).norm()) < 2.0 and not state.stats.count.any()


def test_memory_that_ends_at_the_look_costs_no_step(monkeypatch, tmp_path):
    monkeypatch.setattr(density_control, "STEPS_PER_VIEW", 1)
    config = tiny_config(60, motion={"model": "static"}, checkpoint_seconds=1e9)
    data = tiny_dataset(6)
    fit(config, data, output=tmp_path / "whole")

    def full(*_):
        raise NotEnoughMemory("there is none")

    with monkeypatch.context() as patch, pytest.raises(NotEnoughMemory):
        patch.setattr(density_control, "seen_by", full)
        fit(config, data, output=tmp_path / "cut")
    fit(config, data, output=tmp_path / "cut", resume=True)
    files = [(tmp_path / name / "checkpoint.safetensors").read_bytes() for name in ("whole", "cut")]
    assert files[0] == files[1]


def test_switched_off_everything_stays(monkeypatch):
    monkeypatch.setattr(density_control, "STEPS_PER_VIEW", 1)
    state, frames = state_with_hidden_gaussian(min_contribution=0.0)
    state.step = 39
    assert visible_gaussians(state, frames) is None


@pytest.mark.parametrize(
    "name, steps, looks",
    [("best", 40_000, (5, 10, 15, 20)), ("cpu", 24_000, (3, 6, 9, 12)), ("quick", 7_000, (3.5,))],
)
def test_when_the_presets_look(name, steps, looks, monkeypatch):
    """In thousands of main steps, with 150 frames; ``quick`` is too short for more than one."""
    state, _ = state_with_hidden_gaussian()
    state.config, state.stage = preset(name), "main"
    monkeypatch.setattr(density_control, "seen_by", lambda *_: seen_by_all(1))
    monkeypatch.setattr(density_control, "nearest_content", lambda *_: 1.0)
    assert state.config.steps == steps
    due = []
    for step in range(0, state.config.main_steps):
        if visibility_pruning_due(state.config.densify, step + 1):
            state.step = step + state.config.pretrain_steps
            due += [(step + 1) / 1000] if visible_gaussians(state, Many()) is not None else []
    assert tuple(due) == looks


@pytest.mark.parametrize("when", ["always", "never"])
def test_large_gaussians_stay_until_the_first_reset(when, monkeypatch):
    """Before it, opacities have not separated the Gaussians that are needed from those that are not."""
    state, _ = state_with_hidden_gaussian(every=5, start=5, rounds=0, prune_large=when)
    state.stage, seen = "main", {}
    monkeypatch.setattr(
        density_control,
        "grow_and_prune",
        lambda *_, prune_large, **more: seen.setdefault(state.stage_step + 1, prune_large),
    )
    for step in range(50):
        state.step = step + state.config.pretrain_steps
        if density_due(state):
            control_density(state, (48, 48))
    later = {done: when == "always" for done in range(25, 41, 5)}
    assert state.config.densify.opacity_reset_every == 20
    assert seen == {**dict.fromkeys(range(5, 21, 5), False), **later}, "nothing after densification ends at 40"


def test_size_is_measured_by_the_cameras(device):
    """Of the same size, one is small among far cameras and large among near ones: cloned there, split here."""
    for extent, sizes in ((10.0, [0.05] * 3), (1.0, [0.05, 0.05 / 1.6, 0.05 / 1.6])):
        gaussians, optimizer = make(2, device)
        with torch.no_grad():
            gaussians.log_scales.fill_(0.05).log_()
        gradient = torch.tensor([1.0, 0.0], device=device)
        run_round(gaussians, optimizer, gradient, DensifyConfig(percent_dense=0.01), extent=extent)
        assert gaussians.scales()[:, 0].tolist() == pytest.approx(sizes)


def test_halves_are_not_judged_by_the_size_of_their_parent_on_screen():
    gaussians, optimizer = make(2, "cpu")
    with torch.no_grad():
        gaussians.log_scales.fill_(-4.0)
    stats = Stats.zeros(2, "cpu")
    stats.count.fill_(1.0)
    stats.grad_norm[0] = 1.0
    stats.max_radii[:] = 0.9
    options = {"grad_threshold": 0.5, "extent": 1.0, "prune_large": True, "random": generator(0, 1)}
    config = DensifyConfig(max_screen=0.4, percent_dense=0.01, max_scale=0.5)
    grow_and_prune(gaussians, optimizer, stats, config, **options)
    assert gaussians.log_scales[:, 0].tolist() == pytest.approx([-4.0 - math.log(1.6)] * 2), "the other one is gone"
