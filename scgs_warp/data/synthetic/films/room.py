"""A furnished room around a subject at the origin: what stands still in a film, and is full of texture.

World units; z is up and the subject faces -y. The room has no ceiling. Walls and floor show their front to the outside,
so that they let the light in: the ray caster treats only fronts as occluders.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ....kernels import solid_textures as patterns
from ..joints import rotation
from ..solids import Vector, rounded_box
from ..surface import Material, Piece, merge, placed

HALF_WIDTH = 4.2
"""Distance of the walls from the middle."""
HEIGHT = 4.2
LIGHT_STEP = 0.3
"""Distance between the vertices of walls and floor, which hold their light."""
THICKNESS = 0.05
"""Half the thickness of a poster."""

PLASTER = Material(int(patterns.CLOUDS), ((0.86, 0.80, 0.68), (0.55, 0.62, 0.66), (0.9, 0.9, 0.9)), (3.0, 0.0, 0.0))
PAPER = Material(int(patterns.QUILT), ((0.78, 0.74, 0.60), (0.42, 0.56, 0.52), (0.66, 0.42, 0.34)), (1.7, 1.7, 1.7))
BRICK = Material(int(patterns.PLANKS), ((0.72, 0.44, 0.34), (0.46, 0.26, 0.22), (0.80, 0.76, 0.70)), (2.3, 4.1, 0.0))
FLOOR = Material(int(patterns.PLANKS), ((0.80, 0.64, 0.44), (0.50, 0.35, 0.22), (0.22, 0.14, 0.09)), (0.7, 4.3, 0.0))
RUG = Material(int(patterns.QUILT), ((0.62, 0.22, 0.24), (0.88, 0.80, 0.62), (0.20, 0.30, 0.44)), (2.6, 2.6, 2.6))

POSTERS: tuple[tuple[tuple[Vector, Vector, Vector], float], ...] = (
    (((0.92, 0.88, 0.80), (0.16, 0.36, 0.56), (0.86, 0.36, 0.22)), 5.0),
    (((0.20, 0.24, 0.38), (0.94, 0.80, 0.42), (0.70, 0.86, 0.84)), 6.5),
    (((0.84, 0.52, 0.40), (0.30, 0.50, 0.38), (0.96, 0.92, 0.80)), 4.2),
)
"""Colours, and squares per unit of length."""


class Box(NamedTuple):
    """A piece of furniture that stands on the floor."""

    middle: tuple[float, float]
    half: Vector
    turn: float
    """Degrees about z."""
    kind: int
    colors: tuple[Vector, Vector, Vector]
    frequency: Vector


FURNITURE = (
    Box((-2.4, 3.3), (0.9, 0.35, 0.55), 4.0, int(patterns.PLANKS),
        ((0.66, 0.46, 0.30), (0.40, 0.26, 0.17), (0.16, 0.10, 0.06)), (1.9, 9.0, 0.0)),
    Box((0.5, 3.5), (0.5, 0.30, 1.05), 0.0, int(patterns.CHECKS),
        ((0.24, 0.36, 0.34), (0.82, 0.78, 0.62), (0.8, 0.7, 0.6)), (5.3, 5.3, 6.1)),
    Box((2.6, 3.0), (0.55, 0.55, 0.40), 32.0, int(patterns.STRIPES),
        ((0.80, 0.70, 0.40), (0.36, 0.22, 0.34), (0.92, 0.88, 0.78)), (0.0, 0.0, 6.0)),
    Box((3.3, 0.6), (0.40, 0.75, 0.75), -6.0, int(patterns.CLOUDS),
        ((0.30, 0.44, 0.60), (0.88, 0.72, 0.52), (0.9, 0.9, 0.9)), (5.0, 0.0, 0.0)),
    Box((-3.4, 0.9), (0.38, 0.60, 0.95), 7.0, int(patterns.QUILT),
        ((0.74, 0.62, 0.52), (0.28, 0.42, 0.30), (0.82, 0.34, 0.30)), (4.4, 4.4, 4.4)),
    Box((-1.5, 2.5), (0.24, 0.24, 0.28), 20.0, int(patterns.DOTS),
        ((0.34, 0.52, 0.62), (0.96, 0.90, 0.70), (0.70, 0.22, 0.20)), (7.0, 0.0, 6.0)),
    Box((-3.2, -2.6), (0.5, 0.5, 0.45), 12.0, int(patterns.CANDY),
        ((0.56, 0.38, 0.30), (0.86, 0.80, 0.66), (0.24, 0.30, 0.44)), (4.0, 0.0, 5.0)),
    Box((3.1, -2.4), (0.45, 0.6, 0.6), -15.0, int(patterns.CLOUDS),
        ((0.66, 0.34, 0.30), (0.30, 0.20, 0.26), (0.9, 0.9, 0.9)), (4.0, 0.0, 0.0)),
)  # fmt: skip


class Room:
    """A ``Surface`` that stands still."""

    def __init__(self, floor: float) -> None:
        """
        Args:
            floor: height of the floor.
        """
        shell, contents = _shell(floor), _contents(floor)
        mesh = merge([*shell, *contents])
        outside = mesh.face_part < len(shell)
        self.rest, self.face_part, self.materials = mesh.rest, mesh.face_part, mesh.materials
        self.faces = np.where(outside[:, None], mesh.faces[:, ::-1], mesh.faces).astype(np.int32)
        self._vertices, self._normals = mesh.local, mesh.normals

    def posed(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return world vertices and unit normals into the room, [P, 3] float64 each; they do not depend on time."""
        return self._vertices, self._normals


def _sheet(width: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Make a rectangle in the plane of x and z about the origin, which faces -y: vertices [P, 3] and faces [F, 3]."""
    columns, rows = (max(1, int(np.ceil(length / LIGHT_STEP))) for length in (width, height))
    x, z = np.meshgrid(
        np.linspace(-width / 2, width / 2, columns + 1), np.linspace(-height / 2, height / 2, rows + 1), indexing="ij"
    )
    corner = np.arange(columns)[:, None] * (rows + 1) + np.arange(rows)
    a, b, c, d = corner, corner + rows + 1, corner + rows + 2, corner + 1
    quads = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return np.stack([x, np.zeros_like(x), z], -1).reshape(-1, 3), quads


def _shell(floor: float) -> list[Piece]:
    """Make the floor and the walls, which face inwards."""
    middle = floor + HEIGHT / 2
    side = 2 * HALF_WIDTH
    walls = ((0.0, PAPER, (0.0, HALF_WIDTH)), (90.0, PLASTER, (-HALF_WIDTH, 0.0)),
             (180.0, PLASTER, (0.0, -HALF_WIDTH)), (270.0, BRICK, (HALF_WIDTH, 0.0)))  # fmt: skip
    pieces = []
    for turn, look, (x, y) in walls:
        vertices, faces = _sheet(side, HEIGHT)
        if look is BRICK:  # its pattern lies in the plane of x and y
            vertices, upright = vertices[:, [0, 2, 1]] * [1.0, 1.0, -1.0], rotation(90.0, 0.0, 0.0)
            place = placed(x, y, middle, rotation(0.0, 0.0, turn) @ upright)
        else:
            place = placed(x, y, middle, rotation(0.0, 0.0, turn))
        pieces.append(Piece(vertices, faces, look, "room", place))
    vertices, faces = _sheet(side, side)
    pieces.append(Piece(vertices[:, [0, 2, 1]] * [1.0, 1.0, -1.0], faces, FLOOR, "room", placed(0.0, 0.0, floor)))
    return pieces


def _contents(floor: float) -> list[Piece]:
    """Make the furniture, posters and a rug."""
    pieces = []
    for box in FURNITURE:
        vertices, faces = rounded_box(box.half, 0.03, 10)
        place = placed(*box.middle, floor + box.half[2], rotation(0.0, 0.0, box.turn))
        pieces.append(Piece(vertices, faces, Material(box.kind, box.colors, box.frequency), "room", place))
    inner = HALF_WIDTH - THICKNESS
    places = (
        (placed(-1.0, inner, floor + 1.95), (0.75, 0.55)),
        (placed(2.4, inner, floor + 1.80), (0.60, 0.80)),
        (placed(-inner, 2.5, floor + 1.75, rotation(0.0, 0.0, 90.0)), (0.8, 0.5)),
        (placed(-inner, -1.6, floor + 1.7, rotation(0.0, 0.0, 90.0)), (0.7, 0.7)),
        (placed(inner, 2.2, floor + 1.9, rotation(0.0, 0.0, 270.0)), (0.7, 0.6)),
        (placed(inner, -0.9, floor + 1.8, rotation(0.0, 0.0, 270.0)), (0.9, 0.6)),
    )
    for number, (place, (width, height)) in enumerate(places):
        colors, squares = POSTERS[number % len(POSTERS)]
        vertices, faces = rounded_box((width, THICKNESS, height), 0.01, 8)
        look = Material(int(patterns.QUILT), colors, (squares, squares, squares))
        pieces.append(Piece(vertices, faces, look, "room", place))
    vertices, faces = rounded_box((1.5, 0.02, 1.3), 0.01, 12)
    flat = rotation(90.0, 0.0, 0.0)
    pieces.append(Piece(vertices, faces, RUG, "room", placed(0.1, 0.1, floor + 0.01, flat)))
    return pieces
