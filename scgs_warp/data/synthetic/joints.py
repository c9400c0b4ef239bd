"""Skeletons of joints, and their poses from joint angles."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from .solids import Vector


class Joint(NamedTuple):
    """A joint of the skeleton: its parent (None: the world), and its position in the parent's frame."""

    parent: str | None
    position: Vector


def smoother_step(x: float) -> float:
    """Interpolate from 0 to 1 with zero first and second derivatives at both ends (Perlin's quintic)."""
    x = min(max(x, 0.0), 1.0)
    return x * x * x * (x * (6.0 * x - 15.0) + 10.0)


def rotation(x: float, y: float, z: float) -> np.ndarray:
    """Return the rotation matrix [3, 3], Rz Ry Rx, of angles in degrees about x, y, z."""
    result = np.eye(3)
    for axis, degrees in ((2, z), (1, y), (0, x)):
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        turn = np.eye(3)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
        result = result @ turn
    return result


def pose_joints(
    joints: Mapping[str, Joint], angles: Mapping[str, Vector], shift: Vector = (0.0, 0.0, 0.0)
) -> dict[str, np.ndarray]:
    """Return bone-to-world [4, 4] of every bone.

    Args:
        joints: parents precede children.
        angles: degrees about x, y, z of joints that turn (see ``rotation``).
        shift: moves the joints without a parent, world units.
    """
    transforms: dict[str, np.ndarray] = {}
    for name, joint in joints.items():
        own = np.eye(4)
        own[:3, :3] = rotation(*angles.get(name, (0.0, 0.0, 0.0)))
        own[:3, 3] = joint.position
        if joint.parent is None:
            own[:3, 3] += shift
        transforms[name] = own if joint.parent is None else transforms[joint.parent] @ own
    return transforms
