"""Initial points of what moves before the standing cameras of a rig, in the pose of one instant.

A reconstruction's sparse points lie on what stands still, and most control points with them. At one instant, pairs of
neighbouring cameras give the depth of each pixel (semi-global matching), movers included. A point moves if it lies in a
region that changes, in nearly all cameras that have it in view.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from ..data.dataset import Dataset
from ..runtime.progress import progress
from ..seeding import generator
from ..types import Camera
from .flow_points import InstantPoints, strays
from .standing_cameras import StandingCamera, levels

NEIGHBORS = 2
"""Number of cameras with which each camera is paired."""
NARROWEST, WIDEST = 1.0, 40.0
"""Range of the angle between two paired cameras, as seen from the content, degrees."""
ENLARGED, LARGEST_SIDE = 2.0, 1280
"""Factor by which images are enlarged for matching, because disparities are whole pixels at first; and the longer side
of an image up to which they are."""
NEARER, FARTHER = 0.5, 1.2
"""Factors on the depth of the nearest and the farthest known points, between which depth is sought."""
MOST_DISPARITIES = 512
"""Largest number of disparities; the pictures are reduced to reach it."""
BLOCK = 3
"""Side of the square that is matched, pixels."""
SMOOTH, SMOOTH_EDGES, UNIQUE, SPECKLE = 4, 24, 8, 60
"""Penalties of the matcher on disparities that differ by one and by more, per channel and pixel of the square; the
least lead of the best disparity, in percent; and the area of regions that are dropped, pixels."""
LEAST_COSINE = 0.1
"""Cosine of the angle to the common axis up to which an image is used."""
SEEING_PER_BLIND = 4
"""Number of cameras that have a moving point in view, for each that may see no change there."""
INSTANTS = (0.5, 0.25, 0.75)
"""Instants, as shares of the film, that are tried until one has enough moving points."""


def moving_points(points: np.ndarray, standing: list[StandingCamera]) -> np.ndarray:
    """Tell which points [P, 3] lie where nearly all cameras that have them in view see something move, [P] bool."""
    seen, still = np.zeros(len(points), int), np.zeros(len(points), int)
    for one in standing:
        inside, moving = one.sees(points, one.moves)
        seen += inside
        still += inside & ~moving
    return (seen >= 2) & (still <= seen // SEEING_PER_BLIND)


def stereo_points(
    count: int, known: Tensor, data: Dataset, standing: list[StandingCamera], seed: int, key: int
) -> InstantPoints | None:
    """Find up to ``count`` points on what moves.

    Args:
        known: [P, 3] sparse points of the data, in the frame of the cameras' poses.

    Returns:
        None if nothing moves, or no two cameras stand close enough together.
    """
    if sum(bool(one.moves.any()) for one in standing) < 2:
        return None
    pairs = _pairs(known, standing)
    times = sorted(data.entries[index].time for one in standing for index in one.frames)
    found = None
    for share in INSTANTS:
        seen = _seen_at(times[round(share * (len(times) - 1))], pairs, known, data, standing)
        if found is None or len(seen.points) > len(found.points):
            found = seen
        if len(found.points) >= count:
            break
    if found is None or not len(found.points):
        return None
    kept = (~strays(found.points.numpy())).nonzero()[0]
    kept = torch.from_numpy(kept)[torch.randperm(len(kept), generator=generator(seed, key))[:count]]
    return InstantPoints(found.points[kept].float(), found.colors[kept], found.moves[kept], found.index)


def _seen_at(
    time: float,
    pairs: list[tuple[int, int]],
    known: Tensor,
    data: Dataset,
    standing: list[StandingCamera],
) -> InstantPoints:
    """Find the moving points at a moment; the index is that of the first camera's frame."""
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    images = [levels(data[one.frame_at(time, data)].image) for one in standing]
    changed = [one.changed(image) for one, image in zip(standing, images)]
    with progress(len(pairs), "depth of what moves") as bar:
        for pair in pairs:
            placed, shades = _match([(standing[one].camera, images[one]) for one in pair], known)
            moves = moving_points(placed, standing)
            for one in pair:  # what stands still behind a mover's path looks as usual
                moves &= standing[one].sees(placed, changed[one])[1]
            points.append(placed[moves])
            colors.append(shades[moves])
            bar.advance()
    places = torch.from_numpy(np.concatenate(points))
    shown = torch.from_numpy(np.concatenate(colors)).float() / 255.0
    return InstantPoints(places, shown, torch.ones(len(places), dtype=torch.bool), standing[0].frame_at(time, data))


def _pairs(known: Tensor, standing: list[StandingCamera]) -> list[tuple[int, int]]:
    """Pair each camera with its nearest others by angle: return numbers of cameras, each pair once."""
    middle = known.double().median(0).values
    rays = torch.nn.functional.normalize(
        torch.stack([one.camera.position.double() - middle for one in standing]), dim=1
    )
    angles = torch.rad2deg((rays @ rays.T).clamp(-1.0, 1.0).acos())
    chosen = set()
    for one in range(len(standing)):
        near = [int(two) for two in angles[one].argsort(stable=True) if NARROWEST <= angles[one, two] <= WIDEST]
        chosen |= {(min(one, two), max(one, two)) for two in near[:NEIGHBORS]}
    return sorted(chosen)


class _Rectified(NamedTuple):
    """Two pictures in which each point has the same row, and disparities begin at 0."""

    rotation: np.ndarray
    """[3, 3] world to the common axes, x along the baseline."""
    focal: float
    offsets: np.ndarray
    """[2, 2] (x, y) of the principal points."""
    size: tuple[int, int]
    """Common width and height."""
    disparities: int
    """Number of disparities, a multiple of 16. As many columns on the left are empty, since the matcher skips them."""


def _match(pair: list[tuple[Camera, np.ndarray]], known: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Match two images [H, W, 3] uint8 of one moment: return points [P, 3] and their colours [P, 3] uint8."""
    (one, _), (two, _) = pair
    depths = _depth_range(one, known)
    rectified = None if depths is None else _rectify(one, two, depths)
    if rectified is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    pictures = []
    for number, (camera, image) in enumerate(pair):
        matrix = _homography(rectified, number, camera)
        pictures.append(cv2.warpPerspective(image, matrix, rectified.size, flags=cv2.INTER_CUBIC))
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=rectified.disparities,
        blockSize=BLOCK,
        P1=SMOOTH * pictures[0].shape[2] * BLOCK**2,
        P2=SMOOTH_EDGES * pictures[0].shape[2] * BLOCK**2,
        disp12MaxDiff=1,
        uniquenessRatio=UNIQUE,
        speckleWindowSize=SPECKLE,
        speckleRange=2,
        mode=cv2.StereoSGBM_MODE_SGBM_3WAY,
    )
    disparity = matcher.compute(*pictures).astype(np.float64) / 16.0
    parallax = disparity - (rectified.offsets[0, 0] - rectified.offsets[1, 0])
    rows, columns = np.nonzero((disparity >= 0.0) & (parallax > 1e-6))
    start = one.position.double().numpy()
    baseline = float(np.linalg.norm(two.position.double().numpy() - start))
    depth = rectified.focal * baseline / parallax[rows, columns]
    pixels = np.stack([columns, rows], 1) - rectified.offsets[0]
    local = np.concatenate([pixels / rectified.focal, np.ones((len(depth), 1))], 1) * depth[:, None]
    return local @ rectified.rotation + start, pictures[0][rows, columns]


def _depth_range(camera: Camera, known: Tensor) -> tuple[float, float] | None:
    """Return the range of depths in which points are sought; None if the camera sees no known point."""
    local = known.double() @ camera.viewmat[2, :3].double() + camera.viewmat[2, 3].double()
    ahead = local[local > 1e-3]
    if not len(ahead):
        return None
    return NEARER * float(ahead.quantile(0.01)), FARTHER * float(ahead.quantile(0.99))


def _rectify(one: Camera, two: Camera, depths: tuple[float, float]) -> _Rectified | None:
    """Turn both cameras so that their rows lie along the baseline; None if their pictures have no row in common."""
    start, end = (camera.position.double().numpy() for camera in (one, two))
    baseline = float(np.linalg.norm(end - start))
    x = (end - start) / baseline
    y = np.cross(sum(camera.viewmat[2, :3].double().numpy() for camera in (one, two)), x)
    y /= max(float(np.linalg.norm(y)), 1e-12)
    rotation = np.stack([x, y, np.cross(x, y)])
    (left, top), (right, bottom) = _outline(one, rotation)
    (_, other_top), (_, other_bottom) = _outline(two, rotation)
    top, bottom = max(top, other_top), min(bottom, other_bottom)
    if bottom <= top or right <= left:
        return None
    nearest, farthest = baseline / depths[0], baseline / depths[1]
    enlarged = min(ENLARGED, LARGEST_SIDE / max(one.width, one.height))
    focal = min(enlarged * float(one.K[0, 0]), MOST_DISPARITIES / (nearest - farthest))
    disparities = 16 * max(1, math.ceil(focal * (nearest - farthest) / 16.0))
    size = math.ceil(focal * (right - left)) + disparities, math.ceil(focal * (bottom - top))
    shift = disparities - focal * left
    offsets = np.array([[shift, -focal * top], [shift + focal * farthest, -focal * top]]) - 0.5
    return _Rectified(rotation, focal, offsets, size, disparities)


def _outline(camera: Camera, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest x/z and y/z of a camera's pixels, as seen with other axes."""
    width, height = camera.width, camera.height
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]], np.float64)
    rays = corners @ np.linalg.inv(camera.K.double().numpy()).T @ camera.viewmat[:3, :3].double().numpy() @ rotation.T
    flat = rays[:, :2] / np.maximum(rays[:, 2:], LEAST_COSINE)
    return flat.min(0), flat.max(0)


def _homography(rectified: _Rectified, number: int, camera: Camera) -> np.ndarray:
    """Return the map [3, 3] from a camera's pixels to those of its rectified picture, the first centre at (0, 0)."""
    K = camera.K.double().numpy().copy()
    K[:2, 2] -= 0.5
    x, y = rectified.offsets[number]
    own = np.array([[rectified.focal, 0.0, x], [0.0, rectified.focal, y], [0.0, 0.0, 1.0]])
    return own @ rectified.rotation @ camera.viewmat[:3, :3].double().numpy().T @ np.linalg.inv(K)
