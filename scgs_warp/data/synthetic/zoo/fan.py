"""A table fan: five different blades that spin several turns while the head swings from side to side."""

from __future__ import annotations

import math

import numpy as np

from ....kernels import solid_textures as patterns
from ..joints import rotation
from ..raycast import Lamp
from ..shading import Shading
from ..sheets import grid, sheet
from ..solids import capsule, disc, rounded_box, torus
from ..surface import Material, Piece, RigidParts, merge, placed
from .subject import SurfaceSubject

TURNS = 5.0
"""Full turns of the blades from time 0 to 1."""
GAIN = 0.25
"""The blades turn at (1 - GAIN) to (1 + GAIN) of their mean speed, faster and faster."""
SWING = 30.0
"""Largest angle of the head to each side, degrees."""
INNER, OUTER = 0.09, 0.62
HEAD_Z, BASE_Z = 0.30, -1.0
LAMP = Lamp(spread=0.2, sky_rays=32, key_rays=20)

BLADES = (
    Material(int(patterns.CHECKS), ((0.92, 0.30, 0.26), (0.99, 0.92, 0.80), (0.0, 0.0, 0.0)), (13.0, 13.0, 0.0), 0.35),
    Material(int(patterns.STRIPES), ((0.15, 0.50, 0.60), (0.65, 0.90, 0.86), (0.97, 0.80, 0.32)), (0, 0, 9.0), 0.35),
    Material(int(patterns.CLOUDS), ((0.98, 0.78, 0.24), (0.80, 0.34, 0.14), (0.0, 0.0, 0.0)), (11.0, 0.0, 0.0), 0.35),
    Material(int(patterns.QUILT), ((0.40, 0.30, 0.66), (0.93, 0.70, 0.86), (0.97, 0.95, 0.90)), (9.0, 0, 9.0), 0.35),
    Material(int(patterns.CANDY), ((0.16, 0.44, 0.22), (0.66, 0.88, 0.46), (0.95, 0.95, 0.80)), (2.0, 0.0, 7.0), 0.35),
)
"""Looks of the blades: no two are alike, so that a turn by a fifth does not look like none."""


def blade_angle(time: float) -> float:
    """Return the angle of the blades about their axle, degrees."""
    return 360.0 * TURNS * ((1.0 - GAIN) * time + GAIN * time * time)


def _blade() -> tuple[np.ndarray, np.ndarray]:
    """Make a twisted blade along +z from the axle, which is the y axis: return vertices [P, 3] and faces [F, 3]."""
    reach, across = grid(np.linspace(0.0, 1.0, 22), np.linspace(-1.0, 1.0, 15))
    radius = INNER + (OUTER - INNER) * reach
    half_width = 0.075 + 0.115 * np.sin(0.5 * math.pi * reach) * np.sqrt(np.maximum(1.0 - reach**6, 0.0)) + 0.002
    pitch = np.radians(42.0 - 22.0 * reach)
    side = across * half_width
    middle = np.stack([side * np.cos(pitch), side * np.sin(pitch) + 0.03 * across * across, radius], -1)
    return sheet(middle, 0.009)


def fan_transforms(time: float) -> dict[str, np.ndarray]:
    """Return bone-to-world [4, 4] of the stand, the head and the blades."""
    head = placed(0.0, 0.0, HEAD_Z, rotation(6.0, 0.0, SWING * math.sin(2.0 * math.pi * time)))
    return {
        "stand": np.eye(4),
        "head": head,
        "blades": head @ placed(0.0, -0.16, 0.0, rotation(0, blade_angle(time), 0)),
    }


def _stand() -> list[Piece]:
    enamel = Material(
        int(patterns.SEGMENTS), ((0.16, 0.30, 0.42), (0.22, 0.38, 0.52), (0.90, 0.80, 0.50)), (10, 0, 0), 0.4
    )
    chrome = Material(
        int(patterns.STRIPES), ((0.70, 0.72, 0.76), (0.88, 0.89, 0.92), (0.45, 0.47, 0.52)), (0, 0, 11), 0.6
    )
    plate = Material(int(patterns.CLOUDS), ((0.52, 0.54, 0.58), (0.86, 0.87, 0.90), (0, 0, 0)), (9.0, 0, 0), 0.4)
    button = Material(int(patterns.SEGMENTS), ((0.92, 0.30, 0.26), (0.98, 0.90, 0.75), (0.0, 0.0, 0.0)), (2, 0, 0), 0.4)
    pieces = [
        Piece(*disc(0.42, 0.035, 0.03), enamel, "stand", placed(0.0, 0.05, BASE_Z)),
        Piece(*disc(0.30, 0.03, 0.03), plate, "stand", placed(0.0, 0.05, BASE_Z + 0.06)),
        Piece(
            *capsule(HEAD_Z - BASE_Z - 0.10, 0.045, 0.03, 16), chrome, "stand", placed(0, 0.08, (HEAD_Z + BASE_Z) / 2)
        ),
    ]
    for k in range(3):
        knob = rounded_box((0.045, 0.045, 0.03), 0.02, 6)
        pieces.append(Piece(*knob, button, "stand", placed(0.12 * (k - 1), -0.22, BASE_Z + 0.10)))
    return pieces


def _head() -> list[Piece]:
    enamel = Material(int(patterns.DOTS), ((0.16, 0.30, 0.42), (0.90, 0.80, 0.50), (0.92, 0.30, 0.26)), (9, 0, 9), 0.5)
    wire = Material(int(patterns.SEGMENTS), ((0.80, 0.81, 0.84), (0.60, 0.62, 0.66), (0.3, 0.3, 0.3)), (24, 0, 0), 0.5)
    facing = rotation(90.0, 0.0, 0.0)
    pieces = [Piece(*rounded_box((0.13, 0.13, 0.17), 0.10, 10), enamel, "head", placed(0.0, 0.09, 0.0, facing))]
    pieces.append(Piece(*torus(0.70, 0.016, 20), wire, "head", placed(0.0, -0.10, 0.0, facing)))
    pieces.append(Piece(*torus(0.42, 0.008, 16), wire, "head", placed(0.0, -0.02, 0.0, facing)))
    for k in range(10):
        spoke = rotation(0.0, 36.0 * k, 0.0)
        tilt = rotation(7.0, 0.0, 0.0)
        place = placed(turn=spoke) @ placed(0.0, -0.045, 0.40, tilt)
        pieces.append(Piece(*capsule(0.58, 0.007, 0.04), wire, "head", place))
    return pieces


def make_fan(device: str, shading: Shading) -> SurfaceSubject:
    """Make the fan."""
    hub = Material(int(patterns.SEGMENTS), ((0.90, 0.80, 0.50), (0.16, 0.30, 0.42), (0.92, 0.30, 0.26)), (3, 0, 9), 0.6)
    pieces = [*_stand(), *_head()]
    pieces.append(Piece(*rounded_box((0.11, 0.11, 0.08), 0.06, 8), hub, "blades", placed(turn=rotation(90.0, 0, 0))))
    for k, material in enumerate(BLADES):
        pieces.append(Piece(*_blade(), material, "blades", placed(turn=rotation(0.0, 72.0 * k, 0.0))))
    return SurfaceSubject(RigidParts(merge(pieces), fan_transforms), device, shading, LAMP)
