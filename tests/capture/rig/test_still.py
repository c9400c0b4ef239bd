"""Still pictures of a camera, of what stands still while other things move or the light changes."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.films import pan
from scgs_warp.capture.rig.still import still_of

COUNT = 10


@pytest.mark.parametrize("first", [0, 255], ids=["black", "white"])
def test_a_film_may_begin_with_a_picture_that_shows_nothing(first):
    """All pictures were scaled to the brightness of the first one, and the still picture was black or white."""
    scene = np.random.default_rng(0).integers(40, 200, (60, 80, 3), np.uint8)
    still = still_of([np.full_like(scene, first), *[scene] * (COUNT - 1)])
    assert np.abs(still.image.astype(int) - scene).max() <= 1
    assert not still.moves.any()


def test_exposures_may_change():
    scene = np.random.default_rng(0).integers(40, 160, (60, 80, 3), np.uint8)
    pictures = [(scene * factor).astype(np.uint8) for factor in np.linspace(0.7, 1.3, COUNT)]
    still = still_of(pictures)
    assert np.abs(still.image.astype(int) - scene).max() <= 4
    assert not still.moves.any()


@pytest.mark.parametrize(
    ("places", "shift", "bump"),
    [
        ([0] * 10, 0.0, None),
        ([0] * 6 + [4] * 4, 4.0, (5, 6)),
        ([0] * 5 + [24] * 5, 24.0, (4, 5)),  # All that is not uniform is masked.
        ([0] * 9 + [3], 3.0, (8, 9)),
        (range(10), 9.0, None),
        ([0] * 3 + [5] * 3 + [10] * 4, 10.0, None),
    ],
)
def test_a_camera_that_was_moved(places, shift, bump):
    """The motion of a camera that was moved far was 0, because what it sees was masked."""
    still = still_of(pan(places, 120, 320))
    assert still.shift == pytest.approx(shift, abs=0.3)
    assert still.bump == bump


def test_movers_of_a_dark_film_do_not_move_the_camera():
    """They differ too little from the median to be masked, and have most of the corners."""
    first = (pan([0], 120, 320)[0] * 0.15).astype(np.uint8)
    pictures = [first.copy() for _ in range(6)]
    for index, picture in enumerate(pictures):
        for row, step in enumerate((3, -2, 2, -3)):
            picture[30 * row : 30 * row + 30, :200] = np.roll(first[30 * row : 30 * row + 30, :200], step * index, 1)
    still = still_of(pictures)
    assert still.moves.mean() < 0.5 and still.shift < 0.1 and still.bump is None
