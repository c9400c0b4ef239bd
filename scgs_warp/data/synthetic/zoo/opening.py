"""A treasure chest whose lid opens; an egg rises out of it and splits into halves that show what is inside."""

from __future__ import annotations

import math

import numpy as np

from ....kernels import solid_textures as patterns
from ..joints import rotation, smoother_step
from ..raycast import Lamp
from ..shading import Shading
from ..sheets import grid, sheet
from ..solids import capsule, rounded_box, slab, torus
from ..surface import Material, Piece, RigidParts, merge, placed
from .subject import SurfaceSubject

HALF_X, HALF_Y = 0.62, 0.43
FLOOR, EDGE = -0.86, -0.30
"""Heights of the chest's bottom and of its upper edge, where the lid is hinged."""
WALL = 0.028
"""Half the thickness of a wall."""
CROWN = 0.33
"""Height of the lid."""
EGG = 0.17
STEP = 0.04
LAMP = Lamp(spread=0.22, sky_rays=24, key_rays=20)

WOOD = Material(
    int(patterns.PLANKS), ((0.72, 0.46, 0.26), (0.42, 0.24, 0.12), (0.16, 0.09, 0.05)), (0.9, 7.0, 0.0), 0.10, 20.0
)
LID = Material(
    int(patterns.PLANKS), ((0.78, 0.52, 0.28), (0.46, 0.26, 0.13), (0.16, 0.09, 0.05)), (0.9, 9.0, 0.0), 0.15, 20.0
)
BRASS = Material(int(patterns.CLOUDS), ((0.86, 0.62, 0.20), (0.98, 0.86, 0.48), (0.0, 0.0, 0.0)), (17, 0, 0), 0.6)
VELVET = Material(int(patterns.QUILT), ((0.55, 0.10, 0.16), (0.70, 0.16, 0.22), (0.85, 0.60, 0.24)), (5, 0, 5))
SHELL = Material(int(patterns.DOTS), ((0.20, 0.42, 0.70), (0.98, 0.88, 0.55), (0.92, 0.35, 0.30)), (8, 0, 12), 0.6)
YOLK = Material(int(patterns.SEGMENTS), ((0.98, 0.72, 0.16), (0.99, 0.92, 0.62), (0.85, 0.25, 0.2)), (6, 0, 14), 0.8)
GEMS = (
    Material(int(patterns.SEGMENTS), ((0.80, 0.12, 0.24), (0.96, 0.48, 0.48), (1.0, 0.9, 0.9)), (5, 0, 20), 0.8, 90.0),
    Material(int(patterns.CANDY), ((0.10, 0.54, 0.34), (0.62, 0.92, 0.62), (1.0, 1.0, 0.9)), (3, 0, 12), 0.8, 90.0),
    Material(int(patterns.CLOUDS), ((0.96, 0.76, 0.22), (0.80, 0.46, 0.12), (0.0, 0.0, 0.0)), (20, 0, 0), 0.7, 60.0),
    Material(int(patterns.DOTS), ((0.36, 0.24, 0.66), (0.86, 0.76, 0.98), (0.98, 0.9, 0.6)), (6, 0, 20), 0.8, 90.0),
)


def lid_angle(time: float) -> float:
    """Return the angle by which the lid is open, degrees."""
    return 112.0 * smoother_step((time - 0.04) / 0.42)


def opening_transforms(time: float) -> dict[str, np.ndarray]:
    """Return bone-to-world [4, 4] of the chest, its lid, the egg's halves and what is inside."""
    rise = smoother_step((time - 0.32) / 0.36)
    part = smoother_step((time - 0.66) / 0.30)
    egg = placed(0.0, -0.02, -0.62 + 0.95 * rise, rotation(0.0, 0.0, 200.0 * rise))
    upper = egg @ placed(0.10 * part, 0.0, 0.24 * part, rotation(0.0, 62.0 * part, 0.0))
    lower = egg @ placed(-0.02 * part, 0.0, -0.12 * part, rotation(0.0, -14.0 * part, 0.0))
    return {
        "chest": np.eye(4),
        "lid": placed(0.0, HALF_Y, EDGE, rotation(-lid_angle(time), 0.0, 0.0)),
        "upper": upper,
        "lower": lower,
        "yolk": egg @ placed(turn=rotation(0.0, 0.0, 140.0 * part)),
    }


def _chest() -> list[Piece]:
    height, middle = (EDGE - FLOOR) / 2, (EDGE + FLOOR) / 2
    upright, sideways = rotation(90.0, 0.0, 0.0), rotation(90.0, 0.0, 90.0)
    long, short = slab((HALF_X, height, WALL), STEP), slab((HALF_Y - 2 * WALL, height, WALL), STEP)
    pieces = [Piece(*slab((HALF_X - WALL, HALF_Y - WALL, WALL), STEP), WOOD, "chest", placed(0, 0, FLOOR + WALL))]
    for sign in (-1.0, 1.0):
        pieces.append(Piece(*long, WOOD, "chest", placed(0.0, sign * (HALF_Y - WALL), middle, upright)))
        pieces.append(Piece(*short, WOOD, "chest", placed(sign * (HALF_X - WALL), 0.0, middle, sideways)))
        for other in (-1.0, 1.0):
            post = rounded_box((0.05, 0.05, height + 0.025), 0.02, 9)
            corner = placed(sign * (HALF_X - 0.03), other * (HALF_Y - 0.03), middle - 0.03)
            pieces.append(Piece(*post, BRASS, "chest", corner))
        grip = placed(sign * (HALF_X + 0.02), 0.0, middle + 0.06, rotation(0.0, 90.0, 0.0))
        pieces.append(Piece(*torus(0.10, 0.018, 10), BRASS, "chest", grip))
    lining = slab((HALF_X - 2 * WALL, 0.02, HALF_Y - 2 * WALL), STEP)
    pieces.append(Piece(*lining, VELVET, "chest", placed(0, 0, FLOOR + 0.12, upright)))
    lock = rounded_box((0.075, 0.025, 0.08), 0.02, 8)
    pieces.append(Piece(*lock, BRASS, "chest", placed(0.0, -HALF_Y - 0.01, EDGE - 0.11)))
    return pieces


def _lid() -> list[Piece]:
    """Make the lid in the frame of its hinge; closed, it reaches from y = 0 to y = -2 ``HALF_Y``."""
    thickness = 0.022
    across, angle = grid(np.linspace(-HALF_X, HALF_X, 34), np.linspace(0.0, math.pi, 30))
    vault = np.stack([across, -HALF_Y - HALF_Y * np.cos(angle), 0.004 + CROWN * np.sin(angle)], -1)
    pieces = [Piece(*sheet(vault, thickness), LID, "lid", np.eye(4))]
    s, height = grid(np.sin(np.linspace(-1.48, 1.48, 28)), np.linspace(0.0, 1.0, 14))
    rim = np.sqrt(np.maximum(1.0 - s * s, 0.0))
    for sign in (-1.0, 1.0):
        gable = np.stack([0.0 * s, HALF_Y * s, CROWN * height * rim], -1)
        pieces.append(Piece(*sheet(gable, thickness), LID, "lid", placed(sign * (HALF_X - 0.025), -HALF_Y, 0.004)))
    for x in (-0.36, 0.36):
        along, turn = grid(np.linspace(-0.05, 0.05, 5), np.linspace(0.03, math.pi - 0.03, 40))
        reach_y, reach_z = HALF_Y + thickness + 0.004, CROWN + thickness + 0.004
        strap = np.stack([along, -HALF_Y - reach_y * np.cos(turn), reach_z * np.sin(turn)], -1)
        pieces.append(Piece(*sheet(strap, 0.01), BRASS, "lid", placed(x, 0.0, 0.0)))
    clasp = rounded_box((0.05, 0.02, 0.09), 0.018, 8)
    pieces.append(Piece(*clasp, BRASS, "lid", placed(0.0, -2 * HALF_Y - 0.03, 0.03)))
    return pieces


def _egg() -> list[Piece]:
    pieces = [Piece(*rounded_box((0.09, 0.09, 0.11), 0.09, 10), YOLK, "yolk", np.eye(4))]
    for name, sign in (("upper", 1.0), ("lower", -1.0)):
        polar, around = grid(np.linspace(0.02, math.pi / 2, 14), np.linspace(0.0, 2.0 * math.pi, 40))
        flat = np.sin(polar) * EGG
        height = sign * np.cos(polar) * EGG * (1.45 if sign > 0 else 1.1)
        half = np.stack([flat * np.cos(sign * around), flat * np.sin(sign * around), height], -1)
        pieces.append(Piece(*sheet(half, 0.008), SHELL, name, np.eye(4)))
        cap = capsule(0.012, 0.012, 0.01)
        pieces.append(Piece(*cap, BRASS, name, placed(0.0, 0.0, sign * EGG * (1.45 if sign > 0 else 1.1))))
    return pieces


def _treasure() -> list[Piece]:
    """Make gems in a ring around the egg, at golden angles."""
    pieces = []
    for k in range(26):
        share, angle = (k + 0.5) / 26, 2.399963 * k
        radius = 0.055 + 0.03 * ((k * 7) % 5) / 4
        x, y = (HALF_X - 0.16) * math.cos(angle), (HALF_Y - 0.16) * math.sin(angle)
        spread = 0.62 + 0.38 * math.sqrt(share)
        place = placed(x * spread, y * spread, FLOOR + 0.14 + radius, rotation(40.0 * k, 70.0 * k, 0.0))
        gem = rounded_box((radius, radius, radius * (0.7 + 0.3 * (k % 2))), 0.6 * radius, 5)
        pieces.append(Piece(*gem, GEMS[k % len(GEMS)], "chest", place))
    return pieces


def make_opening(device: str, shading: Shading) -> SurfaceSubject:
    """Make the chest with its contents."""
    mesh = merge([*_chest(), *_lid(), *_egg(), *_treasure()])
    return SurfaceSubject(RigidParts(mesh, opening_transforms), device, shading, LAMP)
