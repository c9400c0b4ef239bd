"""Points of what moves in a film with depth maps, moment by moment.

The depth of a pixel says where it would be seen in the frames around if it stood still. It moves if flow leads
elsewhere, in most of the pixels around it as well.
"""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import torch
from torch import Tensor

from ..data.dataset import Dataset, spread
from ..geometry.pinhole import pixels_of, ray_of
from ..runtime.progress import progress
from ..runtime.search_tree import search_tree
from ..seeding import Purpose, generator
from .clouds import LEAST_REGION, Cloud, FrameCloud, colors_at, frame_cloud, later_places, strays
from .depth import Depths
from .flow import Flows

MOST_MOMENTS = 24
"""Largest number of moments at which points are sought."""
FOLLOWED = (2, 4, 8, 16)
"""Numbers of frames over which flow is followed: afterwards, a point at rest must be where flow leads."""
LEFT, OF_PARALLAX = 0.006, 0.15
"""Distance from where flow leads beyond which a point has moved: a share of the image's longer side, plus a share of
the point's parallax against what is far away, since depth is not exact."""
TWICE = 0.2
"""Least share of a moving region's pixels that have moved in two frames: in a single one, flow may err."""
AROUND, SAME_DEPTH = 0.055, 0.04
"""Distance, as a share of the longer side of the image, and difference of the logarithm of depth, within which pixels
decide together whether they move."""
BLEEDS, NEARER = 0.05, 0.85
"""Distance from an outline, as a share of the longer side of the image, within which a pixel behind the outline may
have the flow of what is before it; and the largest depth of what is before it, as a share of the pixel's own."""
UNSURE = 0.3
"""Weight of the pixels within ``BLEEDS`` of an outline when pixels decide; others count as 1."""
MAJORITY = 0.5
"""Least weighted share of the pixels that decide together that must move."""
FEWEST, ENOUGH = 50, 0.4
"""Least number of a moment's moving pixels: as a number, and as a share of the median number. A mover that goes away
covers fewer and fewer."""
GHOST = 3.0
"""Distance to a moving point, in distances between neighbouring ones, up to which a sparse point lies on what moves."""


def depth_clouds(count: int, data: Dataset, flows: Flows, depths: Depths, seed: int) -> list[Cloud]:
    """Find up to ``count`` moving points at each of several moments; moments without enough are left out."""
    found = []
    ordered = sorted(data.with_depth, key=lambda index: data.entries[index].time)
    chosen = [ordered[each] for each in spread(len(ordered), MOST_MOMENTS)]
    later: list[Tensor | None] = []
    with progress(2 * len(chosen), "depth of what moves") as bar:
        for index in chosen:
            found.append(_cloud(index, count, data, flows, depths, seed))
            bar.advance()
        moving = [number for _, number in found if number >= FEWEST]
        least = max(FEWEST, ENOUGH * float(np.median(moving or [0])))
        kept = [each for each, number in found if number >= least]
        for one, two in itertools.pairwise(kept):
            later.append(later_places(one, two.index, flows, depths))
            bar.advance()
        bar.advance(2 * len(chosen) - len(found) - len(later))
    return [each.cloud._replace(later=there) for each, there in zip(kept, [*later, None])]


def _cloud(index: int, count: int, data: Dataset, flows: Flows, depths: Depths, seed: int) -> tuple[FrameCloud, int]:
    """Find the moving points of a frame, up to ``count`` of them, chosen at random; and the number of all."""
    seen = depths.of(index)
    assert seen is not None, "asked for frames with a depth map only"
    inverse = seen.inverse.numpy()
    pixels, points = seen.points()
    moves = _region(pixels, *_moves(index, points, pixels, flows), inverse)
    moves[moves] = ~strays(points[moves])
    every = moves.nonzero()[0]
    kept = every[torch.randperm(len(every), generator=generator(seed, Purpose.MOVING_POINTS, index))[:count].numpy()]
    colors = colors_at(data[index].image, pixels[kept], (inverse.shape[1], inverse.shape[0]))
    return frame_cloud(index, points[kept], colors, data.entries[index].time, pixels[kept]), len(every)


def _moves(index: int, points: np.ndarray, pixels: np.ndarray, flows: Flows) -> tuple[np.ndarray, np.ndarray]:
    """Follow the points [P, 3], seen at pixels [P, 2] of a frame: the number [P] of frames in which they are not where
    flow leads, and [P] bool where flow is certain in any."""
    far = ray_of(flows.camera(index), pixels)[1]
    left, certain = np.zeros(len(points), int), np.zeros(len(points), bool)
    for other, targets, sure in flows.followed(index, pixels, FOLLOWED):
        at, depth = pixels_of(other, points)
        distant = pixels_of(other, other.position.double().numpy() + far)[0]
        here = sure & (depth > 0)
        with np.errstate(invalid="ignore"):
            tolerance = LEFT * max(other.width, other.height) + OF_PARALLAX * np.linalg.norm(at - distant, axis=1)
            left += here & (np.linalg.norm(at - targets, axis=1) > tolerance)
        certain |= here
    return left, certain


def _region(pixels: np.ndarray, left: np.ndarray, certain: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Tell which pixels [P, 2] lie where most of those around, of about the same depth and with certain flow, move, in
    regions of some size, [P] bool.

    Args:
        inverse: [h, w] inverse depths; 0 where unknown.
    """
    columns, rows = pixels.astype(int).T
    sure, moving = np.zeros(inverse.shape, np.float32), np.zeros(inverse.shape, np.float32)
    weights = np.where(_beside_nearer(inverse)[rows, columns], UNSURE, 1.0) * certain
    sure[rows, columns], moving[rows, columns] = weights, (left > 0) * weights
    guide = np.log(np.maximum(inverse, 1e-12)).astype(np.float32)
    near = AROUND * max(inverse.shape)
    most, some = (
        cv2.ximgproc.jointBilateralFilter(guide, each, -1, SAME_DEPTH, near, borderType=cv2.BORDER_REPLICATE)
        for each in (moving, sure)
    )
    region = ((most > MAJORITY * some) & (inverse > 0)).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(region)
    large = stats[:, cv2.CC_STAT_AREA] >= LEAST_REGION * region.size
    twice = np.bincount(labels[rows, columns], left > 1, minlength=len(stats))
    large &= twice >= TWICE * stats[:, cv2.CC_STAT_AREA]
    large[0] = False
    return np.isin(labels[rows, columns], large.nonzero()[0])


def _beside_nearer(inverse: np.ndarray) -> np.ndarray:
    """Tell which pixels of inverse depth [h, w] are close to something clearly nearer, whose flow they have."""
    side = 2 * round(BLEEDS * max(inverse.shape)) + 1
    nearest = cv2.dilate(inverse, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))
    return nearest * NEARER > inverse


def on_movers(points: Tensor, clouds: list[Cloud]) -> Tensor:
    """Tell which sparse points [P, 3] lie where something that moves is at some moment, [P] bool."""
    near = np.zeros(len(points), bool)
    for cloud in clouds:
        tree = search_tree(cloud.points.double().numpy())
        spacing = float(np.median(tree.query(cloud.points.double().numpy(), k=2)[0][:, 1]))
        near |= tree.query(points.double().numpy())[0] < GHOST * max(spacing, 1e-9)
    return torch.from_numpy(near)
