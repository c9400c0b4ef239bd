"""Static model without motion: 3D-GS, the paper's reference for speed (Table S2)."""

from __future__ import annotations

from torch import Tensor

from ..gaussians import GaussianParameters
from ..types import Gaussians
from .base import Motion


class Static(Motion):
    """Motion model that leaves all Gaussians at rest."""

    name = "static"
    moves = False
    takes_time_tensor = True

    def gaussians_at(self, gaussians: GaussianParameters, time: float | Tensor) -> Gaussians:
        return gaussians.activate()
