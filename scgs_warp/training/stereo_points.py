"""Initial points of what moves before the standing cameras of a rig, in the pose of one instant.

A reconstruction's sparse points lie on what stands still, and most control points with them. At one instant, pairs of
neighbouring cameras give the depth of each pixel, movers included. A point moves if it lies in a region that changes,
in nearly all cameras that have it in view.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ..data.dataset import Dataset, spread
from ..runtime.progress import progress
from ..seeding import generator
from .flow_points import InstantPoints, strays
from .standing_cameras import StandingCamera, levels
from .stereo import StereoPair

NEIGHBORS = 2
"""Number of cameras with which each camera is paired."""
NARROWEST, WIDEST = 1.0, 40.0
"""Range of the angle between two paired cameras, as seen from the content, degrees."""
MOST_MOMENTS, MOST_MATCHES = 24, 160
"""Largest number of moments at which depth is sought, and about the largest number of matches in all. With more pairs
of cameras, moments take turns with them, except the middle one, where Gaussians begin."""
SPARE = 4
"""Number of points of a pair that are looked at, for each that is wanted."""
FEWEST, ENOUGH = 50, 0.4
"""Least number of a moment's points, and as a share of the largest."""
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
        if sum(bool(one.moves.any()) for one in standing) < 2:
            return
        places = known.double().numpy()
        for one, others in enumerate(_neighbors(known, standing)):
            found = 0
            for two in others:
                key = min(one, two), max(one, two)
                pair = self.pairs.get(key) or StereoPair.of(standing[key[0]].camera, standing[key[1]].camera, places)
                if pair is not None:
                    self.pairs[key], found = pair, found + 1
                if found == NEIGHBORS:
                    break

    def clouds(self, count: int, seed: int, key: int) -> list[InstantPoints]:
        """Find up to ``count`` moving points at each of several moments, from the first to the last; moments without
        enough are left out."""
        every = sorted({self.data.entries[index].time for one in self.standing for index in one.frames})
        moments = [every[index] for index in spread(len(every), MOST_MOMENTS)] if self.pairs else []
        turns = math.ceil(len(self.pairs) * len(moments) / MOST_MATCHES)
        middle = min(moments, key=lambda time: abs(time - 0.5), default=0.0)
        found = []
        with progress(len(moments), "depth of what moves") as bar:
            for number, time in enumerate(moments):
                pairs = list(self.pairs) if time == middle else list(self.pairs)[number % turns :: turns]
                found.append(self.points_at(time, count, seed, key, pairs))
                bar.advance()
        least = max(float(FEWEST), ENOUGH * max((len(cloud.points) for cloud in found), default=0))
        return [cloud for cloud in found if len(cloud.points) >= least]

    def points_at(
        self, time: float, count: int, seed: int, key: int, pairs: list[tuple[int, int]] | None = None
    ) -> InstantPoints:
        """Find the moving points of a moment, up to ``count`` of them, chosen at random.

        Args:
            pairs: those that are matched. None: all.
        """
        points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
        at = {number: one.frame_at(time, self.data) for number, one in enumerate(self.standing)}
        here = {number: index for number, index in at.items() if index is not None}
        chosen = [pair for pair in pairs or self.pairs if pair[0] in here and pair[1] in here]
        frames = {number: self.data[here[number]] for number in sorted({one for pair in chosen for one in pair})}
        images = {number: levels(frame.image) for number, frame in frames.items()}
        changed = {number: self.standing[number].changed(frame) for number, frame in frames.items()}
        for one, two in chosen:
            own = self.standing[one]
            placed, shades = self.pairs[one, two].match((images[one], images[two]), own.whole(own.moves & changed[one]))
            few = _some(len(placed), SPARE * count, seed, key, here[one], one, two)
            placed, shades = placed[few], shades[few]
            # What stands still behind a mover's path looks as usual.
            moves = moving_points(placed, self.standing) & self.standing[two].sees(placed, changed[two])[1]
            points.append(placed[moves])
            colors.append(shades[moves])
        places, shown = np.concatenate(points), np.concatenate(colors)
        kept = (~strays(places)).nonzero()[0]
        kept = kept[_some(len(kept), count, seed, key, round(time * 1e6))]
        seen = torch.from_numpy(places[kept]).float(), torch.from_numpy(shown[kept]).float() / 255.0
        return InstantPoints(*seen, torch.ones(len(kept), dtype=torch.bool), time)


def _some(count: int, most: int, seed: int, *keys: int) -> np.ndarray:
    """Choose up to ``most`` of ``count`` numbers at random."""
    return torch.randperm(count, generator=generator(seed, *keys))[:most].numpy()


def _neighbors(known: Tensor, standing: list[StandingCamera]) -> list[list[int]]:
    """Return for each camera the numbers of those that may be paired with it, the nearest by angle first."""
    middle = known.double().median(0).values
    rays = torch.stack([one.camera.position.double() - middle for one in standing])
    rays = torch.nn.functional.normalize(rays, dim=1)
    angles = torch.rad2deg((rays @ rays.T).clamp(-1.0, 1.0).acos())
    return [[int(two) for two in own.argsort(stable=True) if NARROWEST <= own[two] <= WIDEST] for own in angles]
