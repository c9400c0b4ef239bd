"""Scenes of Pi3: ``predictions.npz`` of its demo, which holds points instead of depth and intrinsics.

``images [N, H, W, 3]`` in [0, 1], ``camera_poses [N, 4, 4]`` camera-to-world, ``points [N, H, W, 3]`` in the world,
``conf [N, H, W, 1]`` in [0, 1], 0 at outlines. Cameras are OpenCV's. The pixels' points determine the focal length,
which all frames share; the principal point is the centre of the image.
Layout: Wang et al., Pi3: Permutation-Equivariant Visual Geometry Learning, 2025.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ...data.dataset import spread
from ...errors import UserError
from ...storage.numpy_files import read_npy
from .scene import MAX_NUMBER, MIN_FOCAL, ImportedFrame, ImportedScene, rigid, surer
from .stacks import InOrder, Stack, floats, image_size, members, open_maps, picture

PROGRAM = "Pi3"
IMAGES, POSES, POINTS, CONFIDENCE = "images", "camera_poses", "points", "conf"
FITTED_FRAMES, FITTED_PIXELS = 24, 4000
"""Number of frames to which the focal length is fitted, and of pixels in each."""
ROUNDS = 20
"""Rounds of the fit, each of which weighs pixels by the inverse of their last error."""


def recognises(path: Path) -> bool:
    """Return whether the file holds such a scene."""
    return path.suffix.lower() == ".npz" and path.is_file() and {POSES, POINTS} <= members(path)


def read(path: Path) -> ImportedScene:
    """Read a scene; images and points stay in the file until they are asked for.

    Raises:
        UserError: an array is missing, misshapen or damaged; one line names it.
    """
    if IMAGES not in members(path):
        raise UserError(f"{path}: holds no images ({IMAGES}), which {PROGRAM} writes; export it again")
    images = Stack(path, IMAGES)
    height, width, channels_first = image_size(images)
    count, matrices = images.shape[0], read_npy(path, POSES)
    if matrices.ndim != 3 or len(matrices) != count:
        raise UserError(f"{path}: {POSES} is {list(matrices.shape)}, but there are {count} images; export it again")
    viewmats = [np.linalg.inv(rigid(matrix, f"{path}: {POSES}[{index}]")) for index, matrix in enumerate(matrices)]
    local = _local_points(path, viewmats, (count, height, width))
    focal = _focal(path, local, (count, height, width))
    K = np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
    pictures, depth_at = InOrder(images), _depths(path, local, (count, height, width))
    frames = [
        ImportedFrame(
            lambda index=index: picture(pictures.at(index), channels_first, f"{path}: {IMAGES}[{index}]"),
            viewmat,
            K,
            float(index),
            lambda index=index: depth_at(index),
        )
        for index, viewmat in enumerate(viewmats)
    ]
    return ImportedScene(PROGRAM, frames, gravity=False)


def _local_points(path: Path, viewmats: list[np.ndarray], shape: tuple[int, int, int]) -> Callable[[int], np.ndarray]:
    """Return a function that reads the points [H, W, 3] of a frame in the axes of its camera."""
    stack = Stack(path, POINTS)
    if stack.shape != (*shape, 3):
        raise UserError(
            f"{path}: {POINTS} is {list(stack.shape)}, not {[*shape, 3]}, a point for each pixel; export it again"
        )
    points = InOrder(stack)

    def at(index: int) -> np.ndarray:
        with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is unknown
            return floats(points.at(index)) @ viewmats[index][:3, :3].T + viewmats[index][:3, 3]

    return at


def _focal(path: Path, local: Callable[[int], np.ndarray], shape: tuple[int, int, int]) -> float:
    """Return the focal length in pixels with the least sum of distances between pixels and their projected points.

    Raises:
        UserError: the points determine none.
    """
    count, height, width = shape
    y, x = np.mgrid[:height, :width] + 0.5
    pixels = np.stack([x - 0.5 * width, y - 0.5 * height], axis=-1).reshape(-1, 2)
    chosen = spread(len(pixels), FITTED_PIXELS)
    rays, targets = [], []
    for index in spread(count, FITTED_FRAMES):
        points = local(index).reshape(-1, 3)[chosen]
        known = np.isfinite(points).all(axis=1) & (points[:, 2] > 1.0 / MAX_NUMBER) & (points[:, 2] < MAX_NUMBER)
        rays.append(points[known, :2] / points[known, 2:])
        targets.append(pixels[chosen][known])
    ray, target = np.concatenate(rays), np.concatenate(targets)
    near = np.abs(ray).max(axis=1, initial=0.0) < MAX_NUMBER
    ray, target, focal, weight = ray[near], target[near], 0.0, np.ones((near.sum(), 1))
    for _ in range(ROUNDS):
        norm = float((weight * ray**2).sum())
        focal = float((weight * ray * target).sum()) / norm if norm > 0.0 else 0.0
        weight = 1.0 / np.linalg.norm(focal * ray - target, axis=1, keepdims=True).clip(1e-6)
    if not MIN_FOCAL < focal < MAX_NUMBER:
        raise UserError(f"{path}: {POINTS} fit no focal length; export the scene again")
    return focal


def _depths(path: Path, local: Callable[[int], np.ndarray], shape: tuple[int, int, int]) -> Callable[[int], np.ndarray]:
    """Return a function that reads the depth [H, W] of a frame, 0 where it is unknown or least sure."""
    sureness = InOrder(open_maps(path, CONFIDENCE, shape)) if CONFIDENCE in members(path) else None

    def at(index: int) -> np.ndarray:
        depth = local(index)[..., 2]
        if sureness is None:
            return depth
        confidence = floats(sureness.at(index)).reshape(shape[1:])
        return np.where(confidence > 0.0, surer(depth, confidence, f"{path}: {CONFIDENCE}[{index}]"), 0.0)

    return at
