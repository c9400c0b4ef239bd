"""Masks of independently moving pixels, from optical flow that disagrees with the static scene.

Between two frames, the image of a static point moves along its epipolar line. The fundamental matrix that fits most of
the optical flow describes the camera's motion; pixels whose flow leaves the epipolar lines move independently. Motion
along the lines, such as that of a car straight ahead, is not detected; robust matching tolerates it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np

from ..geometry.epipolar import fundamental_matrix
from ..geometry.optical_flow import at_targets, targets_of, textured
from .source_frame import shrunk

FLOW_SIDE = 480
"""Longer side of the images for optical flow, pixels."""
STEPS = (-2, -1, 1, 2)
"""Offsets of the frames that each frame is compared with."""
GRID = 12
"""Spacing, in pixels, of the flow vectors from which the camera's motion is estimated."""
MIN_VECTORS = 60
"""Smallest number of flow vectors from which the camera's motion is estimated."""
MIN_LINE_DISTANCE = 1.5
"""Distance from its epipolar line, in pixels at ``FLOW_SIDE``, above which a pixel may be moving."""
TYPICAL_FACTOR = 6.0
"""Factor on the median distance from epipolar lines; a moving pixel's distance must exceed this product, too."""
MAX_ROUND_TRIP = 1.5
"""Largest distance between a pixel and its position after flow forth and back, in pixels; occluded pixels exceed it."""
MIN_AGREEMENT = 0.5
"""Smallest share of the comparisons that must find a pixel moving."""
MAX_MASK_SHARE = 0.5
"""Largest share of the frame that a mask may cover; a larger mask is discarded as a failure."""
DILATION = 0.015
"""Width by which masks are dilated, as a share of ``FLOW_SIDE``, because flow is blurred at outlines."""
MIN_AREA = 0.001
"""Smallest connected area of a mask, as a share of the frame; smaller areas are errors of the flow."""


def find_moving(load: Callable[[int], np.ndarray], count: int) -> Iterator[np.ndarray]:
    """Find the moving pixels of ``count`` frames.

    Args:
        load: function from the frame number to [H, W, 3] uint8 RGB.

    Yields:
        [H, W] bool for each frame, at the frame's size, True on moving pixels.
    """
    kept: dict[int, np.ndarray] = {}
    flows: dict[tuple[int, int], np.ndarray] = {}
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)

    def flow(one: int, two: int) -> np.ndarray:
        if (one, two) not in flows:
            flows[one, two] = search.calc(kept[one], kept[two], None)  # type: ignore[call-overload]
        return flows[one, two]

    size = (0, 0)
    for index in range(count):
        around = [index + step for step in STEPS if 0 <= index + step < count]
        for k in (index, *around):
            if k not in kept:
                image = load(k)
                kept[k], size = _gray(image), (image.shape[1], image.shape[0])
        votes, asked = np.zeros(kept[index].shape, np.float32), np.zeros(kept[index].shape, np.float32)
        for other in around:
            answer = leaves_epipolar_line(kept[index], flow(index, other), flow(other, index))
            if answer is not None:
                moves, sure = answer
                votes += moves & sure
                asked += sure
        mask = (votes >= 1) & (votes >= MIN_AGREEMENT * asked)
        yield _tidy(mask, size)
        gone = index + min(STEPS)
        kept.pop(gone, None)
        flows = {pair: vectors for pair, vectors in flows.items() if min(pair) > gone}


def _gray(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(shrunk(image, FLOW_SIDE), cv2.COLOR_RGB2GRAY)


def leaves_epipolar_line(one: np.ndarray, forth: np.ndarray, back: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the pixels of an image whose flow to another image leaves the epipolar lines.

    Args:
        one: [H, W] uint8.
        forth, back: [H, W, 2] flow from the image to the other one, and back.

    Returns:
        [H, W] bool, True for pixels that leave their epipolar lines, and [H, W] bool, True for pixels with reliable
        flow; None if the camera's motion cannot be estimated.
    """
    height, width = one.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    targets = targets_of(forth)
    returned = at_targets(back, targets)
    inside = (targets >= 0).all(2) & (targets[..., 0] < width) & (targets[..., 1] < height)
    sure = inside & (np.square(forth + returned).sum(2) < MAX_ROUND_TRIP**2) & textured(one)
    chosen = np.zeros_like(sure)
    chosen[GRID // 2 :: GRID, GRID // 2 :: GRID] = True
    chosen &= sure
    if chosen.sum() < MIN_VECTORS:
        return None
    starts = np.stack([x, y], 2)
    matrix, _ = fundamental_matrix(starts[chosen], targets[chosen], 0.5)
    if matrix is None:
        return None
    distance = sampson(matrix, starts, targets)
    limit = max(MIN_LINE_DISTANCE, TYPICAL_FACTOR * float(np.median(distance[sure])))
    return distance > limit, sure


def sampson(matrix: np.ndarray, starts: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return the Sampson distance [...], in pixels, of point pairs [..., 2] under a fundamental matrix."""
    ones = np.ones((*starts.shape[:-1], 1))
    a, b = np.concatenate([starts, ones], -1), np.concatenate([targets, ones], -1)
    lines, back = a @ matrix.T, b @ matrix
    slope = np.square(lines[..., :2]).sum(-1) + np.square(back[..., :2]).sum(-1)
    return np.abs((b * lines).sum(-1)) / np.sqrt(np.maximum(slope, 1e-18))


def _tidy(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Remove specks and holes, dilate, and resize to ``size`` (width, height); return an empty mask if it covers too
    much."""
    reach = max(1, round(DILATION * max(mask.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    pixels = cv2.medianBlur(mask.astype(np.uint8), 5)
    pixels = cv2.morphologyEx(pixels, cv2.MORPH_CLOSE, disc)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(pixels)
    large = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] >= MIN_AREA * mask.size]
    pixels = cv2.dilate(np.isin(labels, large).astype(np.uint8), disc)
    if pixels.mean() > MAX_MASK_SHARE:
        pixels[:] = 0
    return cv2.resize(pixels, size, interpolation=cv2.INTER_NEAREST).astype(bool)


def frame_name(index: int) -> str:
    """Return the file name of a picked frame, without suffix."""
    return f"frame_{index:05d}"
