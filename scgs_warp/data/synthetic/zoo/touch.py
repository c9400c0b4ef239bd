"""Two round creatures that meet, press against each other for a while and part again; both bodies are squashed."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ....kernels import solid_textures as patterns
from ..joints import Joint, pose_joints, rotation, smoother_step
from ..raycast import Lamp
from ..shading import Shading
from ..solids import Vector, capsule, rounded_box
from ..surface import DeformedParts, JoinedSurfaces, Material, Piece, RigidParts, merge, placed
from .subject import SurfaceSubject

HALF: Vector = (0.40, 0.37, 0.44)
"""Half extents of a body."""
FAR, NEAR = 0.74, 0.29
"""Distance of a creature's centre from the plane between both, apart and in contact; less than ``HALF[0]`` squashes."""
GAP = 0.002
"""Distance of each body from the plane in contact."""
SOFTNESS = 0.02
"""Distance from the plane at which the squash begins."""
CONTACT = (0.36, 0.64)
"""Times between which the bodies press against each other with full strength."""
LAMP = Lamp(spread=0.2, sky_rays=32, key_rays=20)


class Creature(NamedTuple):
    """Looks and habits of one creature. In its own frame, its partner is at +x, and its left is +y."""

    name: str
    body: Material
    limbs: Material
    steps: float
    """Number of hops on its way to the other."""


JOINTS = {
    "body": Joint(None, (0.0, 0.0, 0.0)),
    "arm_left": Joint("body", (0.02, 0.34, 0.05)),
    "arm_right": Joint("body", (0.02, -0.34, 0.05)),
    "foot_left": Joint("body", (0.0, 0.17, -0.38)),
    "foot_right": Joint("body", (0.0, -0.17, -0.38)),
    "feeler_left": Joint("body", (-0.04, 0.13, 0.40)),
    "feeler_right": Joint("body", (-0.04, -0.13, 0.40)),
}

CREATURES = (
    Creature(
        "coral",
        Material(int(patterns.CANDY), ((0.92, 0.38, 0.28), (0.99, 0.88, 0.70), (0.62, 0.14, 0.20)), (4, 0, 2.6), 0.3),
        Material(int(patterns.STRIPES), ((0.62, 0.14, 0.20), (0.98, 0.78, 0.40), (0.95, 0.92, 0.85)), (0, 0, 14), 0.2),
        2.0,
    ),
    Creature(
        "teal",
        Material(int(patterns.DOTS), ((0.12, 0.52, 0.56), (0.99, 0.92, 0.60), (0.16, 0.24, 0.48)), (9, 0, 6.0), 0.3),
        Material(int(patterns.CHECKS), ((0.16, 0.24, 0.48), (0.70, 0.90, 0.84), (0.0, 0.0, 0.0)), (17, 17, 17), 0.2),
        3.0,
    ),
)


def closeness(time: float) -> float:
    """Return 0 where the creatures are apart, 1 while they press against each other."""
    start, end = CONTACT
    return smoother_step((time - 0.06) / (start - 0.06)) * smoother_step((0.94 - time) / (0.94 - end))


def _pieces(creature: Creature) -> list[Piece]:
    white = Material(int(patterns.SEGMENTS), ((0.97, 0.97, 0.95), (0.97, 0.97, 0.95), (1.0, 1.0, 1.0)), (1, 0, 0), 0.6)
    black = Material(int(patterns.SEGMENTS), ((0.06, 0.06, 0.10), (0.10, 0.08, 0.16), (0.0, 0.0, 0.0)), (2, 0, 0), 0.8)
    pieces = [Piece(*rounded_box(HALF, min(HALF), 22), creature.body, "body", np.eye(4))]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        eye = rounded_box((0.085, 0.085, 0.095), 0.085, 8)
        pupil = rounded_box((0.045, 0.045, 0.05), 0.045, 6)
        pieces.append(Piece(*eye, white, "body", placed(0.17, 0.13 * sign, 0.33)))
        pieces.append(Piece(*pupil, black, "body", placed(0.215, 0.145 * sign, 0.365)))
        outward = rotation(-62.0 * sign, 0.0, 0.0)
        arm = placed(turn=outward) @ placed(0.0, 0.0, 0.13)
        pieces.append(Piece(*capsule(0.22, 0.05, 0.03, 12), creature.limbs, f"arm_{side}", arm))
        hand = placed(turn=outward) @ placed(0.0, 0.0, 0.28)
        pieces.append(Piece(*rounded_box((0.075, 0.075, 0.075), 0.075, 8), creature.body, f"arm_{side}", hand))
        foot = rounded_box((0.16, 0.10, 0.07), 0.065, 10)
        pieces.append(Piece(*foot, creature.limbs, f"foot_{side}", placed(0.03, 0.0, -0.08)))
        feeler = placed(0.0, 0.0, 0.11)
        pieces.append(Piece(*capsule(0.20, 0.018, 0.03, 8), creature.limbs, f"feeler_{side}", feeler))
        tip = rounded_box((0.05, 0.05, 0.05), 0.05, 6)
        pieces.append(Piece(*tip, creature.body, f"feeler_{side}", placed(0.0, 0.0, 0.24)))
    return pieces


def _limb_transforms(creature: Creature, time: float) -> dict[str, np.ndarray]:
    """Return bone-to-creature [4, 4]."""
    turn = 2.0 * math.pi * time
    step = math.sin(2.0 * math.pi * creature.steps * time) * (1.0 - closeness(time))
    wave = math.sin(3.0 * turn)
    angles = {
        "arm_left": (22.0 * wave - 10.0, 24.0 * step, 0.0),
        "arm_right": (22.0 * wave + 10.0, -24.0 * step, 0.0),
        "foot_left": (0.0, 24.0 * step, 0.0),
        "foot_right": (0.0, -24.0 * step, 0.0),
        "feeler_left": (-14.0, 16.0 * math.sin(2.0 * turn + 0.5), 0.0),
        "feeler_right": (14.0, 16.0 * math.sin(2.0 * turn - 0.3), 0.0),
    }
    return pose_joints(JOINTS, angles)


def squashed(points: np.ndarray, distance: float) -> np.ndarray:
    """Squash points [P, 3] of a creature, in its frame, against the plane x = ``distance``.

    Points approach the plane up to ``GAP``, and never reach it; the body bulges near it.
    """
    before = distance - GAP - points[:, 0]
    kept = SOFTNESS * np.logaddexp(0.0, before / SOFTNESS)
    pressure = max(HALF[0] - distance, 0.0) / HALF[0]
    bulge = 1.0 + 0.55 * pressure * np.exp(-((kept / 0.35) ** 2))
    return np.stack([distance - GAP - kept, points[:, 1] * bulge, points[:, 2] * bulge], -1)


def _embrace(time: float) -> np.ndarray:
    """Return the rigid motion [4, 4] of the creatures and of the plane between them."""
    together = closeness(time)
    sway = math.sin(2.0 * math.pi * time)
    turn = rotation(0.0, 9.0 * math.sin(6.0 * math.pi * time) * together, 28.0 * sway)
    return placed(0.0, 0.0, -0.04 + 0.05 * together, turn)


def _surface(creature: Creature, side: float) -> DeformedParts:
    """Make one creature; ``side`` is -1 where its partner is at +x, and 1 on the other side."""
    mesh = merge(_pieces(creature))
    rigid = RigidParts(mesh, lambda time: _limb_transforms(creature, time))

    def deform(points: np.ndarray, time: float) -> np.ndarray:
        near = closeness(time)
        distance = FAR + (NEAR - FAR) * near
        moved = squashed(rigid.posed(time)[0], distance)
        hop = 0.10 * abs(math.sin(math.pi * creature.steps * time * 2.0)) * (1.0 - near)
        moved = moved + np.array([-distance, 0.0, hop])
        if side > 0:  # Half a turn about z, so that the creature faces its partner.
            moved = moved * np.array([-1.0, -1.0, 1.0])
        matrix = _embrace(time)
        return moved @ matrix[:3, :3].T + matrix[:3, 3]

    return DeformedParts(mesh, deform)


def make_touch(device: str, shading: Shading) -> SurfaceSubject:
    """Make the two creatures."""
    surfaces = [_surface(creature, side) for creature, side in zip(CREATURES, (-1.0, 1.0))]
    return SurfaceSubject(JoinedSurfaces(surfaces), device, shading, LAMP)
