"""Initial points on what moves: by stereo if the cameras stand still, by optical flow if the frames are of a film."""

from __future__ import annotations

import torch
from torch import Tensor

from ..data.dataset import Dataset
from ..geometry.normalisation import Normalisation
from .flow import follow_each_other
from .flow_points import InstantPoints, flow_points
from .standing_cameras import standing_cameras
from .stereo_points import moving_points, stereo_points


def points_on_movers(
    count: int, known: Tensor, data: Dataset, normalisation: Normalisation, seed: int, key: int
) -> tuple[InstantPoints, Tensor]:
    """Find up to ``count`` points of one instant.

    Args:
        known: [P, 3] sparse points of the data, normalised.
        seed, key: of the choice among points of stereo.

    Returns:
        The points, none if nothing moves or no depth is found; and [P] bool: the sparse points to keep. Those on what
        moves before standing cameras are of any instant, and are replaced.
    """
    views = [normalisation.apply_camera(camera) for camera in data.cameras]
    standing, found, keep = standing_cameras(data, views), None, torch.ones(len(known), dtype=torch.bool)
    if standing:
        found = stereo_points(count, known, data, standing, seed, key)
        if found is not None:
            keep = torch.from_numpy(~moving_points(known.double().numpy(), standing))
    elif follow_each_other(data):
        found = flow_points(count, known, data, views)
    if found is None:
        found = InstantPoints(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, dtype=torch.bool), 0)
    return found, keep
