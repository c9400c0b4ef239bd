"""Agreement of given cameras with the images: how far matched features are from the epipolar lines of the poses.

Features are matched between frames. A fundamental matrix that fits most of the matches, independently of the poses,
selects the matches on what stands still. Their distance from the epipolar lines of the poses is an error of the poses,
because the fitted matrix leaves only a fraction of a pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from ...data.dataset import spread
from ...geometry.epipolar import fundamental_matrix
from ..moving import sampson
from ..source_frame import shrunk

SIDE = 960
"""Longer side of the images that are compared, pixels."""
PAIRS = 12
"""Number of pairs of frames that are compared, for each distance in time."""
APART = (1, 20)
"""Distances in time: the next frame, and a twentieth of the film, over which poses have drifted."""
FEATURES = 1500
RATIO = 0.8
"""Largest ratio of the distances to the nearest and to the second nearest descriptor."""
ENOUGH = 40
"""Smallest number of matches on what stands still from which a pair is judged."""
FEWEST_PAIRS = 3
TOLERATED = 1.0
"""Error in pixels above which the poses are to be refined."""


def pose_error(
    image: Callable[[int], np.ndarray], viewmats: np.ndarray, Ks: Sequence[np.ndarray], done: Callable[[], object]
) -> float | None:
    """Return the median distance, in pixels of the images, of static features from the epipolar lines of the poses.

    Args:
        image: function from the index of a frame to [H, W, 3] uint8 RGB.
        viewmats: [V, 4, 4] world-to-camera, OpenCV.
        Ks: [3, 3] in pixels, for each frame.
        done: called for each of :func:`pairs`.

    Returns:
        None if too few pairs of frames have enough features in common.
    """
    errors = []
    for one, two in pairs(len(viewmats)):
        error = _pair_error(image(one), image(two), Ks[one], Ks[two], viewmats[two] @ np.linalg.inv(viewmats[one]))
        if error is not None:
            errors.append(error)
        done()
    return float(np.median(errors)) if len(errors) >= FEWEST_PAIRS else None


def pairs(count: int) -> list[tuple[int, int]]:
    """Return the pairs of frames, of ``count``, that are compared."""
    found: dict[tuple[int, int], None] = {}
    for step in (APART[0], max(APART[0], count // APART[1])):
        found.update(dict.fromkeys((index, index + step) for index in spread(count - step, PAIRS)))
    return list(found)


def _pair_error(
    one: np.ndarray, two: np.ndarray, K_one: np.ndarray, K_two: np.ndarray, relative: np.ndarray
) -> float | None:
    """Return the median distance of the static matches of a pair."""
    (starts, describe_one), (targets, describe_two) = _features(one), _features(two)
    if min(len(starts), len(targets)) < ENOUGH:
        return None
    matcher = cv2.BFMatcher()
    forth = matcher.knnMatch(describe_one, describe_two, k=2)
    back = matcher.match(describe_two, describe_one)
    chosen = [
        (best.queryIdx, best.trainIdx)
        for best, second in forth
        if best.distance < RATIO * second.distance and back[best.trainIdx].trainIdx == best.queryIdx
    ]
    if len(chosen) < ENOUGH:
        return None
    first, second = (np.array(column) for column in zip(*chosen))
    starts, targets = starts[first], targets[second]
    _, inside = fundamental_matrix(starts, targets, 1.0)
    if inside is None or inside.sum() < ENOUGH:
        return None
    distance = float(np.linalg.norm(relative[:3, 3]))
    if not distance > 0:  # Cameras at one place have no epipolar lines.
        return None
    x, y, z = relative[:3, 3] / distance
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix = np.linalg.inv(K_two).T @ cross @ relative[:3, :3] @ np.linalg.inv(K_one)
    return float(np.median(sampson(matrix / np.linalg.norm(matrix), starts[inside], targets[inside])))


def _features(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the places [F, 2], pixels of the image with centres at one half, and the descriptors of its features."""
    small = shrunk(image, SIDE)
    found, descriptors = cv2.SIFT.create(FEATURES).detectAndCompute(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), None)  # type: ignore[call-overload]
    if not found:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    scale = np.array([image.shape[1] / small.shape[1], image.shape[0] / small.shape[0]])
    return (np.array([point.pt for point in found]) + 0.5) * scale, descriptors
