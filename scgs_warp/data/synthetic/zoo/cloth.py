"""A patchwork flag that waves on its pole: one body that bends everywhere, with two different sides."""

from __future__ import annotations

import math

import numpy as np

from ....kernels import solid_textures as patterns
from ..raycast import Lamp
from ..shading import Shading
from ..sheets import grid, sheet_faces, sheet_vertices
from ..solids import capsule, disc, rounded_box, vertex_normals
from ..surface import JoinedSurfaces, Material, Piece, RigidParts, merge, placed
from .subject import SurfaceSubject

WIDTH, HEIGHT = 1.50, 1.10
HALF_THICKNESS = 0.006
STEP = 0.02
"""Distance between grid points of the cloth."""
POLE_X, BOTTOM, TOP = -0.62, -0.96, 0.86
LAMP = Lamp(spread=0.2, sky_rays=32, key_rays=20)

FRONT = Material(
    int(patterns.QUILT), ((0.86, 0.25, 0.22), (0.98, 0.86, 0.55), (0.15, 0.40, 0.56)), (5.0, 0.0, 5.0), 0.06, 15.0
)
BACK = Material(
    int(patterns.QUILT), ((0.22, 0.52, 0.36), (0.94, 0.90, 0.80), (0.55, 0.30, 0.55)), (4.0, 0.0, 4.0), 0.06, 15.0
)
HEM = Material(int(patterns.STRIPES), ((0.96, 0.92, 0.84), (0.80, 0.25, 0.22), (0.96, 0.92, 0.84)), (0.0, 0.0, 9.0))


def _heading(u: np.ndarray, v: np.ndarray, time: float) -> np.ndarray:
    """Return the direction of the cloth in the horizontal plane, radians from +x, at (u, v) in units of length from the
    pole and from the lower edge.

    Waves run away from the pole and grow on their way; folds hang from the upper corner.
    """
    turn = 2.0 * math.pi * time
    share = u / WIDTH
    wind = 0.35 * math.sin(turn)
    waves = (0.45 + 0.75 * share) * np.sin(2.0 * math.pi * u / 0.95 - 2.0 * turn + 1.3 * v)
    folds = 0.22 * share * np.sin(17.0 * u + 9.0 * (HEIGHT - v) - 3.0 * turn)
    flutter = 0.30 * share * share * np.sin(11.0 * u - 7.0 * v - 5.0 * turn)
    return wind + waves + folds + flutter


class Cloth:
    """The flag as a ``Surface``. Along each horizontal line, the cloth keeps its length."""

    def __init__(self) -> None:
        u = np.linspace(0.0, WIDTH, round(WIDTH / STEP) + 1)
        v = np.linspace(0.0, HEIGHT, round(HEIGHT / STEP) + 1)
        self.u, self.v = grid(u, v)
        flat = np.stack([self.u, np.zeros_like(self.u), self.v], -1)
        self.rest = sheet_vertices(flat, HALF_THICKNESS)
        faces, sides = sheet_faces(len(u), len(v))
        self.faces, self.face_part = faces.astype(np.int32), sides.astype(np.int32)
        self.materials = (FRONT, BACK, HEM)

    def middle(self, time: float) -> np.ndarray:
        """Return the world positions [U, V, 3] of the grid points."""
        heading = _heading(self.u, self.v, time)
        between = 0.5 * (heading[1:] + heading[:-1])
        ahead, aside = np.zeros_like(heading), np.zeros_like(heading)
        step = self.u[1, 0] - self.u[0, 0]
        ahead[1:], aside[1:] = np.cumsum(step * np.cos(between), 0), np.cumsum(step * np.sin(between), 0)
        share = self.u / WIDTH
        sag = 0.10 * share * share * (1.0 + 0.4 * math.sin(2.0 * math.pi * time + 0.6))
        return np.stack([POLE_X + 0.03 + ahead, aside, TOP - HEIGHT + self.v - sag - 0.02], -1)

    def posed(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices and unit normals, [P, 3] float64 each, at ``time`` in [0, 1]."""
        vertices = sheet_vertices(self.middle(time), HALF_THICKNESS)
        return vertices, vertex_normals(vertices, self.faces)


def _pole() -> RigidParts:
    wood = Material(int(patterns.CANDY), ((0.55, 0.36, 0.22), (0.86, 0.70, 0.48), (0.30, 0.18, 0.12)), (1, 0, 4), 0.2)
    stone = Material(
        int(patterns.CLOUDS), ((0.42, 0.44, 0.50), (0.78, 0.79, 0.82), (0.2, 0.2, 0.2)), (14.0, 0.0, 0.0), 0.1, 20.0
    )
    gold = Material(int(patterns.SEGMENTS), ((0.95, 0.72, 0.20), (0.99, 0.88, 0.50), (0.7, 0.4, 0.1)), (6, 0, 0), 0.6)
    pieces = [
        Piece(*capsule(TOP - BOTTOM, 0.024, 0.03), wood, "pole", placed(POLE_X, 0.0, (TOP + BOTTOM) / 2)),
        Piece(*disc(0.20, 0.035, 0.03), stone, "pole", placed(POLE_X, 0.0, BOTTOM)),
        Piece(*rounded_box((0.055, 0.055, 0.055), 0.055, 10), gold, "pole", placed(POLE_X, 0.0, TOP + 0.06)),
    ]
    return RigidParts(merge(pieces), lambda time: {"pole": np.eye(4)})


def make_cloth(device: str, shading: Shading) -> SurfaceSubject:
    """Make the flag and its pole."""
    return SurfaceSubject(JoinedSurfaces([Cloth(), _pole()]), device, shading, LAMP)
