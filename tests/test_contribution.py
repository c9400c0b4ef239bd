"""What each Gaussian makes up of the images; what none of them shows is pruned before it can come back."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from scenes import random_camera, random_gaussians
from tiny import tiny_config, tiny_dataset

from reference import render as reference
from scgs_warp import contribution
from scgs_warp.adapt import adapt
from scgs_warp.contribution import contributions, weights_in
from scgs_warp.frames import Frames
from scgs_warp.gaussians import GaussianParameters
from scgs_warp.ops.projection import project
from scgs_warp.train_state import TrainState
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


def test_the_most_over_the_views(monkeypatch):
    state, frames = state_of()
    with torch.no_grad():
        state.gaussians.means[0] += 1e4
    posed = state.motion.gaussians_at(state.gaussians, 0.0)
    views = [weights_in(posed, camera)[0] for camera in frames.cameras]
    views = [torch.where(torch.arange(len(view)) == 0, torch.inf, view) for view in views]
    whole = contributions(state, frames)
    assert torch.equal(whole, torch.stack(views).amax(0)) and whole[-1] == 0.0
    monkeypatch.setattr(contribution, "FEWEST_VIEWS", 2)
    first, middle = frames.by_time[0], frames.by_time[3]
    assert torch.equal(contributions(state, frames), torch.maximum(views[first], views[middle]))
    state.config = replace(state.config, densify=replace(state.config.densify, opacity_reset_every=6 * 20))
    assert torch.equal(contributions(state, frames), whole)


@pytest.mark.parametrize("step, due", [(18, False), (19, True), (38, False), (39, True), (40, False), (59, False)])
def test_the_unseen_go_before_a_reset_and_at_the_end_of_densification(step, due):
    state, frames = state_of()
    seen = contributions(state, frames) >= state.config.densify.min_contribution
    assert 0 < int(seen.sum()) < len(seen)
    before = {name: getattr(state.gaussians, name).detach().clone() for name in GaussianParameters.NAMES}
    state.step = step
    adapt(state, frames, (48, 48))
    kept = seen if due else torch.ones_like(seen)
    assert torch.equal(state.gaussians.means, before["means"][kept])
    assert len(state.stats.count) == len(state.gaussians)
    faint = bool((state.gaussians.opacities() < 0.02).all())
    assert faint == (step == 19), "reset where it was due, after the look at the images"


def test_switched_off_everything_stays():
    state, frames = state_of(min_contribution=0.0)
    count = len(state.gaussians)
    state.step = 39
    adapt(state, frames, (48, 48))
    assert len(state.gaussians) == count
