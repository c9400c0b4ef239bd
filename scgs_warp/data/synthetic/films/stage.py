"""The scene of a film: a moving subject in a room, as rays see it at any moment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ....kernels import raycast_hits
from ....runtime.launch import launch
from ....types import Camera
from ..figure import build_figure
from ..raycast import Lamp, PosedSurface, Raycaster
from ..renderer import SurfacePoints, points_on_triangles
from ..shading import Shading
from ..surface import JoinedSurfaces, RigidParts, Surface
from .room import Room
from .walking import walking_transforms

LAMP = Lamp(spread=0.35, sky_rays=20, key_rays=12, reach=0.5)
FLOOR_TIMES = 41
"""Number of times at which the lowest point of the subject is sought."""


class Hits(NamedTuple):
    """What the rays through the pixel centres of a camera meet."""

    face: Tensor
    """[H, W] index of the triangle, -1 where there is none."""
    shares: Tensor
    """[H, W, 3] barycentric coordinates on it."""
    depth: Tensor
    """[H, W] along the optical axis; 0 where there is none."""


class Stage:
    """A moving surface that stands in a room."""

    def __init__(self, mover: Surface, device: str) -> None:
        self.device = device
        self.mover = mover
        self.floor = min(float(mover.posed(time)[0][:, 2].min()) for time in np.linspace(0.0, 1.0, FLOOR_TIMES))
        self.surface = JoinedSurfaces([mover, Room(self.floor)])
        self.moving_faces = len(mover.faces)
        """Faces with lower indices move."""
        self.caster = Raycaster(self.surface, device, lamp=LAMP)
        self._lit: tuple[float, PosedSurface] | None = None

    def pose(self, time: float) -> PosedSurface:
        """Pose and light everything at ``time`` in [0, 1]."""
        if self._lit is None or self._lit[0] != time:
            self._lit = time, self.caster.pose(time)
        return self._lit[1]

    def pose_lit_as(self, lit: PosedSurface, time: float) -> PosedSurface:
        """Pose everything, with the light of a pose at nearly the same time; valid until the next such call."""
        return self.caster.pose_lit_as(lit, time)

    def pose_unlit(self, time: float) -> PosedSurface:
        """Pose everything for questions about its shape; valid until the next call of this or ``pose_lit_as``."""
        return self.caster.pose_lit_as(None, time)

    def hits(self, posed: PosedSurface, camera: Camera) -> Hits:
        """Cast one ray through the centre of each pixel."""
        shape = camera.height, camera.width
        face = torch.empty(shape, dtype=torch.int32, device=self.device)
        shares, depth = torch.empty(*shape, 3, device=self.device), torch.empty(shape, device=self.device)
        camera_to_world = torch.linalg.inv(camera.viewmat.double())[:3].float().contiguous().to(self.device)
        launch(
            raycast_hits.first_hits, shape[0] * shape[1], posed.mesh.id, camera_to_world, camera.K.to(self.device),
            camera.width, face, shares, depth, grain=64,
        )  # fmt: skip
        return Hits(face, shares, depth)

    def moves(self, hits: Hits) -> Tensor:
        """Return [H, W] bool, True on pixels that show the subject."""
        return (hits.face >= 0) & (hits.face < self.moving_faces)

    def places(self, posed: PosedSurface, hits: Hits) -> Tensor:
        """Return the world positions [H, W, 3] of the surface points that were hit, at the time of ``posed``."""
        faces = self.caster.faces.view(-1, 3).long()
        corners = posed.vertices[faces[hits.face.clamp(min=0).long()]]
        return (corners * hits.shares[..., None]).sum(-2)

    def sample(self, count: int, rng: np.random.Generator) -> SurfacePoints:
        """Sample points evenly by area over the subject at time 0."""
        return points_on_triangles(self.mover.posed(0.0)[0], self.mover.faces, count, rng)

    def sample_room(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Sample points [P, 3] evenly by area over the room."""
        room = self.surface.surfaces[1]
        points = points_on_triangles(room.posed(0.0)[0], room.faces, count, rng)
        return np.einsum("pk,pki->pi", points.shares, room.posed(0.0)[0][room.faces[points.face]])

    def track(self, points: SurfacePoints, times: Sequence[float]) -> np.ndarray:
        """Return world positions [T, P, 3] float64 of points on the subject."""
        corners = self.mover.faces[points.face]
        return np.stack(
            [np.einsum("pk,pki->pi", points.shares, self.mover.posed(float(time))[0][corners]) for time in times]
        )


def stage_of(subject: str, device: str) -> Stage:
    """Make the stage of a built-in subject; ``robot`` walks about."""
    from ..zoo import SUBJECTS
    from ..zoo.subject import SurfaceSubject

    if subject == "robot":
        return Stage(RigidParts(build_figure(), walking_transforms), device)
    made = SUBJECTS[subject](device, Shading())
    assert isinstance(made, SurfaceSubject)
    return Stage(made.surface, device)
