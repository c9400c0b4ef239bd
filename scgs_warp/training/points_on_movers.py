"""Initial points on what moves: by stereo if the cameras stand still, by optical flow if the frames are of a film."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..data.dataset import Dataset
from ..geometry.normalisation import Normalisation
from .flow import follow_each_other
from .flow_points import InstantPoints, flow_points
from .standing_cameras import standing_cameras
from .stereo_motion import start_cloud
from .stereo_points import MovingCloud, Stereo, moving_points


class Movers(NamedTuple):
    """What is known of what moves before the first step."""

    seen: InstantPoints
    """Points of one instant; none if nothing moves or no depth is found."""
    keep: Tensor
    """[P] bool: the sparse points to keep. Those on what moves before standing cameras are of any instant, and are
    replaced."""
    clouds: list[MovingCloud]
    """Points at several moments, before standing cameras."""


def points_on_movers(
    count: int, known: Tensor, data: Dataset, normalisation: Normalisation, seed: int, key: int
) -> Movers:
    """Find up to ``count`` points of one instant.

    Args:
        known: [P, 3] sparse points of the data, normalised.
        seed, key: of the choice among points of stereo.
    """
    views = [normalisation.apply_camera(camera) for camera in data.cameras]
    keep, found, clouds = torch.ones(len(known), dtype=torch.bool), None, []
    standing = standing_cameras(data, views)
    if standing:
        clouds = Stereo(known, data, standing).clouds(count, seed, key)
        if clouds:
            found = start_cloud(clouds).seen
            keep = torch.from_numpy(~moving_points(known.double().numpy(), standing))
    elif follow_each_other(data):
        found = flow_points(count, known, data, views)
    if found is None:
        found = InstantPoints(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, dtype=torch.bool), 0)
    return Movers(found, keep, clouds)
