"""Geometry of the built-in scene's figure: a small robot of rounded solids, each rigid on one bone, with solid
textures.

Rest frame: z up, the figure faces -y, its left is +x, and it is about 2 units tall. A part's own frame, in which its
texture is defined, has the same axes and its origin at the part's centre.
"""

from __future__ import annotations

from typing import NamedTuple

from ...kernels import solid_textures as patterns
from .solids import Vector, rounded_box, torus
from .surface import Material, PartMesh, Piece, merge, placed

CREAM, WHITE = (0.97, 0.90, 0.76), (0.97, 0.96, 0.92)
CORAL, RED = (0.96, 0.44, 0.32), (0.82, 0.19, 0.22)
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


def build_figure() -> PartMesh:
    """Build the mesh of ``PARTS``."""
    pieces = []
    for part in PARTS:
        if part.hole > 0:
            vertices, faces = torus(part.hole, part.half[2], part.divisions)
        else:
            vertices, faces = rounded_box(part.half, part.radius, part.divisions, part.taper)
        material = Material(part.kind, part.colors, part.frequency)
        pieces.append(Piece(vertices, faces, material, part.bone, placed(*part.offset)))
    return merge(pieces)
