"""Properties of the edit as a value."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from scgs_warp.edit import Film, Playback
from scgs_warp.edit.document import frame_reach


@pytest.mark.parametrize(
    "playback",
    [
        Playback(),
        Playback(speed=-0.3, repeat="loop"),
        Playback(speed=3.7, start=0.2, repeat="swing"),
        Playback(freeze=0.3),
        Playback(map=((0.0, 0.2), (2.0, 0.8), (3.0, 0.4))),
    ],
)
def test_the_reach_of_a_frame_is_half_a_step(playback):
    film = Film(seconds=3.0, fps=7.0)
    times = [playback.time_at(index / film.fps, film.seconds) for index in range(film.frames)]
    steps = [abs(b - a) for a, b in pairwise(times) if a != b]
    expected = float(np.median(steps)) / 2 if steps else 5e-3
    assert frame_reach(film, playback) == pytest.approx(expected, rel=1e-8)
