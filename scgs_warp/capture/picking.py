"""Selection of frames from a film: sharp frames, spread over the film's time and motion, without repetitions."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import cv2
import numpy as np

from .source_frame import SourceFrame, shrunk

SHARPNESS_SIDE = 640
"""Longer side of the images for measuring sharpness, pixels."""
FLOW_SIDE = 320
"""Longer side of the images for measuring motion, pixels."""
FASTEST_SHARE = 0.05
"""Share of the pixels, those with the fastest motion, over which motion is averaged, so that a small moving object is
noticed."""
NOISE_PIXELS = 0.15
"""Largest motion between two frames that is attributed to noise, in pixels at ``FLOW_SIDE``."""
MIN_SECONDS = 1 / 31
"""Smallest time between frames from which the next frame's motion is measured. Between the frames of a film of 240
frames per second, even a fast motion is within the noise. Time stamps of 30 frames per second are not exact."""
MIN_MOTION = 1.0
"""Motion since the previously picked frame below which a frame counts as a repetition, in pixels at ``FLOW_SIDE``."""
MIN_SHARPNESS = 0.5
"""Sharpness relative to neighbouring frames below which a frame counts as blurred."""
NEIGHBOURS = 12
"""Number of frames on each side with which a frame's sharpness is compared; they show similar content. In a film of
many frames a second, they are about ``MIN_SECONDS`` apart."""
NEIGHBOURS_QUANTILE = 0.75
"""Quantile of the neighbours' sharpness that serves as reference, high enough to detect a series of blurred frames."""


class FrameMeasures(NamedTuple):
    """Measurements of the F frames of a film."""

    index: np.ndarray
    """[F] index in the source"""
    seconds: np.ndarray
    """[F]"""
    sharpness: np.ndarray
    """[F] energy of fine detail, in squared grey levels"""
    moved: np.ndarray
    """[F] motion since the first frame beyond noise, pixels at ``FLOW_SIDE``; never falls."""


class Selection(NamedTuple):
    """The picked frames, and counts of the omitted frames."""

    places: list[int]
    """Rows of the picked frames in ``FrameMeasures``, ascending."""
    blurred: int
    """Number of frames omitted because they are blurred."""
    alike: int
    """Number of frames omitted because they repeat the previously picked one."""


def measure(stills: Iterable[SourceFrame], done: Callable[[], object] = lambda: None) -> FrameMeasures:
    """Measure sharpness and motion of every frame.

    Args:
        stills: frames in order; images larger than ``SHARPNESS_SIDE`` are reduced.
        done: called after each frame.
    """
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    rows, before, since, moved = [], None, 0.0, 0.0
    for still in stills:
        gray = cv2.cvtColor(shrunk(still.image, SHARPNESS_SIDE), cv2.COLOR_RGB2GRAY)
        small = shrunk(gray, FLOW_SIDE)
        motion = 0.0 if before is None else fastest(flow.calc(before, small, None))  # type: ignore[call-overload]
        now = moved + max(motion - NOISE_PIXELS, 0.0)
        rows.append((still.index, still.seconds, sharpness(gray), now))
        if before is None or still.seconds - since >= MIN_SECONDS:
            before, since, moved = small, still.seconds, now
        done()
    table = np.array(rows, np.float64).reshape(-1, 4)
    index, seconds, sharp, way = table.T
    return FrameMeasures(index.astype(int), seconds, sharp, np.maximum.accumulate(way))


def sharpness(gray: np.ndarray) -> float:
    """Return the mean square of the Laplacian of an image [H, W] uint8."""
    return float(np.square(cv2.Laplacian(gray, cv2.CV_32F)).mean())


def fastest(flow: np.ndarray) -> float:
    """Return the mean length of the longest vectors of a flow [H, W, 2]; ``FASTEST_SHARE`` of all vectors are
    averaged."""
    lengths = np.hypot(flow[..., 0], flow[..., 1]).ravel()
    count = max(1, round(FASTEST_SHARE * len(lengths)))
    return float(np.partition(lengths, len(lengths) - count)[-count:].mean())


def relative_sharpness(sharp: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Divide sharpness [F] by the reference sharpness of the neighbours in time [F]; 1 where that is 0."""
    interval = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 1.0
    step = max(1, round(MIN_SECONDS / max(interval, 1e-4)))
    padded = np.pad(sharp, NEIGHBOURS * step, "constant", constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEIGHBOURS * step + 1)[:, ::step]
    usual = np.nanquantile(around, NEIGHBOURS_QUANTILE, axis=1)
    return np.where(usual > 0, sharp / np.maximum(usual, 1e-12), 1.0)


def pick(measures: FrameMeasures, count: int) -> Selection:
    """Choose at most ``count`` frames.

    The film is cut into ``count`` segments of equal length, where length is the mean of the share of the film's time
    and the share of its motion. The sharpest frame of each segment is picked, unless it is blurred or repeats the
    previously picked one. If there are as many segments as frames, only blurred and repeated frames are omitted.
    """
    frames = len(measures.index)
    relative, moved = relative_sharpness(measures.sharpness, measures.seconds), measures.moved
    blurred = relative < MIN_SHARPNESS
    if count >= frames:
        stretch = np.arange(frames)
    else:
        shares = [way / way[-1] for way in (moved, measures.seconds - measures.seconds[0]) if way[-1] > 0]
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
