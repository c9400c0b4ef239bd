"""Black bars beside a film are cut off; a dark scene is not taken for them."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.films import pan
from scgs_warp.capture.bars import EDGE, Bars, cut_off, find_bars
from scgs_warp.capture.source import read_rgb
from scgs_warp.storage.png_files import write_png


def brightest(top: int = 0, bottom: int = 0, left: int = 0, right: int = 0, seed: int = 0) -> np.ndarray:
    """[120 + top + bottom, 160 + left + right] of a film with bars that compression has made uneven."""
    inside = np.maximum.reduce([picture.max(2) for picture in pan(range(0, 90, 3))])
    bars = np.random.default_rng(seed).integers(0, 12, (120 + top + bottom, 160 + left + right), np.uint8)
    bars[top : top + 120, left : left + 160] = inside
    return bars


@pytest.mark.parametrize("widths", [(16, 16, 0, 0), (16, 17, 0, 0), (0, 0, 40, 40), (9, 9, 12, 12)])
def test_bars_are_found(widths):
    assert find_bars(brightest(*widths)) == tuple(width + EDGE if width else 0 for width in widths)


def test_captions_are_cut_off_with_their_bar():
    film = brightest(20, 20)
    film[6:14, 30:130] = 240  # subtitles
    film[-9:-3, 4:20] = 200  # a clock
    assert find_bars(film) == Bars(22, 22)
    assert find_bars(film.T) == Bars(0, 0, 22, 22)


@pytest.mark.parametrize("widths", [(0, 0, 0, 0), (1, 1, 0, 0), (16, 0, 0, 0), (30, 10, 0, 0)])
def test_what_is_narrow_or_on_one_side_is_left(widths):
    assert find_bars(brightest(*widths)) == Bars()


def test_dark_scenes_have_no_bars():
    assert find_bars(np.zeros((90, 160), np.uint8)) == Bars()
    y, x = np.mgrid[:90, :160]
    night = (200 * np.exp(-((x - 80) ** 2 + (y - 45) ** 2) / 900)).astype(np.uint8)
    assert find_bars(night) == Bars(), "a lamp in the dark"
    thing = np.zeros((90, 160), np.uint8)
    thing[np.hypot(x - 80, y - 45) < 30] = 220
    assert find_bars(thing) == Bars(), "a thing before black"


def test_images_are_cut(tmp_path):
    picture = np.pad(pan([0])[0], ((16, 16), (0, 0), (0, 0)))
    write_png(tmp_path / "a.png", picture)
    bars = Bars(18, 18, 0, 0)
    cut_off(tmp_path, ["a.png"], bars)
    assert np.array_equal(read_rgb(tmp_path / "a.png"), picture[18:-18]) and bars.cut(picture).shape == (116, 160, 3)
