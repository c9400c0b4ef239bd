"""Initial points of what moves before the standing cameras of a rig, moment by moment.

A reconstruction's sparse points lie on what stands still, and most control points with them. Stereo gives the depth of
each pixel, movers included. A point moves if it lies in a region that changes, in nearly all cameras that have it in
view. Flow in the images of its own camera tells where it is at the following moment.
"""

from __future__ import annotations

import itertools

import numpy as np
import torch

from ..data.dataset import spread
from ..runtime.progress import progress
from ..seeding import Purpose, generator
from .clouds import Cloud, FrameCloud, colors_at, frame_cloud, later_places, strays
from .flow import Flows
from .standing_cameras import StandingCamera
from .stereo_depth import StereoDepths

FEWEST, ENOUGH = 50, 0.4
"""Least number of a moment's points: as a number, and as a share of the largest number of any moment."""
MOST_FOLLOWED = 1500
"""About the largest number of frames between which flow is measured: of a large rig, only some cameras are followed, at
least two."""
SEEING_PER_BLIND = 4
"""Number of cameras that have a moving point in view, for each that may see no change there."""


def moving_points(
    points: np.ndarray, standing: list[StandingCamera], regions: list[np.ndarray] | None = None
) -> np.ndarray:
    """Tell which points [P, 3] lie where nearly all cameras that have them in view see something move, [P] bool.

    Args:
        regions: [h, w] bool of each camera, where it sees something move. None: in the course of time.
    """
    seen, still = np.zeros(len(points), int), np.zeros(len(points), int)
    for one, region in zip(standing, regions or [one.moves for one in standing]):
        inside, moving = one.sees(points, region)
        seen += inside
        still += inside & ~moving
    return (seen >= 2) & (still <= seen // SEEING_PER_BLIND)


def stereo_clouds(stereo: StereoDepths, flows: Flows, count: int, seed: int) -> list[Cloud]:
    """Find up to ``count`` moving points at each of several moments, from the first to the last; moments without enough
    are left out."""
    if sum(bool(one.moves.any()) for one in stereo.standing) < 2:
        return []
    found: list[dict[int, FrameCloud]] = []
    with progress(2 * len(stereo.moments), "points of what moves") as bar:
        for time in stereo.moments:
            found.append(_moment(time, stereo, count, seed))
            bar.advance()
        sizes = [sum(len(each.cloud.points) for each in moment.values()) for moment in found]
        least = max(float(FEWEST), ENOUGH * max(sizes, default=0))
        kept = [(time, moment) for time, moment, size in zip(stereo.moments, found, sizes) if size >= least]
        clouds = []
        for (time, moment), following in itertools.zip_longest(kept, kept[1:]):
            cloud = _joined(moment, time)
            if following is not None:
                ends = _followed(moment, following[1], stereo)
                later = [_later(each, ends.get(number), flows, stereo) for number, each in moment.items()]
                cloud = cloud._replace(later=torch.cat(later))
            clouds.append(cloud)
            bar.advance()
        bar.advance(2 * len(stereo.moments) - len(found) - len(clouds))
    return clouds


def _followed(
    moment: dict[int, FrameCloud], following: dict[int, FrameCloud], stereo: StereoDepths
) -> dict[int, FrameCloud]:
    """Choose the cameras in whose films points are followed from a moment to the next: where movers have depth at both.

    Returns:
        Their points at the next moment, by the number of the camera.
    """
    able = [
        number
        for number, each in moment.items()
        if number in following and stereo.matches(each.index) and stereo.matches(following[number].index)
    ]
    most = MOST_FOLLOWED // max(len(one.frames) for one in stereo.standing)
    return {able[place]: following[able[place]] for place in spread(len(able), max(2, most))}


def _moment(time: float, stereo: StereoDepths, count: int, seed: int) -> dict[int, FrameCloud]:
    """Find the moving points of a moment, up to ``count`` of them, chosen at random, by the number of the camera."""
    here = stereo.frames_at(time)
    views = [stereo.standing[number] for number in here]
    changed = [one.moves & one.changed(stereo.data[index]) for one, index in zip(views, here.values())]
    pixels, points, frames = [], [], []
    for one, region, index in zip(views, changed, here.values()):
        seen = stereo.of(index)
        assert seen is not None, "moments are those of pairs"
        at, places = seen.points()
        moves = one.sees(places, region)[1]
        # What stands still behind a mover's path looks as usual.
        moves[moves] = moving_points(places[moves], views, changed)
        pixels.append(at[moves])
        points.append(places[moves])
        frames.append(np.full(int(moves.sum()), index))
    every, owners = np.concatenate(points), np.concatenate(frames)
    usual = (~strays(every)).nonzero()[0]
    order = torch.randperm(len(usual), generator=generator(seed, Purpose.MOVING_POINTS, round(time * 1e6)))
    chosen = np.zeros(len(every), bool)
    chosen[usual[order[:count].numpy()]] = True
    found = {}
    for number, index in here.items():
        own = chosen & (owners == index)
        at = np.concatenate(pixels)[own]
        colors = colors_at(stereo.data[index].image, at, stereo.size(number))
        found[number] = frame_cloud(index, every[own], colors, time, at)
    return found


def _joined(moment: dict[int, FrameCloud], time: float) -> Cloud:
    parts = [each.cloud for each in moment.values()]
    names = "points", "colors", "moves", "frames", "pixels"
    return Cloud(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names}, time=time)


def _later(one: FrameCloud, two: FrameCloud | None, flows: Flows, stereo: StereoDepths) -> torch.Tensor:
    """Return where the points of a frame are in its camera's frame of the next moment, [P, 3]; NaN where unknown."""
    if two is None or two.index == one.index or not len(one.cloud.points):
        return torch.full_like(one.cloud.points, torch.nan)
    return later_places(one, two.index, flows, stereo)
