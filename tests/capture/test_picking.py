"""Selection of frames: sharp ones, spread over time and motion, no two alike."""

from __future__ import annotations

import cv2
import numpy as np

from helpers.films import pan, wall
from scgs_warp.capture import picking
from scgs_warp.capture.source import SourceFrame


def measured(frames: list[np.ndarray]) -> picking.FrameMeasures:
    return picking.measure(SourceFrame(index, index / 30, frame, "") for index, frame in enumerate(frames))


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
