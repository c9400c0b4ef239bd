"""Selection of frames: sharp ones, spread over time and motion, no two alike."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest

from helpers.films import pan, wall
from scgs_warp.capture import picking
from scgs_warp.capture.source_frame import SourceFrame


def measured(frames: list[np.ndarray], fps: float = 30) -> picking.FrameMeasures:
    return picking.measure(SourceFrame(index, index / fps, frame, "") for index, frame in enumerate(frames))


def blur(frame: np.ndarray) -> np.ndarray:
    return cv2.blur(frame, (7, 1))


def test_blurred_frames_are_left_out():
    frames = pan(range(0, 120, 3))
    smeared = {5, 6, 7, 19, 30}
    for index in smeared:
        frames[index] = blur(frames[index])
    found = measured(frames)
    everything = picking.pick(found, 1000)
    assert set(range(40)) - set(everything.places) == smeared and everything.blurred == 5
    few = picking.pick(found, 12)
    assert len(few.places) == 12 and not smeared & set(few.places)


def test_the_sharper_of_neighbours_is_picked():
    frames = pan(range(0, 120, 3))
    for index in range(1, 40, 2):
        frames[index] = cv2.GaussianBlur(frames[index], (3, 3), 0.5)
    assert all(place % 2 == 0 for place in picking.pick(measured(frames), 15).places)


def test_frames_that_show_the_same_again_are_left_out():
    shifts = [3 * (index // 4) for index in range(80)]
    picked = picking.pick(measured(pan(shifts)), 1000)
    assert [shifts[place] for place in picked.places] == sorted(set(shifts)) and picked.alike == 60
    assert picking.pick(measured(pan([0] * 30)), 10).places == [0]


def test_a_small_thing_that_moves_before_a_camera_at_rest_is_no_repetition():
    frames = pan([0] * 20)
    for index, frame in enumerate(frames):
        frame[40:70, 10 + 5 * index : 40 + 5 * index] = wall(9)[:30, :30]
    assert len(picking.pick(measured(frames), 1000).places) == 20


def test_picks_follow_time_and_motion():
    """Half of the film nearly rests: it gets about a quarter of the frames, and gaps stay bounded."""
    shifts = [*(round(0.7 * index) for index in range(100)), *(70 + 4 * index for index in range(100))]
    picked = picking.pick(measured(pan(shifts)), 40).places
    resting = sum(place < 100 for place in picked)
    assert 34 <= len(picked) <= 40 and 8 <= resting <= 18
    assert max(np.diff(picked)) <= 16
    assert picked == picking.pick(measured(pan(shifts)), 40).places


def slow_pan(fps: int) -> list[np.ndarray]:
    """Three seconds at 33 pixels a second; two moments, a sixth of a second each, are blurred."""
    background, frames = wall(height=120), []
    for index in range(3 * fps):
        shift = np.array([[1.0, 0.0, -33.0 * index / fps], [0.0, 1.0, 0.0]])
        frame = cv2.warpAffine(background, shift, (160, 120), flags=cv2.INTER_CUBIC)
        frames.append(blur(frame) if fps // 2 <= index < 2 * fps // 3 or 2 * fps <= index < 13 * fps // 6 else frame)
    return frames


@pytest.mark.parametrize("fps", [60, 120, 240])
def test_a_film_of_many_frames_a_second_is_picked_as_one_of_thirty(fps):
    """What moves slowly from frame to frame is no noise, and a series of blurred frames is one of many frames."""
    few, many = measured(slow_pan(30)), measured(slow_pan(fps), fps)
    assert np.array_equal(many.moved[:: fps // 30], few.moved) and (np.diff(many.moved) >= 0).all()
    assert few.moved[-1] > 70
    for count in (20, 45):
        expected, found = picking.pick(few, count), picking.pick(many, count)
        assert abs(len(found.places) - len(expected.places)) <= 1
        assert found.blurred == pytest.approx(expected.blurred * fps / 30, abs=4)
        times = [places.seconds[pick.places] for places, pick in ((few, expected), (many, found))]
        assert max(np.abs(times[0] - second).min() for second in times[1]) < 3 / count


@pytest.mark.parametrize("seconds", [1.0, 1 / 24, 0.033])
def test_frames_far_enough_apart_are_each_compared_with_the_one_before(seconds):
    frames = pan([0, 3, 3, 7, 8, 8, 20, 21])
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    grays = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
    flows = [flow.calc(*pair, None) for pair in pairwise(grays)]  # type: ignore[call-overload]
    steps = [0.0, *(picking.fastest(each) for each in flows)]
    expected = np.cumsum(np.maximum(np.array(steps) - picking.NOISE_PIXELS, 0.0))
    assert np.array_equal(measured(frames, 1 / seconds).moved, expected)
