"""Depth of a rig's frames by stereo: true to the scene, in all frames, part of training, and the same after a
checkpoint."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from helpers.ball_and_wall import SIZE, filmed, standing_camera
from helpers.ball_rig import ANGLES, HEIGHTS, MOMENTS, changed_film, place_at, rig_views, stereo_of
from helpers.steps import check_same_bits
from helpers.tiny import tiny_config
from scgs_warp.data.dataset import Dataset
from scgs_warp.errors import FrameError, UserError
from scgs_warp.geometry.stereo import StereoPair
from scgs_warp.training import stereo_depth
from scgs_warp.training.frames import Frames
from scgs_warp.training.state import TrainState
from scgs_warp.training.view import prepare

WALL, RADIUS = 2.0, 0.5
NEAR_WALL, NEAR_BALL = 0.4, 0.15
"""The wall is of blurred Gaussians, those in front of others; its texture appears 0.2 before its middle."""


@pytest.fixture(scope="module")
def film() -> Dataset:
    return filmed(rig_views(), place_at)


@pytest.fixture(scope="module")
def stereo(film):
    return stereo_of(film)


def surfaces(film: Dataset, normalisation, depths, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the depth of a frame is known [h, w], and of the known pixels the distance of their points from the wall,
    and from the ball."""
    seen = depths.of(index)
    points = seen.points()[1] / normalisation.scale + np.asarray(normalisation.centre)
    ball = np.linalg.norm(points - place_at(film.entries[index].time).double().numpy(), axis=1) - RADIUS
    return seen.inverse.numpy() > 0, np.abs(points[:, 1] - WALL), np.abs(ball)


def test_depth_is_that_of_wall_and_ball(film, stereo):
    normalisation, depths = stereo
    assert depths.available and len(depths.moments) == MOMENTS
    for index in range(0, len(film), 3):
        known, wall, ball = surfaces(film, normalisation, depths, index)
        assert known.shape == (SIZE, SIZE) and known.mean() > 0.5
        assert ((wall < NEAR_WALL) | (ball < NEAR_BALL)).mean() > 0.93
        assert 0.01 < (ball < NEAR_BALL).mean() < 0.2, "the ball is seen where it is at the time"


def test_frames_between_the_moments_have_the_depth_of_what_stands_still(film, monkeypatch):
    monkeypatch.setattr(stereo_depth, "MOST_MOMENTS", 3)
    normalisation, depths = stereo_of(film)
    assert depths.moments == [0.0, 0.5, 1.0]
    for index in range(len(film)):
        known, wall, ball = surfaces(film, normalisation, depths, index)
        assert known.mean() > 0.4 and ((wall < NEAR_WALL) | (ball < NEAR_BALL)).mean() > 0.93
        on_ball = (ball < NEAR_BALL).mean()
        assert on_ball > 0.01 if film.entries[index].time in depths.moments else on_ball < 0.005


def test_maps_between_the_moments_are_the_same_at_each_use(film, monkeypatch):
    """Which pixels are known is kept, not their depth."""
    monkeypatch.setattr(stereo_depth, "MOST_MOMENTS", 3)
    _, depths = stereo_of(film)
    between = next(index for index in range(len(film)) if film.entries[index].time not in depths.moments)
    made = []
    seen_depth = stereo_depth.seen_depth
    monkeypatch.setattr(stereo_depth, "seen_depth", lambda *args: made.append(seen_depth(*args)) or made[-1])
    first, again = depths.of(between), depths.of(between)
    assert len(made) == 1
    for seen in (first, again):
        assert torch.equal(seen.inverse, made[0].inverse)
        assert torch.equal(seen.camera.K, made[0].camera.K) and seen.camera.width == made[0].camera.width


def test_cameras_that_are_not_locked_share_their_instants():
    """Frames up to 0.45 of a frame apart are of one moment: no camera shows one frame at two of them."""
    spacing = 1.0 / (MOMENTS - 1)
    late = dict(zip(ANGLES, (0.0, 0.4, -0.4, 0.2, -0.3)))
    views = [
        (standing_camera(angle, height), min(max((moment + late[angle]) * spacing, 0.0), 1.0))
        for angle, height in zip(ANGLES, HEIGHTS)
        for moment in range(MOMENTS)
    ]
    _, depths = stereo_of(filmed(views, place_at))
    assert MOMENTS - 1 <= len(depths.moments) <= MOMENTS + 1
    for number in range(len(ANGLES)):
        shown = [depths.frames_at(time)[number] for time in depths.moments if number in depths.frames_at(time)]
        assert len(shown) >= MOMENTS - 2 and len(set(shown)) >= len(shown) - 1


@pytest.mark.parametrize(("most", "all_pairs"), [(1000, True), (14, False)])
def test_pairs_take_turns_where_there_are_many(film, monkeypatch, most, all_pairs):
    """The middle moment is matched by all pairs, the medians as well."""
    matched = []
    match = StereoPair.match
    monkeypatch.setattr(StereoPair, "match", lambda self, *args: matched.append(self) or match(self, *args))
    monkeypatch.setattr(stereo_depth, "MOST_MATCHES", most)
    _, depths = stereo_of(film)
    pairs = len(depths.pairs)
    assert pairs >= len(ANGLES) and len({id(pair) for pair in matched}) == pairs
    assert (len(matched) == pairs * (1 + MOMENTS)) == all_pairs
    assert all_pairs or len(matched) <= most + 2 * pairs + MOMENTS


def test_masked_pixels_have_no_depth(film):
    mask = torch.ones(SIZE, SIZE, dtype=torch.bool)
    mask[: SIZE // 2] = False
    masked = changed_film(film, lambda frame, _: dataclasses.replace(frame, mask=mask))
    inverse = stereo_of(masked)[1].of(3).inverse
    assert not inverse[: SIZE // 2].any() and (inverse[SIZE // 2 :] > 0).float().mean() > 0.4


def test_a_frame_that_is_gone_is_an_error_of_the_frame(film, monkeypatch):
    monkeypatch.setattr(stereo_depth, "MOST_MOMENTS", 2)
    _, depths = stereo_of(film)

    def gone(self, index):
        raise UserError("images/003.png: no such file")

    monkeypatch.setattr(Dataset, "__getitem__", gone)
    with pytest.raises(FrameError, match=r"003\.png"):
        depths.of(3)


def config(**changes):
    changes = {"init_points": 1500, "flow_points": 600, "motion": {"nodes": 32}, **changes}
    return tiny_config(40, **changes)


def test_training_compares_the_depth_by_stereo(film):
    state = TrainState.begin(config(), film, "cpu")
    assert state.stereo is not None and state.compared_stereo(film) is state.stereo
    frames = Frames(film, state.normalisation, state.config, "cpu", state.stereo)
    weights = []
    for state.step in range(4):
        view = prepare(state, frames)
        weights.append(view.depth_weight > 0.0)
        assert (view.depth is not None) == weights[-1]
        assert view.depth is None or torch.equal(view.depth.inverse, state.stereo.of(view.index).inverse)
    assert weights.count(True) == 2, "every second step"


@pytest.mark.parametrize("lack", ["off", "weight", "static", "alpha", "late", "few points"])
def test_there_is_no_stereo_where_nothing_would_be_compared(film, lack):
    changes = {
        "off": {"loss": {"stereo": False}},
        "weight": {"loss": {"depth": 0.0}},
        "static": {"motion": {"model": "static"}},
    }
    state = TrainState.begin(config(**changes.get(lack, {})), film, "cpu")
    data = film
    if lack == "alpha":
        data = changed_film(film, lambda frame, _: dataclasses.replace(frame, alpha=torch.ones(SIZE, SIZE)))
    elif lack == "few points":
        data = Dataset(tuple(film), folder=film.folder, split="train", points=film.points[:2], colors=film.colors[:2])
    elif lack == "late":
        state.step = state.config.steps - 1
    assert state.compared_stereo(data) is None


def test_stage_1_of_a_resumed_run_still_has_the_depth_of_the_main_stage(film):
    """Its own step is beyond the share of the main stage in which depth is compared."""
    state = TrainState.begin(config(pretrain={"with_points": True, "steps": 36, "warm_up": 4}), film, "cpu")
    state.step = 34
    assert state.stage == "pretrain" and state.compared_stereo(film) is not None


def test_without_points_on_movers_depth_is_found_for_the_loss(film):
    state = TrainState.begin(config(flow_points=0), film, "cpu")
    assert state.stereo is None
    found = state.compared_stereo(film)
    assert found is not None and found.available and state.compared_stereo(film) is found


def test_the_same_bits_on_any_number_of_threads_and_after_a_crash(film, tmp_path, device, all_threads, monkeypatch):
    with_stereo = check_same_bits(config(), film, tmp_path / "with", device, monkeypatch, 17)
    without = check_same_bits(config(loss={"stereo": False}), film, tmp_path / "without", device, monkeypatch, 17)
    assert with_stereo.read_bytes() != without.read_bytes()
