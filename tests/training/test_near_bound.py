"""Fog before a lens: Gaussians that one photo sees close, or that no second photo sees, are removed from captures."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.data.dataset import Dataset
from scgs_warp.geometry.normalisation import COMMON_RADIUS, Normalisation
from scgs_warp.training import density_control
from scgs_warp.training.automatic import resolve_auto
from scgs_warp.training.density_control import visible_gaussians
from scgs_warp.training.frames import Frames
from scgs_warp.training.initial_models import initial_motion
from scgs_warp.training.near_bound import nearest_content, network_scale
from scgs_warp.training.state import TrainState


def filled(count: int = 6):
    """Frames without alpha, as of a capture."""
    data = tiny_dataset(count)
    return type(data)([dataclasses.replace(f, alpha=None) for f in data], folder=data.folder, split="train")


def test_without_points_the_content_begins_where_all_cameras_see():
    data = filled(12)
    normalisation = Normalisation.fit(data.cameras)
    reach = torch.stack([normalisation.apply_camera(c).position.norm() for c in data.cameras])
    found = nearest_content(data, normalisation)
    assert float(reach.min()) - COMMON_RADIUS <= found + 1e-5 <= float(reach.max()) - COMMON_RADIUS + 1e-4


def test_with_points_the_content_begins_at_the_nearest():
    data = filled(12)
    data.points = torch.randn(4_000, 3, generator=torch.Generator().manual_seed(1)) * 0.2
    normalisation = Normalisation.fit(data.cameras, data.points)
    cameras = [normalisation.apply_camera(c).position for c in data.cameras]
    points = normalisation.apply(data.points)
    nearest = min(float((points - position).norm(dim=1).min()) for position in cameras)
    found = nearest_content(data, normalisation)
    middle = min(float(position.norm()) for position in cameras)
    assert nearest < found < middle
    outlier = data.points.clone()
    outlier[0] = data.cameras[0].position * 0.99
    data.points = outlier
    assert nearest_content(data, normalisation) == pytest.approx(found, rel=0.02), "a stray point does not count"
    data.points = data.points + 1e4
    assert nearest_content(data, normalisation) == 0.0, "no camera sees them"


def state_with_fog() -> tuple[TrainState, Frames, int]:
    """A capture in which one Gaussian stands close before the first lens; return its row, too."""
    data = filled(3)  # no camera stands opposite another
    config = tiny_config(60, motion={"model": "static"}, densify={"least_views": 2, "clear_distance": 0.25})
    state = TrainState.begin(config, data, "cpu")
    frames = Frames(data, state.normalisation, state.config, "cpu")
    camera = frames.views[0]
    with torch.no_grad():
        state.gaussians.means[0] = camera.position + 0.1 * camera.viewmat[2, :3]
        state.gaussians.log_scales[0] = -4.0
        state.gaussians.opacity_logits[0] = 3.0
    state.step = next(s for s in range(60) if density_control.visibility_pruning_due(state.config.densify, s + 1))
    return state, frames, 0


def kept(state: TrainState, frames: Frames, **changes) -> torch.Tensor:
    state.config = dataclasses.replace(state.config, densify=dataclasses.replace(state.config.densify, **changes))
    found = visible_gaussians(state, frames)
    assert found is not None
    return found


def test_fog_is_removed_by_either_setting_and_by_no_other(monkeypatch):
    monkeypatch.setattr(density_control, "STEPS_PER_VIEW", 1)
    state, frames, row = state_with_fog()
    before = kept(state, frames, least_views=1, clear_distance=0.0)
    assert before[row], "it contributes to a view"
    for changes in ({"least_views": 1, "clear_distance": 0.25}, {"least_views": 2, "clear_distance": 0.0}):
        after = kept(state, frames, **changes)
        assert not after[row] and bool((after <= before).all())
        assert float(after.sum()) > 0.5 * float(before.sum()), "the scene stays"


def test_a_sample_of_the_views_cannot_tell_that_no_other_sees_it(monkeypatch):
    monkeypatch.setattr(density_control, "STEPS_PER_VIEW", 1)
    monkeypatch.setattr(density_control, "MOST_VIEWS", 2)
    monkeypatch.setattr(density_control, "FEWEST_VIEWS", 1)
    state, frames, _ = state_with_fog()
    plain = kept(state, frames, least_views=1, clear_distance=0.0)
    assert torch.equal(kept(state, frames, least_views=2), plain)


def test_cut_out_subjects_are_left_alone():
    """They lose their faintest Gaussians instead."""
    config = tiny_config(60, densify={"least_views": 2, "clear_distance": 0.25, "faint_share": 0.01})
    resolved = resolve_auto(config, filled()).densify
    assert (resolved.least_views, resolved.clear_distance, resolved.faint_share) == (2, 0.25, 0.0)
    resolved = resolve_auto(config, tiny_dataset(4)).densify
    assert (resolved.least_views, resolved.clear_distance, resolved.faint_share) == (1, 0.0, 0.01)


def strip(distance: float) -> Dataset:
    """A film of a floor, two units long, by a camera that goes along it at a distance."""
    frames, generator = [], torch.Generator().manual_seed(4)
    for index, frame in enumerate(filled(9)):
        viewmat = torch.eye(4)
        viewmat[:3, 3] = torch.tensor([1.0 - 0.25 * index, 0.0, distance])
        camera = dataclasses.replace(frame.camera, viewmat=viewmat)
        frames.append(dataclasses.replace(frame, camera=camera, time=index / 8))
    points = (torch.rand(4000, 3, generator=generator) - 0.5) * torch.tensor([2.0, 0.5, 0.0])
    return Dataset(frames, folder=filled(1).folder, split="train", points=points)


@pytest.mark.parametrize(("distance", "scale"), [(4.0, 1.0), (2.0, 1.0), (1.0, 0.5), (0.25, 0.125)])
def test_the_network_learns_more_slowly_close_to_the_cameras(distance, scale):
    data = strip(distance)
    normalisation = Normalisation.identity()
    assert network_scale(data, normalisation) == pytest.approx(scale, rel=0.1)


def test_the_data_chooses_the_scale_once():
    data = strip(0.25)
    config = tiny_config(60)
    once = resolve_auto(config, data)
    assert 0.0 < once.optim.network_scale < 1.0 and resolve_auto(once, data) == once
    own = dataclasses.replace(config, optim=dataclasses.replace(config.optim, network_scale=1.0))
    assert resolve_auto(own, data).optim.network_scale == 1.0
    without = Dataset(data.entries, folder=data.folder, split="train")
    assert resolve_auto(config, without).optim.network_scale == 1.0, "no points, no distance"


def test_the_scale_is_a_factor_on_the_networks_rates_alone():
    for model in ("control-points", "per-gaussian", "hexplane"):
        whole = tiny_config(60, motion={"model": model}, optim={"network_scale": 1.0})
        slow = dataclasses.replace(whole, optim=dataclasses.replace(whole.optim, network_scale=0.25))
        motion = initial_motion(whole, torch.rand(40, 3))
        usual, own = motion.rates(20, whole), motion.rates(20, slow)
        others = ("positions", "log_radii", "hyper", "strength_logits", "planes.")
        for name, rate in usual.items():
            assert own[name] == pytest.approx((1.0 if name.startswith(others) else 0.25) * rate), name
