"""Initial points of what moves before the standing cameras of a rig, in the pose of one instant.

A reconstruction's sparse points lie on what stands still, and most control points with them. At one instant, pairs of
neighbouring cameras give the depth of each pixel, movers included. A point moves if it lies in a region that changes,
in nearly all cameras that have it in view.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..data.dataset import Dataset, spread
from ..runtime.progress import progress
from ..seeding import generator
from ..types import Camera
from .flow_points import InstantPoints, strays
from .standing_cameras import StandingCamera, levels
from .stereo import StereoPair

NEIGHBORS = 2
"""Number of cameras with which each camera is paired."""
NARROWEST, WIDEST = 1.0, 40.0
"""Range of the angle between two paired cameras, as seen from the content, degrees."""
NEARER, FARTHER = 0.5, 1.2
"""Factors on the depth of the nearest and the farthest known points, between which depth is sought."""
MOST_MOMENTS, MOST_MATCHES, LEAST_MOMENTS = 24, 160, 6
"""Largest number of moments at which depth is sought; of pairs that are matched, over all moments; and the number of
moments that are sought even so."""
ENOUGH = 0.4
"""Least number of a moment's points, as a share of the largest."""
SEEING_PER_BLIND = 4
"""Number of cameras that have a moving point in view, for each that may see no change there."""


def moving_points(points: np.ndarray, standing: list[StandingCamera]) -> np.ndarray:
    """Tell which points [P, 3] lie where nearly all cameras that have them in view see something move, [P] bool."""
    seen, still = np.zeros(len(points), int), np.zeros(len(points), int)
    for one in standing:
        inside, moving = one.sees(points, one.moves)
        seen += inside
        still += inside & ~moving
    return (seen >= 2) & (still <= seen // SEEING_PER_BLIND)


class MovingCloud(NamedTuple):
    """What moves at one moment."""

    time: float
    seen: InstantPoints


class Stereo:
    """What moves before standing cameras, moment by moment."""

    def __init__(self, known: Tensor, data: Dataset, standing: list[StandingCamera]) -> None:
        """Pair the cameras.

        Args:
            known: [P, 3] sparse points of the data, in the frame of the cameras' poses.
        """
        self.data, self.standing = data, standing
        self.pairs: dict[tuple[int, int], StereoPair] = {}
        """By the cameras' numbers; none if nothing moves."""
        if sum(bool(one.moves.any()) for one in standing) >= 2:
            for one, two in _neighbors(known, standing):
                depths = _depth_range(standing[one].camera, known)
                pair = None if depths is None else StereoPair.of(standing[one].camera, standing[two].camera, depths)
                if pair is not None:
                    self.pairs[one, two] = pair

    def clouds(self, count: int, seed: int, key: int) -> list[MovingCloud]:
        """Find up to ``count`` moving points at each of several moments, from the first to the last; moments without
        enough are left out."""
        every = sorted({self.data.entries[index].time for one in self.standing for index in one.frames})
        most = min(MOST_MOMENTS, max(LEAST_MOMENTS, MOST_MATCHES // max(len(self.pairs), 1)))
        moments = [every[index] for index in spread(len(every), most)] if self.pairs else []
        found = []
        with progress(len(moments), "depth of what moves") as bar:
            for time in moments:
                found.append(MovingCloud(time, self.points_at(time, count, seed, key)))
                bar.advance()
        least = ENOUGH * max((len(cloud.seen.points) for cloud in found), default=0)
        return [cloud for cloud in found if len(cloud.seen.points) >= max(1.0, least)]

    def points_at(self, time: float, count: int, seed: int, key: int) -> InstantPoints:
        """Find the moving points of a moment, up to ``count`` of them, chosen at random; the index is that of the first
        camera's frame."""
        points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
        frames = [one.frame_at(time, self.data) for one in self.standing]
        images = [levels(self.data[frame].image) for frame in frames]
        changed = [one.changed(image) for one, image in zip(self.standing, images)]
        for (one, two), pair in self.pairs.items():
            placed, shades = pair.match((images[one], images[two]), self.standing[one].moves & changed[one])
            few = _some(len(placed), count, seed, key, frames[0], one, two)
            placed, shades = placed[few], shades[few]
            # What stands still behind a mover's path looks as usual.
            moves = moving_points(placed, self.standing) & self.standing[two].sees(placed, changed[two])[1]
            points.append(placed[moves])
            colors.append(shades[moves])
        places, shown = np.concatenate(points), np.concatenate(colors)
        kept = (~strays(places)).nonzero()[0]
        kept = kept[_some(len(kept), count, seed, key, frames[0])]
        chosen = torch.from_numpy(places[kept]).float(), torch.from_numpy(shown[kept]).float() / 255.0
        return InstantPoints(*chosen, torch.ones(len(kept), dtype=torch.bool), frames[0])


def _some(count: int, most: int, seed: int, *keys: int) -> np.ndarray:
    """Choose up to ``most`` of ``count`` numbers at random."""
    return torch.randperm(count, generator=generator(seed, *keys))[:most].numpy()


def _neighbors(known: Tensor, standing: list[StandingCamera]) -> list[tuple[int, int]]:
    """Pair each camera with its nearest others by angle: return numbers of cameras, each pair once."""
    middle = known.double().median(0).values
    rays = torch.stack([one.camera.position.double() - middle for one in standing])
    rays = torch.nn.functional.normalize(rays, dim=1)
    angles = torch.rad2deg((rays @ rays.T).clamp(-1.0, 1.0).acos())
    chosen = set()
    for one in range(len(standing)):
        near = [int(two) for two in angles[one].argsort(stable=True) if NARROWEST <= angles[one, two] <= WIDEST]
        chosen |= {(min(one, two), max(one, two)) for two in near[:NEIGHBORS]}
    return sorted(chosen)


def _depth_range(camera: Camera, known: Tensor) -> tuple[float, float] | None:
    """Return the range of depths in which points are sought; None if the camera sees no known point."""
    local = known.double() @ camera.viewmat[2, :3].double() + camera.viewmat[2, 3].double()
    ahead = local[local > 1e-3]
    if not len(ahead):
        return None
    return NEARER * float(ahead.quantile(0.01)), FARTHER * float(ahead.quantile(0.99))
