"""Geometry of the built-in scene's figure: a small robot of rounded solids, each rigid on one bone, with solid
textures.

Rest frame: z up, the figure faces -y, its left is +x, and it is about 2 units tall. A part's own frame, in which its
texture is defined, has the same axes and its origin at the part's centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...kernels import raycast_figure as patterns

Vector = tuple[float, float, float]

CREAM, WHITE = (0.97, 0.90, 0.76), (0.97, 0.96, 0.92)
CORAL, RED, PINK = (0.96, 0.44, 0.32), (0.82, 0.19, 0.22), (0.97, 0.62, 0.60)
TEAL, MINT, NAVY = (0.10, 0.56, 0.60), (0.56, 0.85, 0.76), (0.13, 0.18, 0.36)
MUSTARD, GLOW, BROWN = (0.97, 0.74, 0.22), (0.62, 0.98, 0.95), (0.45, 0.27, 0.19)
STEEL = (0.62, 0.68, 0.76)


class Part(NamedTuple):
    """A rounded box on a bone: half extents ``half``, edge ``radius`` (before scaling), and ``offset`` of the
    centre."""

    bone: str
    half: Vector
    radius: float
    offset: Vector
    kind: int
    colors: tuple[Vector, Vector, Vector]
    frequency: Vector = (6.0, 6.0, 6.0)
    taper: float = 0.0
    """Relative growth of the cross section from the bottom to the top."""
    divisions: int = 6
    hole: float = 0.0
    """If above 0, radius of a torus about z that replaces the box; ``half[2]`` is then the radius of its tube."""


def _arm(side: str, sign: float) -> list[Part]:
    """Make the parts of an arm; the joints are spheres, so that neighbouring parts rotate without a gap."""
    sleeve = (TEAL, CREAM, MUSTARD)
    return [
        Part(
            f"shoulder_{side}",
            (0.115, 0.115, 0.115),
            0.115,
            (0, 0, 0),
            int(patterns.SEGMENTS),
            (MUSTARD, CORAL, CREAM),
            (8, 0, 9),
        ),
        Part(f"shoulder_{side}", (0.08, 0.08, 0.215), 0.08, (0, 0, -0.14), int(patterns.CANDY), sleeve, (2, 0, 7)),
        Part(
            f"elbow_{side}",
            (0.088, 0.088, 0.088),
            0.088,
            (0, 0, 0),
            int(patterns.CHECKS),
            (NAVY, MINT, MINT),
            (16, 16, 16),
        ),
        Part(
            f"elbow_{side}",
            (0.085, 0.085, 0.19),
            0.085,
            (0, 0, -0.135),
            int(patterns.DOTS),
            (CORAL, CREAM, NAVY),
            (5, 0, 10),
            -0.25,
        ),
        Part(
            f"elbow_{side}",
            (0.108, 0.09, 0.105),
            0.085,
            (0, 0, -0.345),
            int(patterns.CLOUDS),
            (WHITE, MUSTARD, RED),
            (9, 0, 0),
        ),
        Part(
            f"elbow_{side}",
            (0.035, 0.04, 0.075),
            0.034,
            (-sign * 0.095, -0.03, -0.31),
            int(patterns.STRIPES),
            (WHITE, MUSTARD, RED),
            (0, 0, 20),
            0.0,
            6,
        ),
    ]


def _leg(side: str) -> list[Part]:
    trousers = (NAVY, STEEL, MINT)
    return [
        Part(f"hip_{side}", (0.115, 0.115, 0.225), 0.115, (0, 0, -0.13), int(patterns.CHECKS), trousers, (9, 9, 9)),
        Part(
            f"knee_{side}",
            (0.097, 0.097, 0.097),
            0.097,
            (0, 0, 0),
            int(patterns.SEGMENTS),
            (MUSTARD, BROWN, CREAM),
            (8, 0, 8),
        ),
        Part(
            f"knee_{side}",
            (0.095, 0.095, 0.20),
            0.09,
            (0, 0, -0.14),
            int(patterns.STRIPES),
            (CREAM, RED, NAVY),
            (0, 0, 11),
            -0.35,
        ),
        Part(
            f"knee_{side}",
            (0.125, 0.19, 0.095),
            0.085,
            (0, -0.05, -0.32),
            int(patterns.CHECKS),
            (TEAL, MUSTARD, MUSTARD),
            (11, 11, 11),
            -0.15,
            12,
        ),
    ]


PARTS: tuple[Part, ...] = (
    Part("torso", (0.30, 0.215, 0.33), 0.17, (0, 0, 0.26), int(patterns.CHEST), (CORAL, CREAM, NAVY), (0, 0, 7.5),
         -0.12, 12),
    Part("torso", (0.20, 0.10, 0.24), 0.08, (0, 0.25, 0.28), int(patterns.CHECKS), (TEAL, MUSTARD, RED), (10, 10, 10),
         0.0, 6),
    Part("torso", (0.14, 0.05, 0.07), 0.04, (0, 0.345, 0.17), int(patterns.CHECKS), (BROWN, CREAM, RED), (18, 18, 18)),
    Part("hips", (0.255, 0.20, 0.13), 0.12, (0, 0, 0.0), int(patterns.CLOUDS), (NAVY, TEAL, MINT), (7, 0, 0), 0.0, 6),
    Part("hips", (0.285, 0.225, 0.04), 0.038, (0, 0, 0.075), int(patterns.SEGMENTS), (BROWN, MUSTARD, BROWN),
         (14, 0, 0), 0.0, 6),
    Part("neck", (0.30, 0.30, 0.075), 0.0, (0, 0, 0.0), int(patterns.SEGMENTS), (RED, CREAM, RED), (14, 0, 0), 0.0, 12,
         0.165),
    Part("scarf", (0.085, 0.035, 0.15), 0.03, (0, 0, -0.12), int(patterns.STRIPES), (RED, CREAM, MUSTARD), (0, 0, 9)),
    Part("scarf_tip", (0.09, 0.035, 0.14), 0.03, (0, 0, -0.11), int(patterns.STRIPES), (RED, CREAM, MUSTARD),
         (0, 0, 9), -0.2),
    Part("head", (0.36, 0.30, 0.28), 0.19, (0, 0, 0.30), int(patterns.FACE), (MUSTARD, NAVY, GLOW), (0, 0, 0), 0.06,
         12),
    Part("head", (0.055, 0.12, 0.12), 0.05, (0.37, 0, 0.30), int(patterns.CHECKS), (TEAL, CREAM, RED), (14, 14, 14)),
    Part("head", (0.055, 0.12, 0.12), 0.05, (-0.37, 0, 0.30), int(patterns.CHECKS), (TEAL, CREAM, RED), (14, 14, 14)),
    Part("antenna", (0.028, 0.028, 0.14), 0.028, (0, 0, 0.10), int(patterns.STRIPES), (NAVY, CREAM, CORAL), (0, 0, 16),
         0.0, 4),
    Part("antenna", (0.085, 0.085, 0.085), 0.085, (0, 0, 0.27), int(patterns.SEGMENTS), (RED, WHITE, NAVY), (8, 0, 0)),
    *_arm("left", 1.0),
    *_leg("left"),
    *_arm("right", -1.0),
    *_leg("right"),
)  # fmt: skip


@dataclass(frozen=True)
class Figure:
    """All parts as one triangle mesh."""

    rest: np.ndarray
    """[P, 3] float64 vertices in their part's frame."""
    local: np.ndarray
    """[P, 3] float64 vertices in their bone's frame."""
    faces: np.ndarray
    """[F, 3] int32, counter-clockwise from outside."""
    vertex_part: np.ndarray
    """[P] int32, part of each vertex."""
    face_part: np.ndarray
    """[F] int32, part of each face."""
    normals: np.ndarray
    """[P, 3] unit, in the bone's frame."""


def _cube(divisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Tessellate the surface of [-1, 1]^3 with welded seams: return vertices [P, 3] and outward faces [F, 3]."""
    ticks = np.tan(np.linspace(-1, 1, divisions + 1) * np.pi / 4)  # Even angles avoid crowding at the corners.
    u, v = np.meshgrid(ticks, ticks, indexing="ij")
    corner = np.arange(divisions)[:, None] * (divisions + 1) + np.arange(divisions)
    a, b, c, d = corner, corner + divisions + 1, corner + divisions + 2, corner + 1
    quads = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    vertices, faces = [], []
    for axis in range(3):
        for sign in (1.0, -1.0):
            side = np.empty((u.size, 3))
            side[:, axis] = sign
            side[:, (axis + 1) % 3], side[:, (axis + 2) % 3] = u.ravel(), v.ravel()
            faces.append((quads if sign > 0 else quads[:, ::-1]) + len(vertices) * u.size)
            vertices.append(side)
    points = np.concatenate(vertices)
    _, index, inverse = np.unique(np.round(points, 9), axis=0, return_index=True, return_inverse=True)
    return points[index], inverse.reshape(-1)[np.concatenate(faces)]


def rounded_box(half: Vector, radius: float, divisions: int = 10, taper: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Make a box with rounded edges: the points at distance ``radius`` from an inner box. A capsule and a ball are
    limiting cases.

    Returns:
        vertices [P, 3] and faces [F, 3], counter-clockwise from outside.
    """
    cube, faces = _cube(divisions)
    extent = np.asarray(half, np.float64)
    core = np.maximum(extent - radius, 0.0)
    # A third of the grid lines goes to the flat centre, two thirds at even angles to the rounded edges.
    share = np.arctan(np.abs(cube)) * (4.0 / np.pi)
    edge = core + (extent - core) * np.tan(np.clip(1.5 * share - 0.5, 0.0, 1.0) * np.pi / 4)
    beyond = np.where(share < 1.0 / 3.0, 3.0 * share * core, edge)
    points = np.where(core > 0, np.sign(cube) * beyond, cube * extent)
    inner = np.clip(points, -core, core)
    away = points - inner
    vertices = inner + away / np.linalg.norm(away, axis=1, keepdims=True) * radius
    vertices[:, :2] *= 1.0 + taper * vertices[:, 2:] / (2.0 * extent[2])
    return vertices, faces


def torus(radius: float, tube: float, divisions: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Make a torus about z: return vertices [P, 3] and faces [F, 3]."""
    rings, sides = 2 * divisions, divisions
    around, across = np.meshgrid(
        np.arange(rings) * 2 * np.pi / rings, np.arange(sides) * 2 * np.pi / sides, indexing="ij"
    )
    distance = radius + tube * np.cos(across)
    vertices = np.stack([distance * np.cos(around), distance * np.sin(around), tube * np.sin(across)], -1)
    i, j = np.meshgrid(np.arange(rings), np.arange(sides), indexing="ij")
    a, b = i * sides + j, (i + 1) % rings * sides + j
    c, d = (i + 1) % rings * sides + (j + 1) % sides, i * sides + (j + 1) % sides
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return vertices.reshape(-1, 3), faces


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute unit vertex normals [P, 3], weighted by area."""
    corners = vertices[faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for column in range(3):
        np.add.at(normals, faces[:, column], crosses)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def build_figure(parts: tuple[Part, ...] = PARTS) -> Figure:
    """Build the mesh of all parts."""
    rest, local, faces, normals, vertex_part, face_part = [], [], [], [], [], []
    count = 0
    for index, part in enumerate(parts):
        if part.hole > 0:
            vertices, triangles = torus(part.hole, part.half[2], part.divisions)
        else:
            vertices, triangles = rounded_box(part.half, part.radius, part.divisions, part.taper)
        rest.append(vertices)
        local.append(vertices + np.asarray(part.offset))
        faces.append(triangles + count)
        normals.append(vertex_normals(vertices, triangles))
        vertex_part.append(np.full(len(vertices), index, np.int32))
        face_part.append(np.full(len(triangles), index, np.int32))
        count += len(vertices)
    return Figure(
        rest=np.concatenate(rest),
        local=np.concatenate(local),
        faces=np.concatenate(faces).astype(np.int32),
        vertex_part=np.concatenate(vertex_part),
        face_part=np.concatenate(face_part),
        normals=np.concatenate(normals),
    )
