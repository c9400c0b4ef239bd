"""Joints and rods of the walking skeleton, and its gait.

It faces -y, its left is +x, and z is up. Radii are chosen for pictures of 400 x 400, where rods are 1 to 3 pixels wide.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..joints import Joint, pose_joints
from ..solids import Vector

STRIDES = 1.5
"""Number of full cycles of the gait from time 0 to 1."""
SPINE = 6
SPINE_STEP = 0.105
RIBS = (2, 3, 4, 5)
"""Spine bones that carry a pair of ribs."""
TAIL = 13
TAIL_STEP = 0.085
THICK, MIDDLE, THIN = 0.0085, 0.0068, 0.0050


class Rod(NamedTuple):
    """A straight rod with round ends, rigid on a bone."""

    name: str
    bone: str
    start: Vector
    end: Vector
    radius: float
    group: str
    """Rods of one group have one look."""


def _side_joints(side: str, sign: float) -> dict[str, Joint]:
    chest = f"spine_{SPINE - 1}"
    joints = {
        f"shoulder_{side}": Joint(chest, (0.23 * sign, 0.0, 0.02)),
        f"elbow_{side}": Joint(f"shoulder_{side}", (0.0, 0.0, -0.30)),
        f"wrist_{side}": Joint(f"elbow_{side}", (0.0, 0.0, -0.27)),
        f"hip_{side}": Joint("pelvis", (0.115 * sign, 0.0, -0.06)),
        f"knee_{side}": Joint(f"hip_{side}", (0.0, 0.0, -0.40)),
        f"ankle_{side}": Joint(f"knee_{side}", (0.0, 0.0, -0.38)),
        f"toes_{side}": Joint(f"ankle_{side}", (0.0, -0.13, -0.055)),
    }
    for finger in range(3):
        joints[f"finger_{finger}_{side}"] = Joint(f"wrist_{side}", (0.0, -0.03 + 0.03 * finger, -0.08))
    return joints


def _joints() -> dict[str, Joint]:
    joints = {"pelvis": Joint(None, (0.0, 0.0, -0.08))}
    for k in range(SPINE):
        parent, place = ("pelvis", (0.0, 0.03, 0.0)) if k == 0 else (f"spine_{k - 1}", (0.0, 0.0, SPINE_STEP))
        joints[f"spine_{k}"] = Joint(parent, place)
    joints["neck"] = Joint(f"spine_{SPINE - 1}", (0.0, 0.0, SPINE_STEP))
    joints["head"] = Joint("neck", (0.0, -0.02, 0.10))
    joints["jaw"] = Joint("head", (0.0, -0.01, 0.02))
    for k in range(TAIL):
        parent, place = ("pelvis", (0.0, 0.06, 0.0)) if k == 0 else (f"tail_{k - 1}", (0.0, TAIL_STEP, 0.0))
        joints[f"tail_{k}"] = Joint(parent, place)
    return {**joints, **_side_joints("left", 1.0), **_side_joints("right", -1.0)}


JOINTS = _joints()


def _chain(name: str, bone: str, points: list[Vector], radius: float, group: str) -> list[Rod]:
    """Join consecutive points by rods."""
    return [Rod(f"{name}_{k}", bone, start, end, radius, group) for k, (start, end) in enumerate(pairwise(points))]


def _arc(centre: Vector, u: Vector, v: Vector, first: float, last: float, count: int) -> list[Vector]:
    """Return ``count`` + 1 points ``centre + u cos a + v sin a``, with a from ``first`` to ``last`` degrees."""
    angles = np.radians(np.linspace(first, last, count + 1))
    points = np.asarray(centre) + np.cos(angles)[:, None] * np.asarray(u) + np.sin(angles)[:, None] * np.asarray(v)
    return [(float(x), float(y), float(z)) for x, y, z in points]


def _trunk() -> list[Rod]:
    rods = [Rod(f"spine_{k}", f"spine_{k}", (0, 0, 0), (0, 0, SPINE_STEP), THICK, "spine") for k in range(SPINE)]
    rods.append(Rod("neck", "neck", (0, 0, 0), (0, -0.02, 0.10), MIDDLE, "spine"))
    for k in RIBS:
        width, depth = 0.13 + 0.018 * k, 0.105 + 0.012 * k
        for side, sign in (("left", 1.0), ("right", -1.0)):
            arc = _arc((0.0, -depth, 0.04), (0.0, depth, 0.0), (width * sign, 0.0, 0.0), 0.0, 160.0, 6)
            arc = [(x, y, z - 0.05 * abs(y) / depth) for x, y, z in arc]
            rods += _chain(f"rib_{k}_{side}", f"spine_{k}", arc, THIN, "ribs")
    rods += _chain("sternum", "spine_4", [(0, -0.29, 0.08), (0, -0.28, -0.02), (0, -0.26, -0.12)], MIDDLE, "ribs")
    for k in range(TAIL):
        radius = THICK + (THIN - THICK) * k / (TAIL - 1)
        rods.append(Rod(f"tail_{k}", f"tail_{k}", (0, 0, 0), (0, TAIL_STEP, 0), radius, "tail"))
    basin = [(-0.115, 0.0, -0.06), (-0.15, 0.03, 0.05), (0.0, 0.06, 0.0), (0.15, 0.03, 0.05), (0.115, 0.0, -0.06)]
    rods += _chain("pelvis", "pelvis", [*basin, (0.0, -0.04, -0.05), basin[0]], MIDDLE, "spine")
    return rods


def _skull() -> list[Rod]:
    centre = (0.0, -0.03, 0.13)
    rods = _chain("brow", "head", _arc(centre, (0.115, 0, 0), (0, 0.14, 0), 0.0, 360.0, 12), THIN, "head")
    rods += _chain("crown", "head", _arc(centre, (0, -0.14, 0), (0, 0, 0.13), 0.0, 200.0, 8), THIN, "head")
    rods += _chain("vault", "head", _arc(centre, (0.115, 0, 0), (0, 0, 0.13), 0.0, 180.0, 8), THIN, "head")
    for side, sign in (("left", 1.0), ("right", -1.0)):
        eye = _arc((0.052 * sign, -0.15, 0.085), (0.036, 0, 0), (0, 0, 0.032), 0.0, 360.0, 6)
        rods += _chain(f"eye_{side}", "head", eye, THIN, "eyes")
        cheek = (0.115 * sign, -0.03, 0.13), (0.055 * sign, -0.15, 0.02)
        rods.append(Rod(f"cheek_{side}", "head", *cheek, THIN, "head"))
        jaw = [(0.095 * sign, 0.0, 0.05), (0.06 * sign, -0.10, -0.02), (0.0, -0.15, -0.03)]
        rods += _chain(f"jaw_{side}", "jaw", jaw, THIN, "head")
    return rods


def _limbs(side: str, sign: float) -> list[Rod]:
    chest, wrist, ankle, toes = f"spine_{SPINE - 1}", f"wrist_{side}", f"ankle_{side}", f"toes_{side}"
    rods = [
        Rod(f"collar_{side}", chest, (0, 0, 0.06), (0.23 * sign, 0, 0.02), MIDDLE, "spine"),
        Rod(f"upper_arm_{side}", f"shoulder_{side}", (0, 0, 0), (0, 0, -0.30), THICK, "arms"),
        Rod(f"radius_{side}", f"elbow_{side}", (0.014, 0, 0), (0.010, 0, -0.27), THIN, "arms"),
        Rod(f"ulna_{side}", f"elbow_{side}", (-0.014, 0, 0), (-0.010, 0, -0.27), THIN, "arms"),
        Rod(f"thigh_{side}", f"hip_{side}", (0, 0, 0), (0, 0, -0.40), THICK, "legs"),
        Rod(f"shin_{side}", f"knee_{side}", (0, -0.008, 0), (0, -0.004, -0.38), MIDDLE, "legs"),
        Rod(f"fibula_{side}", f"knee_{side}", (0.022 * sign, 0.014, -0.02), (0.018 * sign, 0.01, -0.37), THIN, "legs"),
        Rod(f"heel_{side}", ankle, (0, 0, 0), (0, 0.06, -0.055), MIDDLE, "feet"),
    ]
    for k in range(3):
        across = 0.03 * (k - 1)
        finger = f"finger_{k}_{side}"
        rods.append(Rod(f"palm_{k}_{side}", wrist, (0, 0, 0), (0, across, -0.08), THIN, "hands"))
        rods += _chain(finger, finger, [(0, 0, 0), (0, 0, -0.055), (0, -0.012, -0.10)], THIN, "hands")
        rods.append(Rod(f"foot_{k}_{side}", ankle, (0, 0, 0), (across * 0.9, -0.13, -0.055), THIN, "feet"))
        rods.append(Rod(f"toe_{k}_{side}", toes, (across * 0.9, 0, 0), (across * 1.5, -0.085, 0), THIN, "feet"))
    return rods


RODS: tuple[Rod, ...] = (*_trunk(), *_skull(), *_limbs("left", 1.0), *_limbs("right", -1.0))


def _limb_angles(side: str, phase: float) -> dict[str, Vector]:
    """Return the angles of one leg at a phase of its gait (radians), and of the arm on the other side."""
    other = "right" if side == "left" else "left"
    swing, lift = math.sin(phase), max(0.0, math.cos(phase))
    angles = {
        f"hip_{side}": (-6.0 - 33.0 * swing, 0.0, 0.0),
        f"knee_{side}": (12.0 + 62.0 * lift * lift, 0.0, 0.0),
        f"ankle_{side}": (8.0 * swing - 16.0 * lift, 0.0, 0.0),
        f"toes_{side}": (22.0 * max(0.0, -swing), 0.0, 0.0),
        f"shoulder_{other}": (-4.0 - 34.0 * swing, -9.0 if other == "left" else 9.0, 0.0),
        f"elbow_{other}": (-38.0 - 22.0 * swing, 0.0, 0.0),
        f"wrist_{other}": (10.0 * math.sin(phase - 0.8), 0.0, 0.0),
    }
    for k in range(3):
        angles[f"finger_{k}_{other}"] = (14.0 * (1 - k), -18.0 * math.sin(phase + 0.7 * k), 0.0)
    return angles


def joint_angles(time: float) -> dict[str, Vector]:
    """Return the angles in degrees about x, y, z of every moving joint."""
    phase = 2.0 * math.pi * STRIDES * time
    angles = {
        "pelvis": (0.0, 3.0 * math.sin(phase), 12.0 - 24.0 * time + 7.0 * math.sin(phase)),
        "neck": (-4.0, 0.0, 0.0),
        "head": (6.0 * math.sin(2.0 * phase), 0.0, 34.0 * math.sin(math.pi * (2.0 * time - 0.5))),
        "jaw": (9.0 + 9.0 * math.sin(phase), 0.0, 0.0),
        **_limb_angles("left", phase),
        **_limb_angles("right", phase + math.pi),
    }
    for k in range(SPINE):
        angles[f"spine_{k}"] = (1.5, 1.2 * math.sin(phase), -2.6 * math.sin(phase))
    for k in range(TAIL):
        growth = 6.0 + 24.0 * k / (TAIL - 1)
        curl = 30.0 if k == 0 else -3.0 + 4.0 * math.sin(phase - 0.4 * k)
        angles[f"tail_{k}"] = (curl, 0.0, growth * math.sin(1.8 * phase - 0.55 * k))
    return angles


def bone_transforms(time: float) -> dict[str, np.ndarray]:
    """Return bone-to-world [4, 4] of every bone at ``time`` in [0, 1]."""
    phase = 2.0 * math.pi * STRIDES * time
    shift = (0.02 * math.sin(phase), 0.12 - 0.34 * time, 0.025 * math.cos(2.0 * phase))
    return pose_joints(JOINTS, joint_angles(time), shift)
