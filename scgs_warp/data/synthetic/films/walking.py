"""Motion of the built-in figure as it walks about a room, turns and waves."""

from __future__ import annotations

import math

import numpy as np

from ..figure_motion import BONES
from ..joints import pose_joints, rotation, smoother_step
from ..solids import Vector
from ..surface import placed

STEPS = 6.0
"""Number of strides (two steps each) from time 0 to 1."""
REACH = (0.75, 0.55)
"""Half axes of the way on the floor, along x and y."""


def walking_angles(time: float) -> dict[str, Vector]:
    """Return the angles in degrees about x, y, z of every moving joint; a negative x angle swings a limb forward."""
    phase = 2.0 * math.pi * STEPS * time
    stride, lift = math.sin(phase), math.cos(phase)
    wave = smoother_step((time - 0.35) / 0.2) * (1.0 - smoother_step((time - 0.8) / 0.15))
    waving = math.sin(2.0 * math.pi * 7.0 * time)
    return {
        "hips": (0.0, 2.0 * stride, 5.0 * stride),
        "torso": (-4.0, -2.0 * stride, -9.0 * stride),
        "head": (3.0, 5.0 * math.sin(2.0 * math.pi * time), 24.0 * math.sin(2.0 * math.pi * 1.3 * time)),
        "antenna": (8.0 * math.sin(2.0 * phase), 10.0 * stride, 0.0),
        "scarf": (-18.0 - 8.0 * lift, 7.0 * stride, 0.0),
        "scarf_tip": (-8.0 - 8.0 * lift, 9.0 * stride, 0.0),
        "shoulder_right": (22.0 * stride * (1.0 - wave) - 8.0 * wave, 14.0 + 126.0 * wave, 0.0),
        "elbow_right": (-24.0, 22.0 * waving * wave, 0.0),
        "shoulder_left": (-24.0 * stride, -14.0, 0.0),
        "elbow_left": (-30.0 + 8.0 * stride, 0.0, 0.0),
        "hip_left": (26.0 * stride, -2.0, 0.0),
        "knee_left": (18.0 + 18.0 * lift, 0.0, 0.0),
        "hip_right": (-26.0 * stride, 2.0, 0.0),
        "knee_right": (18.0 - 18.0 * lift, 0.0, 0.0),
    }


def walking_transforms(time: float) -> dict[str, np.ndarray]:
    """Return bone-to-world [4, 4] of every bone at ``time`` in [0, 1]."""
    angle = 2.0 * math.pi * (0.42 * time + 0.29)
    x, y = REACH[0] * math.cos(angle), 0.35 - REACH[1] * math.sin(angle) * math.sin(0.5 * angle)
    turn = 40.0 * math.sin(2.0 * math.pi * (time - 0.1))
    bob = 0.03 * math.cos(4.0 * math.pi * STEPS * time)
    root = placed(x, y, bob, rotation(0.0, 0.0, turn))
    return {bone: root @ transform for bone, transform in pose_joints(BONES, walking_angles(time)).items()}
