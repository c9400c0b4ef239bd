"""Points on everything that the cameras of a rig see at one instant, movers included: features triangulated with known
cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import cv2
import numpy as np
import torch

from ..colmap import quiet
from ..features import nearest_mutual
from .cameras import RigCamera, centre_of

MAX_ERROR = 1.5
"""Largest distance between a feature and the image of its point, pixels."""
MIN_ANGLE = 1.5
"""Smallest angle between the rays of a point, degrees."""
SAME_PLACE = 0.002
"""Distance, as a share of the median depth, within which points of several pairs of cameras are one point."""


def points_at(
    pictures: Mapping[int, np.ndarray],
    cameras: Mapping[int, RigCamera],
    most: int,
    device: str = "cpu",
    done: Callable[[], object] = lambda: None,
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate the features that two cameras have in common.

    Args:
        pictures: [H, W, 3] uint8 RGB of each camera at one instant, as recorded.
        cameras: the cameras, by the same numbers.
        most: largest number of features per picture.
        device: device of the comparison of descriptors.
        done: called after each camera and each pair.

    Returns:
        Points [P, 3] and their colours [P, 3] uint8.
    """
    with quiet() as pycolmap:
        found = {}
        for number, picture in pictures.items():
            found[number] = _features(pycolmap, picture, cameras[number], most, device)
            done()
        points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
        numbers = list(pictures)
        for i, a in enumerate(numbers):
            for b in numbers[i + 1 :]:
                matches = nearest_mutual(found[a][2], found[b][2])
                placed, kept = triangulated(cameras[a], cameras[b], found[a][1], found[b][1], matches, pycolmap)
                columns, rows = np.floor(found[a][0][matches[kept, 0]]).astype(int).T
                image = pictures[a]
                points.append(placed)
                colors.append(image[rows.clip(0, image.shape[0] - 1), columns.clip(0, image.shape[1] - 1)])
                done()
    return _merged(np.concatenate(points), np.concatenate(colors), cameras)


def _features(pycolmap: Any, picture: np.ndarray, camera: RigCamera, most: int, device: str):
    """Return pixels [N, 2], their rays [N, 2] (x/z, y/z), and descriptors [N, 128] uint8."""
    options = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    options.sift.max_num_features = most
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    keypoints, descriptors = extractor.extract_from_uint8_array(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))
    pixels = pycolmap.keypoints_to_matrix(keypoints)[:, :2].astype(np.float64)
    lens = lens_of(pycolmap, camera)
    rays = np.asarray(lens.cam_from_img(pixels), np.float64).reshape(-1, 2)
    return pixels, rays, torch.from_numpy(descriptors.data.copy()).to(device)


def lens_of(pycolmap: Any, camera: RigCamera) -> Any:
    """Make pycolmap's camera."""
    lens = pycolmap.Camera(model=camera.model, width=camera.width, height=camera.height)
    lens.params = list(camera.params)
    return lens


def triangulated(
    one: RigCamera, two: RigCamera, rays_one: np.ndarray, rays_two: np.ndarray, matches: np.ndarray, pycolmap: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate matches [M, 2] of rays [N, 2]: return the points [K, 3] that fit both cameras, and [M] bool, True for
    the matches that gave one."""
    kept = np.zeros(len(matches), bool)
    if not len(matches):
        return np.zeros((0, 3)), kept
    a, b = rays_one[matches[:, 0]], rays_two[matches[:, 1]]
    usable = np.logical_and.reduce(np.isfinite(np.concatenate([a, b], 1)), axis=1)
    a, b = np.where(usable[:, None], a, 0.0), np.where(usable[:, None], b, 0.0)
    homogeneous = cv2.triangulatePoints(one.viewmat[:3], two.viewmat[:3], a.T, b.T)
    scale = np.where(np.abs(homogeneous[3]) > 1e-12, homogeneous[3], np.nan)
    points = (homogeneous[:3] / scale).T
    good = usable & np.isfinite(points).all(1)
    points = np.where(good[:, None], points, 0.0)
    for camera, rays in ((one, a), (two, b)):
        local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        ahead = local[:, 2] > 1e-6
        focal = lens_of(pycolmap, camera).mean_focal_length()
        error = focal * np.linalg.norm(local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None] - rays, axis=1)
        good &= ahead & (error <= MAX_ERROR)
    good &= _angles(points, one, two) >= MIN_ANGLE
    kept[:] = good
    return points[good], kept


def _angles(points: np.ndarray, one: RigCamera, two: RigCamera) -> np.ndarray:
    """Return the angle [M], in degrees, between the rays to each point."""
    a, b = (centre_of(camera.viewmat) - points for camera in (one, two))
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.degrees(np.arccos(((a * b).sum(1) / np.maximum(lengths, 1e-18)).clip(-1.0, 1.0)))


def _merged(points: np.ndarray, colors: np.ndarray, cameras: Mapping[int, RigCamera]) -> tuple[np.ndarray, np.ndarray]:
    """Keep one of several points at nearly the same place."""
    if not len(points):
        return points, colors
    depths = [np.median((points @ camera.viewmat[2, :3]) + camera.viewmat[2, 3]) for camera in cameras.values()]
    cell = max(SAME_PLACE * float(np.median(depths)), 1e-12)
    _, first = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_index=True)
    first.sort()
    return points[first], colors[first]
