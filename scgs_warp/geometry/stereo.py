"""Points that two cameras see at one moment: rectification, and semi-global matching."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import cv2
import numpy as np

from ..types import Camera
from .pinhole import pixels_of

ENLARGED, LARGEST_SIDE = 2.0, 1280
"""Factor by which images are enlarged for matching, because disparities are whole pixels at first; and the longer side
of an image up to which they are."""
MOST_DISPARITIES = 512
"""Largest number of disparities; the pictures are reduced to reach it."""
BLOCK = 3
"""Side of the square that is matched, pixels."""
SMOOTH, SMOOTH_EDGES, UNIQUE, SPECKLE = 4, 24, 8, 60
"""Penalties of the matcher on disparities that differ by one and by more, per channel and pixel of the square; the
least lead of the best disparity, in percent; and the area of regions that are dropped, pixels."""
LEAST_REDUCED = 0.5
"""Least focal length, as a share of the first camera's: below, depth is sought from farther on instead."""
WIDEST_TURN = 50.0
"""Largest angle, degrees, by which a camera is turned: where one stands behind the other, nothing can be matched."""
LEAST_COSINE = 0.3
"""Cosine, of the angle between a ray and the common axis, at which a picture is cut off at the latest."""
NEARER, FARTHER = 0.5, 1.2
"""Factors on the depth of the nearest and the farthest known points in view, between which depth is sought."""
FEWEST_KNOWN = 10
"""Least number of known points in view."""
NO_END = 0.5
"""Distance from the ends of the range of disparities, pixels: what is beyond it is matched there."""
LEAST_SIDE = 16
"""Least width and height of a region that is matched, pixels."""
NEIGHBORS = 2
"""Number of cameras with which each camera is paired."""
NARROWEST, WIDEST = 1.0, 40.0
"""Range of the angle between two paired cameras, as seen from the content, degrees."""


class StereoPair(NamedTuple):
    """Two cameras, turned so that each point has the same row in both pictures, and disparities begin at 0."""

    cameras: tuple[Camera, Camera]
    """On the host."""
    rotation: np.ndarray
    """[3, 3] world to the common axes, x along the baseline."""
    focal: float
    offsets: np.ndarray
    """[2, 2] (x, y) of the principal points."""
    size: tuple[int, int]
    """Common width and height of the pictures."""
    disparities: int
    """Number of disparities, a multiple of 16. As many columns on the left are empty, since the matcher skips them."""

    @staticmethod
    def of(one: Camera, two: Camera, known: np.ndarray) -> StereoPair | None:
        """Rectify two cameras.

        Args:
            known: [P, 3] points between whose depths others are sought.

        Returns:
            None if a camera would be turned too far, the pictures do not overlap, or too few known points are in view.
        """
        start, end = (camera.position.double().numpy() for camera in (one, two))
        baseline = max(float(np.linalg.norm(end - start)), 1e-12)
        x = (end - start) / baseline
        axes = [camera.viewmat[2, :3].double().numpy() for camera in (one, two)]
        y = np.cross(axes[0] + axes[1], x)
        y /= max(float(np.linalg.norm(y)), 1e-12)
        rotation = np.stack([x, y, np.cross(x, y)])
        if min(float(axis @ rotation[2]) for axis in axes) < math.cos(math.radians(WIDEST_TURN)):
            return None
        depths = _depths(one, two, known, start, rotation[2])
        (left, top), (right, bottom) = _outline(one, rotation)
        (_, other_top), (_, other_bottom) = _outline(two, rotation)
        top, bottom = max(top, other_top), min(bottom, other_bottom)
        if depths is None or bottom <= top or right <= left:
            return None
        nearest, farthest = baseline / depths[0], baseline / depths[1]
        native = float(one.K[0, 0])
        nearest = min(nearest, farthest + MOST_DISPARITIES / (LEAST_REDUCED * native))
        enlarged = min(ENLARGED, LARGEST_SIDE / max(one.width, one.height))
        focal = min(enlarged * native, MOST_DISPARITIES / (nearest - farthest))
        disparities = 16 * max(1, math.ceil(focal * (nearest - farthest) / 16.0))
        size = math.ceil(focal * (right - left)) + disparities, math.ceil(focal * (bottom - top))
        shift = disparities - focal * left
        offsets = np.array([[shift, -focal * top], [shift + focal * farthest, -focal * top]]) - 0.5
        return StereoPair((one, two), rotation, focal, offsets, size, disparities)

    def match(self, images: tuple[np.ndarray, np.ndarray], region: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Match two images [H, W, 3] uint8.

        Args:
            region: [H, W] bool, the pixels of the first image whose points are sought.

        Returns:
            Points [P, 3] in the frame of the cameras' poses, and their colours [P, 3] uint8.
        """
        sought = self._rectified(0, region.astype(np.uint8), cv2.INTER_NEAREST)
        rows, columns = (np.nonzero(sought.any(axis))[0] for axis in (1, 0))
        if not len(rows):
            return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
        top, bottom = max(rows[0] - LEAST_SIDE, 0), rows[-1] + LEAST_SIDE
        left, right = max(columns[0] - self.disparities - LEAST_SIDE, 0), columns[-1] + LEAST_SIDE
        one, two = (
            np.ascontiguousarray(self._rectified(k, image, cv2.INTER_CUBIC)[top:bottom, left:right])
            for k, image in enumerate(images)
        )
        if one.shape[1] < self.disparities + LEAST_SIDE or one.shape[0] < LEAST_SIDE:
            return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
        disparity = self._matcher().compute(one, two).astype(np.float64) / 16.0
        parallax = disparity - (self.offsets[0, 0] - self.offsets[1, 0])
        found = (
            (disparity > NO_END)
            & (disparity < self.disparities - 1 - NO_END)
            & (parallax > 1e-6)
            & (sought[top:bottom, left:right] > 0)
        )
        rows, columns = np.nonzero(found)
        start, end = (camera.position.double().numpy() for camera in self.cameras)
        depth = self.focal * float(np.linalg.norm(end - start)) / parallax[rows, columns]
        pixels = np.stack([columns + left, rows + top], 1) - self.offsets[0]
        local = np.concatenate([pixels / self.focal, np.ones((len(depth), 1))], 1) * depth[:, None]
        return local @ self.rotation + start, one[rows, columns]

    def _rectified(self, number: int, image: np.ndarray, interpolation: int) -> np.ndarray:
        return cv2.warpPerspective(image, self._homography(number), self.size, flags=interpolation)

    def _homography(self, number: int) -> np.ndarray:
        """Return the map [3, 3] from a camera's pixels to those of its picture, the first centre at (0, 0)."""
        camera = self.cameras[number]
        K = camera.K.double().numpy().copy()
        K[:2, 2] -= 0.5
        x, y = self.offsets[number]
        own = np.array([[self.focal, 0.0, x], [0.0, self.focal, y], [0.0, 0.0, 1.0]])
        return own @ self.rotation @ camera.viewmat[:3, :3].double().numpy().T @ np.linalg.inv(K)

    def _matcher(self) -> cv2.StereoSGBM:
        return cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=self.disparities,
            blockSize=BLOCK,
            P1=SMOOTH * 3 * BLOCK**2,
            P2=SMOOTH_EDGES * 3 * BLOCK**2,
            disp12MaxDiff=1,
            uniquenessRatio=UNIQUE,
            speckleWindowSize=SPECKLE,
            speckleRange=2,
            mode=cv2.StereoSGBM_MODE_SGBM_3WAY,
        )


def _depths(
    one: Camera, two: Camera, known: np.ndarray, start: np.ndarray, axis: np.ndarray
) -> tuple[float, float] | None:
    """Return the range of depths along the common axis in which points are sought; None if too few are in view."""
    seen = np.zeros(len(known), bool)
    for camera in (one, two):
        pixels, depths = pixels_of(camera, known)
        with np.errstate(invalid="ignore"):
            seen |= (depths > 0) & (pixels > -0.5).all(1) & (pixels < [camera.width - 0.5, camera.height - 0.5]).all(1)
    depths = (known[seen] - start) @ axis
    depths = depths[depths > 0]
    if len(depths) < FEWEST_KNOWN:
        return None
    return NEARER * float(np.quantile(depths, 0.01)), FARTHER * float(np.quantile(depths, 0.99))


def _outline(camera: Camera, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest x/z and y/z of a camera's pixels, as seen with other axes, in bounds."""
    width, height = camera.width, camera.height
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], np.float64)
    rays = corners @ np.linalg.inv(camera.K.double().numpy()).T @ camera.viewmat[:3, :3].double().numpy() @ rotation.T
    flat = rays[:, :2] / np.maximum(rays[:, 2:], LEAST_COSINE)
    return flat.min(0), flat.max(0)


def stereo_pairs(cameras: Mapping[int, Camera], known: np.ndarray) -> dict[tuple[int, int], StereoPair]:
    """Pair each camera with the nearest by angle, as seen from the content; return the pairs by the cameras' numbers,
    the smaller first.

    Args:
        known: [P, 3] points of the content.
    """
    numbers, pairs = list(cameras), {}
    if not len(known):
        return pairs
    rays = np.stack([cameras[number].position.double().numpy() for number in numbers]) - np.median(known, axis=0)
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    angles = np.degrees(np.arccos((rays @ rays.T).clip(-1.0, 1.0)))
    for number, own in zip(numbers, angles):
        found = 0
        for place in own.argsort(kind="stable"):
            if found == NEIGHBORS or not NARROWEST <= own[place] <= WIDEST:
                continue
            one, two = sorted((number, numbers[place]))
            pair = pairs.get((one, two)) or StereoPair.of(cameras[one], cameras[two], known)
            if pair is not None:
                pairs[one, two], found = pair, found + 1
    return pairs
