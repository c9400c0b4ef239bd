"""Contributions of Gaussians to images: values, limits, and the largest over the views."""

from __future__ import annotations

import pytest
import torch

from helpers.hidden_gaussian import state_with_hidden_gaussian
from helpers.scenes import random_camera, random_gaussians
from helpers.tiny import tiny_config, tiny_dataset
from reference import render as reference
from scgs_warp.ops.projection import project
from scgs_warp.training.frames import Frames
from scgs_warp.training.state import TrainState
from scgs_warp.training.visibility import seen_by, view_contributions
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
    got = view_contributions(random_gaussians(seed, count, device), camera.to(device))[0].cpu()
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
    found, in_view = (tensor.cpu() for tensor in view_contributions(whole, camera.to(device)))
    assert found[0] > 0.99 * 48 * 48
    assert found[2:].tolist() == [0.0] * 4 and torch.isfinite(found).all()
    assert in_view.tolist() == [True, True, True, False, False, False]


def test_no_gaussians_contribute_nothing(device):
    weights, in_view = view_contributions(random_gaussians(0, 0, device), random_camera(0, 20, 30, device))
    assert weights.shape == in_view.shape == (0,)


def test_the_most_over_the_views():
    state, frames = state_with_hidden_gaussian()
    with torch.no_grad():
        state.gaussians.means[0] += 1e4
    posed = state.motion.gaussians_at(state.gaussians, 0.0)
    views = [view_contributions(posed, camera)[0] for camera in frames.views]
    views = [torch.where(torch.arange(len(view)) == 0, torch.inf, view) for view in views]
    whole = seen_by(state, frames, list(range(6)), 0.05).most
    assert torch.equal(whole, torch.stack(views).amax(0)) and whole[-1] == 0.0
    assert torch.equal(seen_by(state, frames, [4, 1], 0.05).most, torch.maximum(views[4], views[1]))


def test_views_from_where_the_cameras_were_found_to_stand():
    config = tiny_config(60, motion={"model": "static"}, optim={"cameras": 1e-3}, coarse=0)
    data = tiny_dataset(3)
    state = TrainState.begin(config, data, "cpu")
    frames = Frames(data, state.normalisation, config, "cpu")
    before = seen_by(state, frames, [1], 0.05).most
    with torch.no_grad():
        state.cameras.twists[1, 3:] = 0.2
    corrected = state.cameras.apply(frames.views[1], 1)
    posed = state.motion.gaussians_at(state.gaussians, 0.0)
    weights, in_view = view_contributions(posed, corrected)
    after = seen_by(state, frames, [1], 0.05).most
    assert torch.equal(after, torch.where(in_view, weights, torch.inf)) and not torch.equal(after, before)
