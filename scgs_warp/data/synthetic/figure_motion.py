"""Motion of the built-in figure: its skeleton, and joint angles as smooth functions of time.

From time 0 to 1 the right arm swings up from the hip into a wave (137 degrees at the shoulder) while the figure takes
a step on the spot and looks from one side to the other; its scarf and antenna follow.
"""

from __future__ import annotations

import math

import numpy as np

from .joints import Joint, pose_joints, smoother_step
from .solids import Vector

BONES: dict[str, Joint] = {
    "hips": Joint(None, (0.0, 0.0, -0.40)),
    "torso": Joint("hips", (0.0, 0.0, 0.04)),
    "neck": Joint("torso", (0.0, 0.0, 0.60)),
    "head": Joint("neck", (0.0, 0.0, 0.03)),
    "antenna": Joint("head", (0.0, 0.0, 0.56)),
    "scarf": Joint("neck", (0.15, -0.20, -0.02)),
    "scarf_tip": Joint("scarf", (0.0, 0.0, -0.24)),
    "shoulder_left": Joint("torso", (0.365, 0.0, 0.45)),
    "elbow_left": Joint("shoulder_left", (0.0, 0.0, -0.28)),
    "shoulder_right": Joint("torso", (-0.365, 0.0, 0.45)),
    "elbow_right": Joint("shoulder_right", (0.0, 0.0, -0.28)),
    "hip_left": Joint("hips", (0.145, 0.0, -0.06)),
    "knee_left": Joint("hip_left", (0.0, 0.0, -0.26)),
    "hip_right": Joint("hips", (-0.145, 0.0, -0.06)),
    "knee_right": Joint("hip_right", (0.0, 0.0, -0.26)),
}


def joint_angles(time: float) -> dict[str, Vector]:
    """Return the angles in degrees about x, y, z of every moving joint. A negative x angle swings a limb forward,
    towards -y."""
    wave = math.sin(2.0 * math.pi * time)
    rise = smoother_step(time)
    return {
        "hips": (2.0 * math.sin(2.0 * math.pi * time + 0.5), 0.0, 7.0 * wave),
        "torso": (-3.0, 4.0 * rise, -12.0 * wave),
        "head": (4.0 - 8.0 * rise, 7.0 * wave, -32.0 + 60.0 * rise),
        "antenna": (9.0 * math.sin(4.0 * math.pi * time), 14.0 * math.cos(3.0 * math.pi * time), 0.0),
        "scarf": (-16.0 - 10.0 * wave, -8.0 + 14.0 * math.sin(2.0 * math.pi * time - 0.7), 0.0),
        "scarf_tip": (-6.0 - 10.0 * math.sin(2.0 * math.pi * time - 0.9), 12.0 * math.cos(2.0 * math.pi * time), 0.0),
        "shoulder_right": (-8.0 - 12.0 * rise, 16.0 + 137.0 * rise, 0.0),
        "elbow_right": (-22.0 + 4.0 * wave, -4.0 + 24.0 * math.sin(2.0 * math.pi * rise) * rise, 0.0),
        "shoulder_left": (26.0 * wave, -18.0 - 14.0 * rise, 0.0),
        "elbow_left": (-28.0 - 34.0 * rise, 0.0, 0.0),
        "hip_left": (-24.0 * wave, -3.0, 0.0),
        "knee_left": (20.0 + 18.0 * math.sin(2.0 * math.pi * time + 0.4), 0.0, 0.0),
        "hip_right": (24.0 * wave, 3.0, 0.0),
        "knee_right": (20.0 - 18.0 * math.sin(2.0 * math.pi * time + 0.4), 0.0, 0.0),
    }


def bone_transforms(time: float) -> dict[str, np.ndarray]:
    """Return bone-to-world [4, 4] of every bone at ``time`` in [0, 1]."""
    shift = (0.03 * math.sin(2.0 * math.pi * time), 0.0, 0.035 * math.cos(4.0 * math.pi * time))
    return pose_joints(BONES, joint_angles(time), shift)
