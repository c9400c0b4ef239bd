"""How close a scene is to its cameras: the distance from the lens within which no view shows content, and what this
distance means for the rates of the network.

A Gaussian close to a lens covers the whole picture of one view, and no other view contradicts it. Densification
therefore fills the space before isolated cameras with fog, which hides the scene from held-out views nearby. But that
space is known to be empty: the camera has moved through it, and its lens was in focus beyond it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..data.dataset import Dataset, spread
from ..geometry.normalisation import COMMON_RADIUS, FEWEST_POINTS, Normalisation
from ..geometry.pinhole import in_image, projected
from ..types import Camera

MOST_VIEWS = 200
"""Largest number of cameras whose distances are measured."""
NEAREST_POINTS = 0.01
"""Share of the points in a view that may be nearer than its content: they are outliers of the reconstruction."""
NEAREST_CAMERAS = 0.05
"""Share of the cameras that may be nearer to the content than the bound assumes."""
INSIDE = 0.1
"""Least distance to the content, as a share of the distance to the centre, where there are no points: a camera may
stand inside the region that all cameras see."""
USUAL_DISTANCE = 2.0
"""Distance of a scene's points from its cameras, normalised units, from which on the rates are the usual ones.
The network's first step moves everything by about a tenth of a unit. A street or a floor that is filmed from a quarter
of a unit would end up behind the cameras, from where no gradient leads back."""


def nearest_content(data: Dataset, normalisation: Normalisation) -> float:
    """Return the distance, in normalised units, at which the content of a near view begins: that of the nearest sparse
    points or, without points, of the region that all cameras see; 0 if no view sees enough points."""
    cameras = [normalisation.apply_camera(data.entries[index].camera) for index in spread(len(data), MOST_VIEWS)]
    if data.points is None or len(data.points) < FEWEST_POINTS:
        reach = torch.stack([camera.position.double().norm() for camera in cameras])
        distances = torch.maximum(reach - COMMON_RADIUS, INSIDE * reach)
        return float(distances.quantile(NEAREST_CAMERAS))
    found = [distances.quantile(NEAREST_POINTS) for distances in _distances(data, normalisation, cameras)]
    return float(torch.stack(found).quantile(NEAREST_CAMERAS)) if found else 0.0


def network_scale(data: Dataset, normalisation: Normalisation) -> float:
    """Return the factor on the network's rates that suits the distance at which views see the data's points."""
    if data.points is None or len(data.points) < FEWEST_POINTS:
        return 1.0
    cameras = [normalisation.apply_camera(data.entries[index].camera) for index in spread(len(data), MOST_VIEWS)]
    found = [distances.median() for distances in _distances(data, normalisation, cameras)]
    scale = float(torch.stack(found).median()) / USUAL_DISTANCE if found else 1.0
    return round(min(1.0, scale), 3)  # so that all machines agree


def _distances(data: Dataset, normalisation: Normalisation, cameras: list[Camera]) -> list[Tensor]:
    """Return the distances of the data's points, [P], from each normalised camera that sees enough of them."""
    assert data.points is not None, "the caller has looked"
    points, found = normalisation.apply(data.points).double(), []
    for camera in cameras:
        pixels, local = projected(points, camera)
        inside = in_image(pixels, local, camera)
        if int(inside.sum()) >= FEWEST_POINTS:
            found.append(local[inside].norm(dim=1))
    return found
