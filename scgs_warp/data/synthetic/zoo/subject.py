"""Any moving ``Surface`` as a ``Subject`` of the renderer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..raycast import Lamp, Raycaster
from ..renderer import SurfacePoints, points_on_triangles
from ..shading import Shading
from ..surface import Surface


class SurfaceSubject:
    """Poses, pictures and tracks of a moving surface."""

    def __init__(self, surface: Surface, device: str, shading: Shading, lamp: Lamp | None = None) -> None:
        self.device = device
        self.surface = surface
        self.raycaster = Raycaster(surface, device, shading, lamp)
        self.pose, self.render, self.visible = self.raycaster.pose, self.raycaster.render, self.raycaster.visible

    def sample(self, count: int, rng: np.random.Generator) -> SurfacePoints:
        """Sample points evenly by area over the surface at time 0."""
        return points_on_triangles(self.surface.posed(0.0)[0], self.surface.faces, count, rng)

    def track(self, points: SurfacePoints, times: Sequence[float]) -> np.ndarray:
        """Return world positions [T, P, 3] float64 of surface points."""
        corners = self.surface.faces[points.face]
        return np.stack(
            [np.einsum("pk,pki->pi", points.shares, self.surface.posed(float(time))[0][corners]) for time in times]
        )
