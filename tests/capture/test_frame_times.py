"""Times of frames: they rise, whatever a file says."""

from __future__ import annotations

import av
import numpy as np
import pytest

from helpers.films import encoded
from scgs_warp.capture.frame_times import REORDERED, rising
from scgs_warp.capture.source import Video


def times(given, rate: float = 25.0, delay: int = 0) -> list[float]:
    found = list(rising(enumerate(given), rate, delay))
    assert [frame for frame, _ in found] == list(range(len(given))), "all frames, in order"
    return [second for _, second in found]


def test_times_that_rise_are_counted_from_the_first():
    moments = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.1, 50))
    assert times(moments) == times(moments, delay=REORDERED) == [float(second - moments[0]) for second in moments]


def test_times_in_the_order_of_decoding_are_sorted():
    assert times([0.04, 0.16, 0.12, 0.2, 0.08], delay=3) == pytest.approx([0.0, 0.04, 0.08, 0.12, 0.16])


def test_unknown_times_follow_the_rate():
    assert times([None] * 5) == [index / 25 for index in range(5)]
    assert times([3.0, None, None, 3.5, None]) == pytest.approx([0.0, 0.04, 0.08, 0.5, 0.54])


def test_times_never_fall():
    assert times([0.0, 0.04, 0.03, 0.08]) == [0.0, 0.04, 0.04, 0.08]
    assert times([0.0, 5.0, 2.0, 5.1]) == [0.0, 5.0, 5.0, 5.1], "a straggler"
    assert times([0.0, 3.0, 1.0, None, 3.12]) == pytest.approx([0.0, 3.0, 3.0, 3.08, 3.12]), "of damage"
    anew = times([9.0, 9.04, 9.08, 0.0, 0.04, 0.08, 0.5])
    assert anew == pytest.approx([0.0, 0.04, 0.08, 0.08, 0.12, 0.16, 0.58])


@pytest.mark.parametrize("name", ["film.avi", "film.mp4", "film.mkv"])
def test_h264_with_reordered_frames_keeps_its_moments(tmp_path, name):
    encoded(tmp_path / name, 40)
    with av.open(str(tmp_path / name)) as container:
        stored = [frame.time for frame in container.decode(video=0)]
    assert (stored == sorted(stored)) == (name != "film.avi"), "which knows no times of display"
    found = [still.seconds for still in Video(tmp_path / name).frames(64)]
    np.testing.assert_allclose(found, np.arange(40) / 25, atol=1e-9)
