"""Which frames of a film to learn from: sharp ones, spread over its time and its motion, no two alike."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import cv2
import numpy as np

from .source import SourceFrame, shrunk

SHARPNESS_SIDE = 640
"""Longer side of the images in which sharpness is measured, pixels."""
FLOW_SIDE = 320
"""Of those in which motion is measured."""
FASTEST_SHARE = 0.05
"""Motion is that of the fastest pixels, this share of all: a small thing that moves counts in a film at rest."""
NOISE_PIXELS = 0.15
"""Motion below this between two frames, in pixels of ``FLOW_SIDE``, is noise."""
MIN_MOTION = 1.0
"""Frames that have moved by less pixels of ``FLOW_SIDE`` since the one picked before show the same again."""
MIN_SHARPNESS = 0.5
"""Sharpness below this share of what neighbours have is blur."""
NEIGHBOURS = 12
"""On each side; they show about the same things, so that their sharpness can be compared."""
NEIGHBOURS_QUANTILE = 0.75
"""The sharpness that neighbours have: high enough that a burst of blurred frames is seen to be one."""


class FrameMeasures(NamedTuple):
    """What was measured of each of F frames."""

    index: np.ndarray
    """[F] place in the source"""
    seconds: np.ndarray
    """[F]"""
    sharpness: np.ndarray
    """[F] energy of fine detail, in squared grey levels"""
    motion: np.ndarray
    """[F] since the frame before, pixels of ``FLOW_SIDE``; the first has none"""


class Selection(NamedTuple):
    places: list[int]
    """Of the picked frames in ``FrameMeasures``, ascending."""
    blurred: int
    """Frames that were too blurred."""
    alike: int
    """Frames that show what the one picked before shows."""


def measure(stills: Iterable[SourceFrame], done: Callable[[], object] = lambda: None) -> FrameMeasures:
    """Look at every frame once.

    Args:
        stills: in order; images need be no larger than ``SHARPNESS_SIDE``.
        done: called after each.
    """
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    rows, before = [], None
    for still in stills:
        gray = cv2.cvtColor(shrunk(still.image, SHARPNESS_SIDE), cv2.COLOR_RGB2GRAY)
        small = shrunk(gray, FLOW_SIDE)
        motion = 0.0 if before is None else fastest(flow.calc(before, small, None))  # type: ignore[call-overload]
        rows.append((still.index, still.seconds, sharpness(gray), motion))
        before = small
        done()
    table = np.array(rows, np.float64).reshape(-1, 4)
    return FrameMeasures(table[:, 0].astype(int), *table[:, 1:].T)


def sharpness(gray: np.ndarray) -> float:
    """Mean square of the Laplacian of [H, W] uint8."""
    return float(np.square(cv2.Laplacian(gray, cv2.CV_32F)).mean())


def fastest(flow: np.ndarray) -> float:
    """Mean length of the longest vectors of [H, W, 2], ``FASTEST_SHARE`` of all."""
    lengths = np.hypot(flow[..., 0], flow[..., 1]).ravel()
    count = max(1, round(FASTEST_SHARE * len(lengths)))
    return float(np.partition(lengths, len(lengths) - count)[-count:].mean())


def relative_sharpness(sharp: np.ndarray) -> np.ndarray:
    """[F] sharpness over what neighbours have; 1 where nobody has any."""
    padded = np.pad(sharp, NEIGHBOURS, "constant", constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEIGHBOURS + 1)
    usual = np.nanquantile(around, NEIGHBOURS_QUANTILE, axis=1)
    return np.where(usual > 0, sharp / np.maximum(usual, 1e-12), 1.0)


def pick(found: FrameMeasures, count: int) -> Selection:
    """Choose at most ``count`` frames.

    The film is cut into ``count`` stretches that hold equal shares of its time and its motion, half of each; the
    sharpest frame of a stretch is picked, if it is neither blurred nor alike to the one picked before. With as many
    stretches as frames, only blurred frames and those alike are left out.
    """
    frames = len(found.index)
    relative = relative_sharpness(found.sharpness)
    blurred = relative < MIN_SHARPNESS
    moved = np.cumsum(np.maximum(found.motion - NOISE_PIXELS, 0.0))
    if count >= frames:
        stretch = np.arange(frames)
    else:
        shares = [way / way[-1] for way in (moved, found.seconds - found.seconds[0]) if way[-1] > 0]
        way = np.mean(shares, axis=0) if shares else np.linspace(0.0, 1.0, frames)
        stretch = np.minimum((way * count).astype(int), count - 1)
    places: list[int] = []
    alike = 0
    for number in np.unique(stretch):
        members = np.flatnonzero(stretch == number)
        members = members[~blurred[members]]
        distinct = members if not places else members[moved[members] - moved[places[-1]] >= MIN_MOTION]
        alike += len(members) - len(distinct) if count >= frames or not len(distinct) else 0
        if len(distinct):
            places.append(int(distinct[relative[distinct].argmax()]))
    return Selection(places, int(blurred.sum()), alike)
