"""Initial points on what moves: by stereo if the cameras stand still; in a film by its depth maps, if these show what
moves, or by optical flow."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..data.dataset import Dataset
from ..geometry.normalisation import FEWEST_POINTS, Normalisation
from ..types import Camera
from .clouds import Cloud
from .depth import Depths
from .flow import Flows, follow_each_other
from .movers_by_depth import depth_clouds, on_movers
from .movers_by_flow import flow_cloud
from .movers_by_stereo import moving_points, stereo_clouds
from .registration import Registration
from .start_motion import SeenMotion, start_cloud
from .stereo_depth import StereoDepths, stereo_depths
from .tracks import gather

SHARE = 0.5
"""Largest share of all initial points that stereo or depth maps give, and least share of the sparse points that must
stay."""


class Movers(NamedTuple):
    """What is known of what moves before the first step."""

    seen: Cloud
    """Points of one instant; none if nothing moves or no depth is found."""
    keep: Tensor
    """[P] bool, True for sparse points to keep. Where stereo or depth maps show what moves, those on it are replaced,
    because they may show any instant."""
    motion: SeenMotion | None = None
    """What stereo or depth maps show of the motion."""
    stereo: StereoDepths | None = None
    """Depth of the frames, if the cameras stand still."""


def points_on_movers(
    most: int, count: int, known: Tensor, data: Dataset, normalisation: Normalisation, seed: int
) -> Movers:
    """Find points of one instant.

    Args:
        most: largest number of points.
        count: number of all initial points. Flow gives only as many as the sparse points leave.
        known: [P, 3] sparse points of the data, normalised.
        seed: seed of the choice among the points that stereo or depth maps give.
    """
    views = [normalisation.apply_camera(camera) for camera in data.cameras]
    keep, found, motion = torch.ones(len(known), dtype=torch.bool), None, None
    stereo = stereo_depths(data, normalisation)
    if stereo is not None:
        most = min(most, int(SHARE * count))
        flows = Flows(data, views)
        clouds = stereo_clouds(stereo, flows, most, seed)
        found, motion = _gathered(clouds, most, seed, Registration(data, flows, stereo, stereo.frame_then))
        if found is not None:
            keep = _kept(known, torch.from_numpy(~moving_points(known.double().numpy(), stereo.standing)))
    elif (data.with_depth or len(known) < count) and follow_each_other(data):
        if data.with_depth:
            found, motion = _by_depth(min(most, int(SHARE * count)), data, views, normalisation.scale, seed)
            keep = keep if motion is None else _kept(known, ~on_movers(known, motion.clouds))
        if found is None and len(known) < count:
            found = flow_cloud(min(most, count - len(known)), known, data, views)
    if found is None:
        found = Cloud(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, dtype=torch.bool), 0.0)
    return Movers(found, keep, motion, stereo)


def _kept(known: Tensor, rests: Tensor) -> Tensor:
    """Return the sparse points to keep, [P] bool: those that rest, unless these are too few."""
    return rests if int(rests.sum()) >= max(FEWEST_POINTS, SHARE * len(known)) else torch.ones_like(rests)


def _by_depth(
    most: int, data: Dataset, views: list[Camera], scale: float, seed: int
) -> tuple[Cloud | None, SeenMotion | None]:
    """Find up to ``most`` points, and what depth maps show of their motion; None if nothing moves."""
    depths = Depths(data, views, scale)
    depths.read()
    flows = Flows(data, views)
    clouds = depth_clouds(most, data, flows, depths, seed)
    frames = {cloud.time: int(cloud.frames[0]) for cloud in clouds if cloud.frames is not None}
    registration = Registration(data, flows, depths, lambda _, time: frames.get(time))
    return _gathered(clouds, most, seed, registration)


def _gathered(
    clouds: list[Cloud], most: int, seed: int, registration: Registration
) -> tuple[Cloud | None, SeenMotion | None]:
    """Gather the points of all clouds in the rest pose, up to ``most``; None if nothing moves."""
    if not clouds:
        return None, None
    start = [cloud.time for cloud in clouds].index(start_cloud(clouds).time)
    found, tracks = gather(clouds, start, most, seed, registration)
    return found, None if found is None else SeenMotion(found, clouds, tracks)
