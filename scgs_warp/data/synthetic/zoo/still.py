"""A flowering plant in a pot, in hardly any wind: much detail, and a motion of a few per cent of its size."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ....kernels import solid_textures as patterns
from ..joints import Joint, pose_joints, rotation
from ..raycast import Lamp
from ..shading import Shading
from ..sheets import grid, sheet
from ..solids import Vector, capsule, disc, lathe, rounded_box
from ..surface import Material, Piece, RigidParts, merge, placed
from .subject import SurfaceSubject

FLOOR, SOIL = -1.06, -0.56
STEMS, SEGMENTS, SEGMENT = 3, 5, 0.24
"""Number of stems, of segments of each, and length of a segment."""
LEAVES = 9
"""Number of leaves of each stem."""
PETALS = 8
SWAY = 0.35
"""Angle by which each segment of a stem bends to each side, degrees."""
GOLDEN = 137.507764
LAMP = Lamp(spread=0.2, sky_rays=24, key_rays=16)

CLAY = Material(int(patterns.SEGMENTS), ((0.76, 0.38, 0.24), (0.92, 0.82, 0.66), (0.22, 0.36, 0.48)), (14, 0, 9), 0.25)
EARTH = Material(int(patterns.CLOUDS), ((0.24, 0.15, 0.10), (0.45, 0.30, 0.20), (0.0, 0.0, 0.0)), (26, 0, 0))
STALK = Material(int(patterns.STRIPES), ((0.30, 0.50, 0.20), (0.46, 0.66, 0.28), (0.55, 0.36, 0.30)), (0, 0, 15))
GREEN = Material(int(patterns.LEAF), ((0.16, 0.46, 0.20), (0.74, 0.88, 0.48), (0.32, 0.62, 0.24)), (26, 12, 0), 0.2)
PALE = Material(int(patterns.LEAF), ((0.36, 0.58, 0.24), (0.90, 0.94, 0.66), (0.62, 0.72, 0.30)), (26, 12, 0), 0.2)
HEART = Material(int(patterns.CHECKS), ((0.45, 0.26, 0.10), (0.96, 0.76, 0.22), (0.0, 0.0, 0.0)), (36, 36, 36))
BLOSSOMS = (
    Material(int(patterns.LEAF), ((0.90, 0.32, 0.46), (0.99, 0.86, 0.86), (0.98, 0.56, 0.60)), (22, 9, 0), 0.1),
    Material(int(patterns.LEAF), ((0.97, 0.76, 0.26), (0.80, 0.34, 0.14), (0.99, 0.88, 0.48)), (22, 9, 0), 0.1),
    Material(int(patterns.LEAF), ((0.46, 0.40, 0.84), (0.95, 0.90, 0.99), (0.68, 0.58, 0.95)), (22, 9, 0), 0.1),
)


class Stem(NamedTuple):
    """Where a stem starts, and how it leans: degrees about x and y."""

    foot: tuple[float, float]
    lean: tuple[float, float]
    curve: tuple[float, float]
    """Further lean of each segment."""


STEM_SHAPES = (
    Stem((0.00, -0.05), (6.0, -8.0), (2.0, 2.5)),
    Stem((0.10, 0.08), (-12.0, 14.0), (-3.0, 4.0)),
    Stem((-0.11, 0.05), (-8.0, -15.0), (3.0, -5.0)),
)


def _joints() -> dict[str, Joint]:
    joints: dict[str, Joint] = {"pot": Joint(None, (0.0, 0.0, 0.0))}
    for s, stem in enumerate(STEM_SHAPES):
        for k in range(SEGMENTS):
            foot = Joint("pot", (*stem.foot, SOIL)) if k == 0 else Joint(f"stem_{s}_{k - 1}", (0.0, 0.0, SEGMENT))
            joints[f"stem_{s}_{k}"] = foot
        for leaf in range(LEAVES):
            height = (leaf + 1.0) / (LEAVES + 0.6) * (SEGMENTS - 0.4) * SEGMENT
            k = min(int(height / SEGMENT), SEGMENTS - 1)
            joints[f"leaf_{s}_{leaf}"] = Joint(f"stem_{s}_{k}", (0.0, 0.0, height - k * SEGMENT))
        joints[f"flower_{s}"] = Joint(f"stem_{s}_{SEGMENTS - 1}", (0.0, 0.0, SEGMENT))
    return joints


JOINTS = _joints()


def plant_transforms(time: float) -> dict[str, np.ndarray]:
    """Return bone-to-world [4, 4] of the pot, the segments, the leaves and the flowers."""
    turn = 2.0 * math.pi * time
    angles: dict[str, Vector] = {}
    for s, stem in enumerate(STEM_SHAPES):
        for k in range(SEGMENTS):
            lean = stem.lean if k == 0 else stem.curve
            bend = SWAY * math.sin(turn + 0.9 * s), SWAY * math.sin(turn + 1.7 * s + 0.8)
            angles[f"stem_{s}_{k}"] = (lean[0] + bend[0], lean[1] + bend[1], 0.0)
        for leaf in range(LEAVES):
            nod = 1.5 * math.sin(2.0 * turn + 1.3 * leaf + s)
            angles[f"leaf_{s}_{leaf}"] = (0.0, 0.0, nod)
        angles[f"flower_{s}"] = (1.5 * math.sin(turn + 2.0 * s), 1.5 * math.cos(turn + s), 0.0)
    return pose_joints(JOINTS, angles)


def _blade(length: float, width: float, droop: float) -> tuple[np.ndarray, np.ndarray]:
    """Make a pointed leaf or petal along +x: return vertices [P, 3] and faces [F, 3].

    Args:
        width: at its widest place.
        droop: fall of its tip.
    """
    along, across = grid(np.linspace(0.0, 1.0, 13), np.linspace(-1.0, 1.0, 7))
    half = width / 2 * (np.sin(math.pi * np.clip(along, 0.02, 0.99)) ** 0.75 * (1.15 - 0.35 * along))
    y = across * half
    z = 0.22 * length * np.sin(math.pi * along * 0.6) - droop * along * along + 0.6 * np.abs(y) ** 1.5
    return sheet(np.stack([along * length, y, z], -1), 0.0045)


def _pot() -> list[Piece]:
    outer = np.array([(0.20, 0.0), (0.25, 0.02), (0.29, 0.16), (0.34, 0.36), (0.345, 0.40), (0.40, 0.41), (0.41, 0.45)])
    inner = np.array(
        [(0.405, 0.52), (0.38, 0.53), (0.355, 0.52), (0.34, 0.44), (0.30, 0.36), (0.05, 0.34), (0.05, 0.0)]
    )
    profile = np.concatenate([outer, inner])
    saucer = np.array(
        [(0.30, 0.0), (0.36, 0.01), (0.43, 0.06), (0.42, 0.075), (0.33, 0.04), (0.05, 0.035), (0.05, 0.0)]
    )
    floor = placed(0.0, 0.0, FLOOR + 0.02)
    return [
        Piece(*lathe(profile, 48), CLAY, "pot", floor),
        Piece(*lathe(saucer, 48), CLAY, "pot", placed(0.0, 0.0, FLOOR - 0.02)),
        Piece(*disc(0.36, 0.04, 0.03), EARTH, "pot", placed(0.0, 0.0, SOIL - 0.04)),
    ]


def _stem(s: int) -> list[Piece]:
    pieces = []
    for k in range(SEGMENTS):
        stalk = capsule(SEGMENT, 0.022 - 0.002 * k, 0.03)
        pieces.append(Piece(*stalk, STALK, f"stem_{s}_{k}", placed(0.0, 0.0, SEGMENT / 2)))
    for leaf in range(LEAVES):
        share = leaf / (LEAVES - 1)
        length = 0.36 - 0.14 * share
        place = placed(turn=rotation(0.0, 0.0, GOLDEN * leaf + 50.0 * s)) @ placed(
            turn=rotation(12.0 * (-1) ** leaf, -18.0 - 22.0 * share, 0.0)
        )
        look = PALE if (leaf + s) % 3 == 0 else GREEN
        pieces.append(Piece(*_blade(length, 0.40 * length, 0.10), look, f"leaf_{s}_{leaf}", place))
    return pieces


def _flower(s: int) -> list[Piece]:
    facing = rotation(34.0, 12.0 * (s - 1), 0.0)
    pieces = []
    for k in range(PETALS):
        petal = placed(turn=facing) @ placed(0.0, 0.0, 0.02, rotation(0.0, -12.0, 360.0 / PETALS * k))
        pieces.append(Piece(*_blade(0.20, 0.13, 0.03), BLOSSOMS[s], f"flower_{s}", petal))
    heart = placed(turn=facing) @ placed(0.0, 0.0, 0.045)
    pieces.append(Piece(*rounded_box((0.065, 0.065, 0.045), 0.044, 8), HEART, f"flower_{s}", heart))
    return pieces


def make_still(device: str, shading: Shading) -> SurfaceSubject:
    """Make the plant in its pot."""
    pieces = _pot()
    for s in range(STEMS):
        pieces += [*_stem(s), *_flower(s)]
    return SurfaceSubject(RigidParts(merge(pieces), plant_transforms), device, shading, LAMP)
