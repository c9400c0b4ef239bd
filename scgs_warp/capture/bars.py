"""Black bars that editing programs and players put beside a film of other proportions. They are no part of the scene:
training would turn them into black walls that move along with the camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..storage.png_files import write_png
from .source import read_rgb

BLACK = 24
"""Largest value of a channel in a bar; compression makes black uneven."""
SHOWN = 0.8
"""Least share of the pixels of the first line beside a bar that show something in the course of the film. A thing
before a dark background has no such edge. In a bar, subtitles, or the clock of a phone, may show fewer."""
EMPTY = 0.02
"""Largest share of the pixels of the last line of a bar, beyond its blurred edge, that show something."""
EDGE = 2
"""Width of the blurred edge, pixels, which is cut off as well."""
LEAST = 0.02
"""Least width of a bar, as a share of the side. Narrower borders are left to training, which ignores them."""
UNEVEN = 0.01
"""Largest difference between opposite bars, as a share of the side: a film is in the middle of its bars."""


class Bars(NamedTuple):
    """Widths to cut off, pixels."""

    top: int = 0
    bottom: int = 0
    left: int = 0
    right: int = 0

    def cut(self, image: np.ndarray) -> np.ndarray:
        """Cut them off an image [H, W, ...]."""
        height, width = image.shape[:2]
        return image[self.top : height - self.bottom, self.left : width - self.right]


def find_bars(brightest: np.ndarray) -> Bars:
    """Find the bars by the brightest value [H, W] uint8 that each pixel has in the film."""
    (top, bottom), (left, right) = _pair(brightest), _pair(brightest.T)
    return Bars(top, bottom, left, right)


def are_possible(picture: np.ndarray) -> bool:
    """Return whether the film of a picture [H, W, 3] may have bars: lines at two opposite sides are black."""
    shown = picture.max(2) > BLACK
    return any(max(lines[0].mean(), lines[-1].mean()) <= EMPTY for lines in (shown, shown.T))


def common_bars(brightest: Sequence[np.ndarray]) -> list[Bars]:
    """Find the bars of several films as :func:`find_bars` does. All films of one size that are black there have the
    same: the width of each alone is uncertain by a few pixels, and unknown beside a dark wall."""
    bars = [find_bars(each) for each in brightest]
    for shape in {each.shape for each in brightest}:
        alike = [number for number, each in enumerate(brightest) if each.shape == shape]
        widest = Bars(*(max(widths) for widths in zip(*(bars[number] for number in alike))))
        for number in alike:
            near = all(0 <= most - own <= 2 * EDGE for most, own in zip(widest, bars[number]))
            if near or _is_black(brightest[number], widest):
                bars[number] = widest
    return bars


def _is_black(brightest: np.ndarray, bars: Bars) -> bool:
    """Return whether nothing is shown in these bars, apart from their blurred edges."""
    beside = np.ones(brightest.shape, bool)
    Bars(*(max(width - EDGE - 1, 0) for width in bars)).cut(beside)[:] = False
    return float((brightest[beside] > BLACK).mean()) <= EMPTY if beside.any() else True


def _pair(brightest: np.ndarray) -> tuple[int, int]:
    """Return the widths of the bars above and below; zeros without them."""
    shares = (brightest > BLACK).mean(1)
    shown = np.flatnonzero(shares >= SHOWN)
    if not len(shown):
        return 0, 0
    height, above, below = len(shares), int(shown[0]), len(shares) - 1 - int(shown[-1])
    if min(above, below) < max(LEAST * height, EDGE + 1) or abs(above - below) > max(2, UNEVEN * height):
        return 0, 0
    if shown[-1] - shown[0] < 4 * EDGE:
        return 0, 0
    beside = max(shares[above - EDGE - 1], shares[height - below + EDGE])
    return (above + EDGE, below + EDGE) if beside <= EMPTY else (0, 0)


def cut_off(folder: Path, names: Sequence[str], bars: Bars) -> None:
    """Cut the bars off the images of these names."""
    for name in names:
        write_png(folder / name, bars.cut(read_rgb(folder / name)))
