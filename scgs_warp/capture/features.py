"""Features of the picked frames and their matches, in COLMAP's database. Interrupted work is resumed.

pycolmap extracts the features (SIFT) and estimates two-view geometry. Descriptors are matched here, exhaustively. They
are bytes, whose products are exact in float32, so matches depend neither on the device nor on the number of threads.
COLMAP's own CPU matcher uses search trees and lacks this property.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import torch

from .colmap import damaged, database_errors, is_database, opened, quiet, remove_database
from .source import read_rgb

Tensor = torch.Tensor

CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]
Matching = Literal["auto", "sequential", "exhaustive"]
MAX_ANGLE_RATIO = 0.8
"""Largest ratio of the angle to the best descriptor to the angle to the second-best one (Lowe 2004)."""
MAX_ANGLE = 0.7
"""Largest angle between matching descriptors, radians."""
DESCRIPTOR_LENGTH = 512.0
"""Euclidean length of a descriptor of bytes."""
EXHAUSTIVE_VIDEO = 40
"""Largest number of video frames up to which every pair of frames is compared."""
EXHAUSTIVE_FOLDER = 120
"""Largest number of images of a folder up to which every pair is compared; the images need not be in order."""
NEXT_FRAMES = 8
"""Number of following frames with which a frame is compared, in addition to the frames 16, 32, 64 ... later."""
LOOP_STRIDE = 10
"""Stride of the frames among which every pair is compared, because the camera may return to a place."""
INITIAL_FOCAL = 1.2
"""Ratio of the initial focal length to the longer side if the field of view is unknown: 45 degrees."""


class FrameFiles(NamedTuple):
    """Files of the picked frames and their masks."""

    folder: Path
    """Folder of the frames."""
    names: list[str]
    """Names in the folder, in order of time; all frames have the same size and the same camera."""
    masks: Path | None
    """Folder of masks with the same names, black on moving pixels; None without masks."""
    cut_out: bool = False
    """True if the frames have alpha, and masks are black on what it hides, too."""


def begin(
    database: Path, frame_files: FrameFiles, model: CameraModel, focal: float | None, shared: bool = True
) -> None:
    """Make the database of the frames, unless it exists and holds all of them.

    Args:
        focal: focal length in pixels; None if unknown.
        shared: all frames have one camera; otherwise each has its own.

    Raises:
        UserError: the database cannot be written.
    """
    if _is_complete(database, len(frame_files.names)):
        return
    remove_database(database)  # An interrupted import left some of the frames.
    with quiet() as pycolmap, database_errors(database):
        pycolmap.Database.open(database).close()
        options = pycolmap.ImageReaderOptions(camera_model=model, default_focal_length_factor=INITIAL_FOCAL)
        if focal is not None:
            height, width = read_rgb(frame_files.folder / frame_files.names[0]).shape[:2]
            camera = pycolmap.Camera.create_from_model_name(1, model, focal, width, height)
            options.camera_params = ",".join(repr(float(value)) for value in camera.params)
        pycolmap.import_images(
            database,
            frame_files.folder,
            pycolmap.CameraMode.SINGLE if shared else pycolmap.CameraMode.PER_IMAGE,
            image_names=frame_files.names,
            options=options,
        )


def _is_complete(database: Path, count: int) -> bool:
    """Return whether the database holds ``count`` frames."""
    if not database.is_file() or not is_database(database):
        return False
    with opened(database) as (_, storage):
        return storage.num_images() == storage.num_frames() == count


def extract(database: Path, frame_files: FrameFiles, most: int, done: Callable[[], object]) -> None:
    """Extract features of every frame that has none yet, except on masked pixels.

    Args:
        most: largest number of features per frame.
        done: called after each frame.

    Raises:
        UserError: the database is damaged, or cannot be written.
    """
    with opened(database) as (pycolmap, storage):
        options = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
        options.sift.max_num_features = most
        extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
        for name, image in zip(frame_files.names, _numbers(database, storage, frame_files)):
            if not storage.exists_keypoints(image):
                gray = cv2.cvtColor(read_rgb(frame_files.folder / name), cv2.COLOR_RGB2GRAY)
                keypoints, descriptors = extractor.extract_from_uint8_array(gray)
                rows = pycolmap.keypoints_to_matrix(keypoints)
                if frame_files.masks is not None and len(rows):
                    kept = ~_masked(frame_files.masks / name, rows[:, :2])
                    rows, descriptors.data = rows[kept], descriptors.data[kept]
                if not storage.exists_descriptors(image):  # An interruption may have come between the two.
                    storage.write_descriptors(image, descriptors)
                storage.write_keypoints(image, rows)
            done()


def _numbers(database: Path, storage: Any, frame_files: FrameFiles) -> list[int]:
    """Return COLMAP's numbers of the frames; raise UserError if one is missing."""
    images = [storage.read_image_with_name(name) for name in frame_files.names]
    if any(image is None for image in images):
        raise damaged(database)
    return [image.image_id for image in images]


def _masked(file: Path, pixels: np.ndarray) -> np.ndarray:
    """Return [N] bool, True for pixels [N, 2] that are masked."""
    mask = read_rgb(file)[..., 0] < 128
    columns, rows = np.floor(pixels).astype(int).T
    return mask[rows.clip(0, mask.shape[0] - 1), columns.clip(0, mask.shape[1] - 1)]


def pairs(count: int, matching: Matching, video: bool) -> list[tuple[int, int]]:
    """Return the pairs of frames to compare among ``count`` frames, in ascending order."""
    if matching == "auto":
        matching = "exhaustive" if count <= (EXHAUSTIVE_VIDEO if video else EXHAUSTIVE_FOLDER) else "sequential"
    if matching == "exhaustive":
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    steps = [*range(1, NEXT_FRAMES + 1)]
    while 2 * steps[-1] < count:
        steps.append(2 * steps[-1])
    chosen = {(i, i + step) for i in range(count) for step in steps if i + step < count}
    chosen |= {(i, j) for i in range(0, count, LOOP_STRIDE) for j in range(i + LOOP_STRIDE, count, LOOP_STRIDE)}
    return sorted(chosen)


def match(
    database: Path,
    frame_files: FrameFiles,
    chosen: Sequence[tuple[int, int]],
    seed: int,
    device: str,
    done: Callable[..., object],
) -> None:
    """Match every pair of frames that has no matches yet, and estimate the pair's two-view geometry.

    Args:
        chosen: pairs of frame numbers, ascending.
        device: device of the comparison of descriptors.
        done: called after each pair.

    Raises:
        UserError: the database is damaged, or cannot be written.
    """
    kept: dict[int, Tensor] = {}
    with opened(database) as (pycolmap, storage):
        options = pycolmap.TwoViewGeometryOptions()
        options.ransac.random_seed = seed
        images = _numbers(database, storage, frame_files)
        points = [storage.read_keypoints(image)[:, :2].astype(np.float64) for image in images]
        cameras = [storage.read_camera(storage.read_image(image).camera_id) for image in images]
        for a, b in chosen:
            one, two = images[a], images[b]
            if not storage.exists_two_view_geometry(one, two):
                kept = {k: v for k, v in kept.items() if k >= a}  # Ascending pairs never return to earlier frames.
                for k in (a, b):
                    if k not in kept:
                        kept[k] = torch.from_numpy(storage.read_descriptors(images[k]).data.copy()).to(device)
                matches = nearest_mutual(kept[a], kept[b])
                if not storage.exists_matches(one, two):
                    storage.write_matches(one, two, matches)
                geometry = pycolmap.estimate_two_view_geometry(
                    cameras[a], points[a], cameras[b], points[b], matches, options
                )
                storage.write_two_view_geometry(one, two, geometry)
            done()


def forget(database: Path) -> None:
    """Remove all matches but keep the features."""
    with opened(database) as (_, storage):
        storage.clear_matches()
        storage.clear_two_view_geometries()


def nearest_mutual(one: Tensor, two: Tensor) -> np.ndarray:
    """Return the pairs [M, 2] uint32 of descriptors [N, 128] uint8 that are mutual nearest neighbours and pass the
    ratio test."""
    if len(one) < 2 or len(two) < 2:
        return np.zeros((0, 2), np.uint32)
    products = one.float() @ two.float().T
    rows = torch.arange(len(one), device=one.device)
    best, where = products.max(1)
    # Only mutual neighbours need the place of a column's largest product, which torch finds slowly.
    mutual = products.amax(0)[where] == best
    products[rows, where] = -torch.inf
    second_of_row = products.amax(1)
    products[rows[~mutual], where[~mutual]] = best[~mutual]
    second_of_column = products.amax(0)[where]
    # Equal descriptors are all nearest to the same one, which is then nearest to none in particular.
    alone = torch.bincount(where[mutual], minlength=len(two))[where] == 1
    chosen = rows[mutual & alone & _distinct(best, torch.maximum(second_of_row, second_of_column))]
    return torch.stack([chosen, where[chosen]], 1).cpu().numpy().astype(np.uint32)


def _distinct(best: Tensor, second: Tensor) -> Tensor:
    """Return whether the best of two products of descriptors passes the angle and ratio tests."""
    angles, others = ((product / DESCRIPTOR_LENGTH**2).clamp(-1.0, 1.0).acos() for product in (best, second))
    return (best > second) & (angles <= MAX_ANGLE) & (angles <= MAX_ANGLE_RATIO * others)


class Links(NamedTuple):
    """Statistics of the features and matches of a capture."""

    features: int
    """Median number of features per frame."""
    inliers: int
    """Median number of inlier matches between consecutive frames."""
    linked: float
    """Share of pairs of consecutive frames with inlier matches."""
    planar: float
    """Share of matched pairs explained by one homography: the camera only rotated, or saw a plane."""
    moved: float = 1.0
    """Motion of inlier matches from one frame to the other, as a share of the longer side of the frames: the median, of
    the median in each pair. It is near 0 if the camera stands still, whatever moves before it."""


def links(database: Path, frame_files: FrameFiles) -> Links:
    """Compute the statistics of the database."""
    with opened(database) as (pycolmap, storage):
        images = _numbers(database, storage, frame_files)
        features = [storage.num_keypoints_for_image(image) for image in images]
        geometries = [
            storage.read_two_view_geometry(a, b) if storage.exists_two_view_geometry(a, b) else None
            for a, b in pairwise(images)
        ]
        counts = [0 if pair is None else len(pair.inlier_matches) for pair in geometries]
        flat = _configs(pycolmap, ("PLANAR", "PANORAMIC", "PLANAR_OR_PANORAMIC"))
        numbers, found = storage.read_two_view_geometries()
        matched = [(number, pair) for number, pair in zip(numbers, found) if len(pair.inlier_matches)]
        planar = [pair.config in flat for _, pair in matched]
        points = {image: storage.read_keypoints(image)[:, :2] for image in images}
        camera = storage.read_camera(storage.read_image(images[0]).camera_id)
        moves = []
        for number, pair in matched:
            (a, b), (one, two) = pycolmap.pair_id_to_image_pair(number), pair.inlier_matches.T
            moves.append(float(np.median(np.linalg.norm(points[a][one] - points[b][two], axis=1))))
    return Links(
        int(np.median(features)) if features else 0,
        int(np.median(counts)) if counts else 0,
        float(np.mean(np.array(counts) > 0)) if counts else 0.0,
        float(np.mean(planar)) if planar else 0.0,
        float(np.median(moves)) / max(camera.width, camera.height) if moves else 1.0,
    )


def _configs(pycolmap: Any, names: Sequence[str]) -> set[int]:
    return {int(pycolmap.TwoViewGeometryConfiguration.__members__[name]) for name in names}
