"""What each Gaussian makes up of the images; what none of them shows is pruned before it can come back."""

from __future__ import annotations

import pytest
import torch

from helpers.scenes import random_camera, random_gaussians
from helpers.tiny import tiny_config, tiny_dataset
from reference import render as reference
from scgs_warp.config.presets import preset
from scgs_warp.ops.projection import project
from scgs_warp.runtime.memory import NotEnoughMemory
from scgs_warp.training import visibility
from scgs_warp.training.densify import prunes_unseen
from scgs_warp.training.density_control import adapt
from scgs_warp.training.frames import Frames
from scgs_warp.training.loop import fit
from scgs_warp.training.state import TrainState
from scgs_warp.training.visibility import contributions, seen, weights_in
from scgs_warp.types import Gaussians


@pytest.mark.parametrize(
    "seed, count, size", [(0, 60, (37, 29)), (1, 1, (16, 16)), (2, 40, (1, 50)), (3, 150, (64, 48))]
)
def test_weights_are_those_of_the_float64_twin(seed, count, size, device):
    """One channel per Gaussian, 1 for its own: the sum of that channel's image."""
    gaussians, camera = random_gaussians(seed, count), random_camera(seed, *size)
    shape = gaussians.quats, gaussians.scales, gaussians.opacities
    depths = project(gaussians.means, *shape, camera.viewmat, camera.K, *size).depths
    own = torch.eye(count, dtype=torch.float64)
    image, _, _ = reference.rasterize(
        gaussians.means, *shape, own, camera.viewmat, camera.K, *size, sort_by=depths.double()
    )
    got = weights_in(random_gaussians(seed, count, device), camera.to(device))[0].cpu()
    assert float(got.sum()) > 0.1
    torch.testing.assert_close(got, image[:-1].sum((1, 2)).float(), rtol=2e-3, atol=5e-3)


def test_nothing_of_the_hidden_the_broken_and_what_is_out_of_sight(device):
    gaussians, camera = random_gaussians(4, 6), random_camera(4, 48, 48)
    eye, forward = camera.position, camera.viewmat[2, :3]
    at = [3.0, 3.5, 4.0, -3.0, 3.9, 60.0]
    means = torch.stack([eye + distance * forward for distance in at])
    means[4, 0] = torch.nan
    means[5] += 500.0
    walls = torch.full((6, 3), 0.2)
    walls[:2] = 40.0  # two walls that let through nothing that counts
    opacities = torch.full((6,), 0.9999)
    tensors = (means, gaussians.quats, walls, opacities, gaussians.sh_dc, gaussians.sh_rest)
    whole = Gaussians(*(tensor.to(device) for tensor in tensors))
    found, in_view = (tensor.cpu() for tensor in weights_in(whole, camera.to(device)))
    assert found[0] > 0.99 * 48 * 48
    assert found[2:].tolist() == [0.0] * 4 and torch.isfinite(found).all()
    assert in_view.tolist() == [True, True, True, False, False, False]


def test_of_no_gaussians(device):
    weights, in_view = weights_in(random_gaussians(0, 0, device), random_camera(0, 20, 30, device))
    assert weights.shape == in_view.shape == (0,)


def state_of(**densify) -> tuple[TrainState, Frames]:
    """In the main stage, with the last Gaussian within the blob, where nobody sees it."""
    data = tiny_dataset(6)
    schedule = {"until": 40, "opacity_reset_every": 20, "every": 1_000, **densify}
    config = tiny_config(60, motion={"model": "static"}, densify=schedule)
    state = TrainState.begin(config, data, "cpu")
    with torch.no_grad():
        state.gaussians.opacity_logits.fill_(9.0)
        state.gaussians.log_scales.fill_(-1.0)
        state.gaussians.log_scales[-1] = -6.0
        state.gaussians.means[-1] = state.gaussians.means[:-1].mean(0)
    return state, Frames(data, state.normalisation, config, "cpu")


def test_the_most_over_the_views():
    state, frames = state_of()
    with torch.no_grad():
        state.gaussians.means[0] += 1e4
    posed = state.motion.gaussians_at(state.gaussians, 0.0)
    views = [weights_in(posed, camera)[0] for camera in frames.cameras]
    views = [torch.where(torch.arange(len(view)) == 0, torch.inf, view) for view in views]
    whole = contributions(state, frames, list(range(6)))
    assert torch.equal(whole, torch.stack(views).amax(0)) and whole[-1] == 0.0
    assert torch.equal(contributions(state, frames, [4, 1]), torch.maximum(views[4], views[1]))


def test_views_from_where_the_cameras_were_found_to_stand():
    config = tiny_config(60, motion={"model": "static"}, optim={"cameras": 1e-3}, coarse=0)
    data = tiny_dataset(3)
    state = TrainState.begin(config, data, "cpu")
    frames = Frames(data, state.normalisation, config, "cpu")
    before = contributions(state, frames, [1])
    with torch.no_grad():
        state.cameras.twists[1, 3:] = 0.2
    corrected = state.cameras.apply(frames.cameras[1], 1)
    posed = state.motion.gaussians_at(state.gaussians, 0.0)
    weights, in_view = weights_in(posed, corrected)
    after = contributions(state, frames, [1])
    assert torch.equal(after, torch.where(in_view, weights, torch.inf)) and not torch.equal(after, before)


def test_the_look_takes_views_at_random_and_not_more_than_it_may(monkeypatch):
    """Of a rig whose cameras come in the same order at every instant, others each time."""
    state, frames = state_of(opacity_reset_every=16)
    taken = []
    monkeypatch.setattr(
        visibility, "contributions", lambda state, frames, indices: taken.append(indices) or torch.ones(1)
    )
    monkeypatch.setattr(visibility, "FEWEST_VIEWS", 3)
    for per_view, step in ((4, 15), (4, 32), (4, 39), (5, 15), (6, 15)):
        monkeypatch.setattr(visibility, "STEPS_PER_VIEW", per_view)
        state.step = step
        assert (seen(state, frames) is None) == (per_view == 6 or step == 32), "4, none due, all, 3, 2 are too few"
    assert [len(set(indices)) for indices in taken] == [len(indices) for indices in taken] == [4, 6, 3]
    assert all(index in range(6) for indices in taken for index in indices)
    monkeypatch.setattr(visibility, "MOST_VIEWS", 3)
    state.step = 39
    seen(state, frames)
    assert len(taken[-1]) == 3
    assert taken[0] != taken[2][: len(taken[0])] or taken[0] != taken[1][: len(taken[0])], "the same ones at every look"


@pytest.mark.parametrize("step, due", [(18, False), (19, True), (38, False), (39, True), (40, False), (59, False)])
def test_the_unseen_go_before_a_reset_and_at_the_end_of_densification(step, due, monkeypatch):
    monkeypatch.setattr(visibility, "STEPS_PER_VIEW", 1)
    state, frames = state_of()
    kept = contributions(state, frames, list(range(6))) >= state.config.densify.min_contribution
    assert 0 < int(kept.sum()) < len(kept)
    before = state.gaussians.means.detach().clone()
    state.stats.count[:] = torch.arange(len(kept))
    state.step = step
    found = seen(state, frames)
    assert (found is not None) == due and (found is None or torch.equal(found, kept))
    adapt(state, (48, 48), found)
    stay = torch.where(kept if due else torch.ones_like(kept))[0]
    assert torch.equal(state.gaussians.means, before[stay])
    assert torch.equal(state.stats.count, stay.float()), "the others' statistics go on"
    faint = bool((state.gaussians.opacities() < 0.02).all())
    assert faint == (step == 19), "reset where it was due, after the look at the images"


def test_those_that_stay_are_judged_for_densification_by_all_their_steps(monkeypatch):
    """Newborn ones are not judged by the look: a clone is hidden behind its parent."""
    state, _ = state_of(every=40)
    state.step = 39
    kept = torch.ones(len(state.gaussians), dtype=torch.bool)
    kept[0] = False
    state.stats.count.fill_(2.0)
    state.stats.grad_norm[:2] = 1e3
    parent = state.gaussians.means[1].detach().clone()
    adapt(state, (48, 48), kept)
    assert len(state.gaussians) == len(kept), "one gone, one of those that stay doubled"
    assert float((state.gaussians.means[-1].detach() - parent).norm()) < 2.0 and not state.stats.count.any()


def test_memory_that_ends_at_the_look_costs_no_step(monkeypatch, tmp_path):
    monkeypatch.setattr(visibility, "STEPS_PER_VIEW", 1)
    config = tiny_config(60, motion={"model": "static"}, checkpoint_seconds=1e9)
    data = tiny_dataset(6)
    fit(config, data, output=tmp_path / "whole")

    def full(*_):
        raise NotEnoughMemory("there is none")

    with monkeypatch.context() as patch, pytest.raises(NotEnoughMemory):
        patch.setattr(visibility, "contributions", full)
        fit(config, data, output=tmp_path / "cut")
    fit(config, data, output=tmp_path / "cut", resume=True)
    files = [(tmp_path / name / "checkpoint.safetensors").read_bytes() for name in ("whole", "cut")]
    assert files[0] == files[1]


def test_switched_off_everything_stays(monkeypatch):
    monkeypatch.setattr(visibility, "STEPS_PER_VIEW", 1)
    state, frames = state_of(min_contribution=0.0)
    state.step = 39
    assert seen(state, frames) is None


@pytest.mark.parametrize(
    "name, steps, looks",
    [("paper", 80_000, (10, 20, 30, 40)), ("cpu", 24_000, (3, 6, 9, 12)), ("quick", 7_000, (3.5,))],
)
def test_when_the_presets_look(name, steps, looks, monkeypatch):
    """In thousands of main steps, with 150 frames; ``quick`` is too short for more than one."""
    state, _ = state_of()
    state.config, state.stage = preset(name), "main"
    monkeypatch.setattr(visibility, "contributions", lambda *_: torch.ones(1))
    assert state.config.steps == steps
    due = []
    for step in range(0, state.config.main_steps):
        if prunes_unseen(state.config.densify, step + 1):
            state.step = step + state.config.pretrain_steps
            due += [(step + 1) / 1000] if seen(state, [0] * 150) is not None else []
    assert tuple(due) == looks
