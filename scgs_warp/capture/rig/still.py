"""The static part of what a camera that stands still sees: a picture without movers, and a mask of where they were.

A pixel's colour is its median over time. It is masked if it differs from the median at many moments, as where somebody
lingers or leaves flutter.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from ..source_frame import shrunk

MOST_MOMENTS = 24
"""Number of moments from which the median is taken."""
DIFFERENT = 14.0
"""Difference from the median, in grey levels, at which a pixel shows something else."""
OFTEN = 0.2
"""Share of the moments that must be different for a pixel to be masked."""
DILATION = 0.012
"""Width by which masks are dilated, as a share of the longer side."""
SHIFT_SIDE = 640
"""Longer side of the pictures between which the camera's own motion is measured."""
MAX_SHIFT = 1.0
"""Motion of the camera between the first and the last moment, in pixels at ``SHIFT_SIDE``, above which it is moving."""

LEAST_CORNERS = 12
"""Least number of corners by which this motion is measured."""


class Still(NamedTuple):
    """What a camera sees when nothing moves."""

    image: np.ndarray
    """[H, W, 3] uint8 RGB, the median over time."""
    moves: np.ndarray
    """[H, W] bool, True where the median may show a mover."""
    shift: float
    """Motion of the camera itself, in pixels at ``SHIFT_SIDE``."""
    bump: tuple[int, int] | None = None
    """Numbers of the pictures before and after which the camera stands still, if it moved between them only."""


def still_of(pictures: Sequence[np.ndarray]) -> Still:
    """Combine pictures [H, W, 3] uint8 RGB of one camera at different moments."""
    levels = np.array([np.median(picture) + 1.0 for picture in pictures])
    stack = np.stack([_scaled(*each) for each in zip(pictures, (np.median(levels) / levels).tolist())])
    median = np.median(stack, axis=0).astype(np.uint8)
    gray = cv2.cvtColor(median, cv2.COLOR_RGB2GRAY).astype(np.float32)
    often = np.zeros(gray.shape, np.float32)
    for picture in stack:
        own = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32)
        often += cv2.blur(np.abs(own - gray), (3, 3)) > DIFFERENT
    moves = (often >= OFTEN * len(stack)).astype(np.uint8) if len(stack) > 1 else np.zeros(gray.shape, np.uint8)
    reach = max(1, round(DILATION * max(gray.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    moves = cv2.dilate(cv2.medianBlur(moves, 5), disc).astype(bool)
    shift = _shift(stack[0], stack[-1], moves)
    return Still(median, moves, shift, _bump(stack, moves, shift) if shift > MAX_SHIFT else None)


def _scaled(picture: np.ndarray, factor: float) -> np.ndarray:
    """Scale a picture to the usual brightness, because exposures may change. That of the first one is not usual if the
    film begins with a black picture."""
    return (picture.astype(np.float32) * factor).clip(0, 255).astype(np.uint8)


def _bump(stack: np.ndarray, moves: np.ndarray, shift: float) -> tuple[int, int] | None:
    """Return the numbers of the pictures between which nearly all of the camera's motion lies; None if it goes on for
    longer."""
    before, after = 0, len(stack) - 1
    while after - before > 1:
        middle = (before + after) // 2
        if _shift(stack[0], stack[middle], moves) > 0.5 * shift:
            after = middle
        else:
            before = middle
    rest = _shift(stack[0], stack[before], moves) + _shift(stack[after], stack[-1], moves)
    return (before, after) if rest <= MAX_SHIFT else None


def _shift(first: np.ndarray, last: np.ndarray, moves: np.ndarray) -> float:
    """Return the motion of the camera between two pictures: that which most corners share, of pixels that are static,
    or of all pixels if hardly any is static, because those of a camera that moves far differ from the median. In a dark
    picture, movers count as static."""
    one, two = (cv2.cvtColor(shrunk(picture, SHIFT_SIDE), cv2.COLOR_RGB2GRAY) for picture in (first, last))
    hidden = cv2.resize(moves.astype(np.uint8), one.shape[::-1], interpolation=cv2.INTER_NEAREST).astype(bool)
    corners = cv2.goodFeaturesToTrack(one, 400, 0.01, 6, mask=np.where(hidden, 0, 255).astype(np.uint8))
    if corners is None or len(corners) < LEAST_CORNERS:
        corners = cv2.goodFeaturesToTrack(one, 400, 0.01, 6)
    if corners is None or len(corners) < LEAST_CORNERS:
        return 0.0
    moved, found, _ = cv2.calcOpticalFlowPyrLK(one, two, corners, None)  # type: ignore[call-overload]
    before, after = (places.reshape(-1, 2)[found.ravel() == 1] for places in (corners, moved))
    if len(before) < LEAST_CORNERS:
        return 0.0
    _, shared = cv2.estimateAffinePartial2D(before, after, ransacReprojThreshold=MAX_SHIFT)
    kept = np.ones(len(before), bool) if shared is None else shared.ravel() == 1
    return float(np.median(np.linalg.norm((after - before)[kept], axis=1))) if kept.any() else 0.0
