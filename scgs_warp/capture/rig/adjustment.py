"""Adjustment of a rig's cameras by dense matches of their still pictures.

Cameras that stand far apart share few features, so their poses are several pixels off where there are no features. The
poses are good enough for stereo, which finds nearly every pixel of a picture in the next one, along epipolar lines.
Flow between the picture and the other one, warped by these matches, then corrects the matches across these lines as
well. The matches cover the whole pictures, and all cameras are adjusted to them; better cameras give better matches.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from ...geometry.optical_flow import at_targets, dense_flow, returns, targets_of, textured
from ...geometry.pinhole import pixels_of, ray_of
from ...geometry.stereo import StereoPair, stereo_pairs
from ...types import Camera
from ..bundle_adjustment import median_error
from ..colmap import quiet, read_model, write_model
from ..features import FrameFiles
from ..source import read_rgb
from .cameras import RigCamera, solution_of, straightened
from .points import lens_of
from .writing import common_pinholes

ROUNDS = 3
"""Number of times that matches are found and cameras adjusted."""
SAMPLES = 2000
"""About the number of pixels of each picture whose matches are used, on a grid."""
FEWEST = 100
"""Least number of points, per camera on average, to which cameras are adjusted."""
LEAST_ANGLE = 0.5
"""Least angle between the rays of a point, degrees."""
HOLES = 1.5
"""Largest distance, in pixels of the pictures that stereo compares, to a pixel that it matches. These pictures may be
smaller than the views, of which it then matches every second or third pixel only."""
MOST_CORRECTED, RETURNS = 0.008, 0.001
"""Largest correction by flow, and largest distance after the way forth and back, as shares of the longer side."""
MOST_APART = 0.0125
"""Largest distance between a pixel and the image of its point before the adjustment, as a share of the longer side."""
SAME_CELL = 1.0
"""Largest distance, in pixels, between the matches of the points within one pixel."""
LOOSER, TOLERATED = 2.0, 0.5
"""Cameras are kept as they were if the median error of the features grows by this factor and beyond so many pixels."""


class _View(NamedTuple):
    """A camera without distortion, and its still picture."""

    camera: Camera
    image: np.ndarray
    """[H, W, 3] uint8 RGB."""
    still: np.ndarray
    """[H, W] bool, False where the picture may show a mover."""
    recorded: RigCamera
    """The camera with its distortion."""

    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Return rows and columns [S] of the pixels whose matches are used."""
        height, width = self.still.shape
        step = max(1, round(math.sqrt(width * height / SAMPLES)))
        rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
        return rows.ravel(), columns.ravel()


class _Match(NamedTuple):
    """Where the pixels of a view's grid are in another."""

    targets: np.ndarray
    """[S, 2] pixel positions; the centre of the first pixel is at (0, 0)."""
    sure: np.ndarray
    """[S] bool"""


class _Seen(NamedTuple):
    """Observations of points: the number of the point, the number of the camera and the pixel [2], each [O, ...]."""

    points: np.ndarray
    cameras: np.ndarray
    pixels: np.ndarray


def adjusted(model: Any, stills: FrameFiles, done: Callable[[int], object] = lambda _: None) -> Any:
    """Return a COLMAP reconstruction whose cameras and points are adjusted to dense matches.

    Args:
        model: reconstruction of the still pictures; it is not changed.
        done: called with numbers that add up to the number of pictures in each of ``ROUNDS`` rounds.

    Returns:
        The given one if too little matches, or if its features no longer fit.
    """
    before, best = median_error(copy.deepcopy(model)), model
    for _ in range(ROUNDS):
        views = _views(best, stills)
        pairs = stereo_pairs(
            {number: view.camera for number, view in views.items()}, solution_of(best, stills.names).points
        )
        seen = _gathered(views, _matches(views, pairs, done))
        points, kept = _placed(views, seen)
        if kept.sum() < FEWEST * len(views):
            break
        dense = straightened(_added(best, stills.names, views, seen, points, kept))
        best = _without(dense, len(best.points3D))
    after = median_error(copy.deepcopy(best))
    return best if after <= max(LOOSER * before, TOLERATED) else model


def adjust(folder: Path, stills: FrameFiles, target: Path, done: Callable[[int], object] = lambda _: None) -> bool:
    """Read the model in a folder, and write the adjusted one to another. Return whether they differ."""
    before = read_model(folder)
    with quiet():
        model = adjusted(before, stills, done)
    write_model(model, target)
    return model is not before


def _views(model: Any, stills: FrameFiles) -> dict[int, _View]:
    """Read the still pictures of the cameras that have poses, without their distortion."""
    solved, views = solution_of(model, stills.names).cameras, {}
    for number, (pinhole, maps) in common_pinholes(solved).items():
        name = stills.names[number]
        image = cv2.remap(read_rgb(stills.folder / name), *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        still = np.ones(image.shape[:2], bool)
        if stills.masks is not None:
            still = cv2.remap(read_rgb(stills.masks / name)[..., 0], *maps, cv2.INTER_NEAREST) >= 128
        K = [[pinhole.fx, 0.0, pinhole.cx], [0.0, pinhole.fy, pinhole.cy], [0.0, 0.0, 1.0]]
        lens = torch.tensor(K, dtype=torch.float64)
        camera = Camera(torch.from_numpy(solved[number].viewmat), lens, pinhole.width, pinhole.height)
        views[number] = _View(camera, image, still, solved[number])
    return views


def _matches(
    views: Mapping[int, _View], pairs: Mapping[tuple[int, int], StereoPair], done: Callable[[int], object]
) -> dict[tuple[int, int], _Match]:
    """Match the paired views in both directions."""
    found = {}
    for index, ((one, two), pair) in enumerate(pairs.items()):
        points = pair.match((views[one].image, views[two].image), views[one].still)[0]
        for a, b in ((one, two), (two, one)):
            reach = HOLES * float(views[a].camera.K[0, 0]) / pair.focal
            moves, known = _by_stereo(views[a].camera, views[b].camera, points, reach)
            found[a, b] = _corrected(views[a], views[b], moves, known)
        done(len(views) * (index + 1) // len(pairs) - len(views) * index // len(pairs))
    return found


def _by_stereo(one: Camera, two: Camera, points: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the displacement [H, W, 2] of pixels to another view, and where points [P, 3] within ``reach`` pixels tell
    it, [H, W] bool. Beside the points it is that of the nearest."""
    width, height = one.width, one.height
    (here, depths), (there, other_depths) = (pixels_of(camera, points) for camera in (one, two))
    cells = np.round(np.nan_to_num(here, nan=-1.0, posinf=-1.0, neginf=-1.0)).clip(-1, max(width, height)).astype(int)
    inside = (depths > 0) & (other_depths > 0) & (cells >= 0).all(1) & (cells < [width, height]).all(1)
    moves, at = (there - here)[inside], cells[inside] @ np.array([1, width])
    count = np.bincount(at, minlength=width * height)
    sums = np.stack([np.bincount(at, moves[:, axis], width * height) for axis in (0, 1)], 1)
    means = sums / np.maximum(count, 1)[:, None]
    apart = np.bincount(at, np.abs(moves - means[at]).max(1) > SAME_CELL, width * height)
    known = ((count > 0) & (apart == 0)).reshape(height, width)
    if not known.any():
        return np.zeros((height, width, 2), np.float32), known
    unknown = (~known).astype(np.uint8)
    distances, labels = cv2.distanceTransformWithLabels(unknown, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    source = np.zeros(labels.max() + 1, int)
    source[labels[known]] = np.flatnonzero(known)
    return means[source[labels]].astype(np.float32), distances <= reach


def _corrected(one: _View, two: _View, moves: np.ndarray, known: np.ndarray) -> _Match:
    """Correct displacements [H, W, 2], known at [H, W] bool, by flow to the accordingly warped picture."""
    grays = [cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY) for view in (one, two)]
    x, y = np.ascontiguousarray(targets_of(moves).transpose(2, 0, 1))
    warped = cv2.remap(grays[1], x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    flow, back = dense_flow(grays[0], warped), dense_flow(warped, grays[0])
    side = max(grays[0].shape)
    middle = targets_of(flow)
    targets = middle + at_targets(moves, middle)
    height, width = grays[1].shape
    sure = known & one.still & textured(grays[0]) & returns(flow, back, RETURNS * side)
    sure &= np.linalg.norm(flow, axis=2) < MOST_CORRECTED * side
    sure &= at_targets(known.astype(np.float32), middle) > 0.99
    sure &= at_targets(two.still.astype(np.float32), targets) > 0.99
    sure &= (targets >= 0).all(2) & (targets <= [width - 1, height - 1]).all(2)
    rows, columns = one.grid()
    return _Match(targets[rows, columns], sure[rows, columns])


def _gathered(views: Mapping[int, _View], matches: Mapping[tuple[int, int], _Match]) -> _Seen:
    """Gather the matches of the pixels of a grid in each view: a pixel and all its matches are one point."""
    parts, count = [_Seen(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))], 0
    for number, view in views.items():
        rows, columns = view.grid()
        matched = np.zeros(len(rows), bool)
        for (one, two), match in matches.items():
            if one == number:
                at = match.targets[match.sure].astype(np.float64)
                parts.append(_Seen(count + np.flatnonzero(match.sure), np.full(len(at), two), at))
                matched |= match.sure
        here = np.stack([columns, rows], 1)[matched].astype(np.float64)
        parts.append(_Seen(count + np.flatnonzero(matched), np.full(len(here), number), here))
        count += len(rows)
    return _Seen(*(np.concatenate(each) for each in zip(*parts)))


def _placed(views: Mapping[int, _View], seen: _Seen) -> tuple[np.ndarray, np.ndarray]:
    """Place points nearest to the rays of their observations, [P, 3]; tell which fit their observations, [P] bool."""
    count = int(seen.points.max(initial=-1)) + 1
    sums, targets = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for number, view in views.items():
        own = seen.cameras == number
        start, rays = ray_of(view.camera, seen.pixels[own])
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        np.add.at(sums, seen.points[own], across)
        np.add.at(targets, seen.points[own], across @ start)
    usable = np.linalg.det(sums) > 2.0 * math.sin(math.radians(LEAST_ANGLE)) ** 2
    sums[~usable] = np.eye(3)
    points = np.linalg.solve(sums, targets[..., None])[..., 0]
    for number, view in views.items():
        own = np.flatnonzero(seen.cameras == number)
        pixels, depths = pixels_of(view.camera, points[seen.points[own]])
        most = MOST_APART * max(view.camera.width, view.camera.height)
        with np.errstate(invalid="ignore"):
            fits = (depths > 0) & (np.linalg.norm(pixels - seen.pixels[own], axis=1) <= most)
        usable[seen.points[own[~fits]]] = False
    return points, usable


class _Track(NamedTuple):
    """A point, and the pixels that show it, as COLMAP counts them."""

    point: np.ndarray
    color: np.ndarray
    pixels: list[tuple[int, np.ndarray]]
    """With COLMAP's number of the picture."""


def _added(
    model: Any, names: Sequence[str], views: Mapping[int, _View], seen: _Seen, points: np.ndarray, kept: np.ndarray
) -> Any:
    """Return the reconstruction with further points [P, 3], those of [P] bool, after its own."""
    numbers = {image.name: key for key, image in model.images.items()}
    tracks = []
    for key in sorted(model.points3D):
        own = model.points3D[key]
        shown = [(each.image_id, model.images[each.image_id].points2D[each.point2D_idx]) for each in own.track.elements]
        tracks.append(_Track(own.xyz.copy(), own.color.copy(), [(image, place.xy.copy()) for image, place in shown]))
    grey = np.full(3, 128, np.uint8)
    made = {int(point): _Track(points[point], grey, []) for point in np.flatnonzero(kept)}
    for point, camera, pixel in zip(seen.points.tolist(), seen.cameras.tolist(), _recorded(views, seen)):
        if point in made:
            made[point].pixels.append((numbers[names[camera]], pixel))
    return _with_tracks(model, [*tracks, *made.values()])


def _recorded(views: Mapping[int, _View], seen: _Seen) -> np.ndarray:
    """Return the observations' pixels [O, 2] in the recorded pictures; the corner of the first is at (0, 0)."""
    pixels = np.zeros_like(seen.pixels)
    with quiet() as pycolmap:
        for number, view in views.items():
            own = seen.cameras == number
            flat = np.concatenate([seen.pixels[own] + 0.5, np.ones((int(own.sum()), 1))], 1)
            rays = flat @ np.linalg.inv(view.camera.K.numpy()).T
            pixels[own] = np.asarray(lens_of(pycolmap, view.recorded).img_from_cam(rays)).reshape(-1, 2)
    return pixels


def _with_tracks(model: Any, tracks: Sequence[_Track]) -> Any:
    """Return the reconstruction with other points."""
    made = copy.deepcopy(model)
    made.delete_all_points2D_and_points3D()
    pixels: dict[int, list[np.ndarray]] = {key: [] for key in made.images}
    with quiet() as pycolmap:
        for each in tracks:
            for image, pixel in each.pixels:
                pixels[image].append(pixel)
        for key, image in made.images.items():
            image.points2D = [pycolmap.Point2D(pixel) for pixel in pixels[key]]
        used = dict.fromkeys(pixels, 0)
        for each in tracks:
            track = pycolmap.Track()
            for image, _ in each.pixels:
                track.add_element(image, used[image])
                used[image] += 1
            made.add_point3D(each.point, track, each.color)
    return made


def _without(model: Any, count: int) -> Any:
    """Remove all points but the first ``count``, in place."""
    for key in sorted(model.points3D)[count:]:
        model.delete_point3D(key)
    return model
