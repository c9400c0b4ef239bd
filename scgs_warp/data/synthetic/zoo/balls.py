"""Four shiny balls that bounce on a round wooden table: cast shadows, highlights that move with the camera, separate
bodies."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from ....kernels import solid_textures as patterns
from ..joints import rotation
from ..raycast import Lamp
from ..shading import Shading
from ..solids import Vector, disc, rounded_box
from ..surface import Material, Piece, RigidParts, merge, placed
from .subject import SurfaceSubject

TABLE_TOP = -0.48
TABLE_RADIUS = 1.08
TABLE_HALF_HEIGHT = 0.04
TABLE_STEP = 0.027
"""Distance between the vertices of the table, which hold its light: about 1 % of the scene."""
LAMP = Lamp(spread=0.16, sky_rays=32, key_rays=40, reach=0.6)


class Ball(NamedTuple):
    """A ball that drifts over the table while it bounces."""

    name: str
    radius: float
    start: tuple[float, float]
    """Position of the centre over the table at time 0."""
    drift: tuple[float, float]
    """Way from time 0 to 1."""
    jump: float
    """Largest distance between the ball and the table."""
    bounces: float
    """Number of jumps from time 0 to 1."""
    phase: float
    """Share of the jump that is over at time 0."""
    spin: Vector
    """Degrees about x, y, z from time 0 to 1."""
    material: Material


BEACH = Material(
    int(patterns.SEGMENTS), ((0.93, 0.30, 0.22), (0.98, 0.93, 0.82), (0.99, 0.78, 0.25)), (6.0, 0.0, 3.0), 0.6, 60.0
)
CANDY = Material(
    int(patterns.CANDY), ((0.10, 0.50, 0.62), (0.60, 0.90, 0.82), (0.98, 0.96, 0.90)), (3.0, 0.0, 5.0), 0.7, 90.0
)
DOTS = Material(
    int(patterns.DOTS), ((0.45, 0.26, 0.62), (0.99, 0.80, 0.36), (0.98, 0.95, 0.90)), (8.0, 0.0, 11.0), 0.6, 60.0
)
MARBLE = Material(
    int(patterns.CLOUDS), ((0.16, 0.46, 0.20), (0.88, 0.94, 0.45), (0.9, 0.9, 0.8)), (13.0, 0.0, 0.0), 0.8, 130.0
)
TABLE = Material(
    int(patterns.PLANKS), ((0.86, 0.68, 0.46), (0.55, 0.36, 0.20), (0.24, 0.14, 0.08)), (1.1, 6.5, 0.0), 0.12, 25.0
)

BALLS = (
    Ball("beach", 0.27, (-0.38, 0.42), (0.30, 0.16), 0.62, 2.0, 0.25, (240.0, 90.0, 160.0), BEACH),
    Ball("candy", 0.22, (0.56, 0.20), (-0.10, -0.30), 0.80, 1.5, 0.60, (-200.0, 150.0, 300.0), CANDY),
    Ball("dots", 0.18, (-0.52, -0.42), (0.10, -0.05), 0.42, 3.0, 0.05, (120.0, -260.0, 100.0), DOTS),
    Ball("marble", 0.15, (0.16, -0.60), (0.36, 0.06), 0.58, 2.5, 0.85, (300.0, 200.0, -150.0), MARBLE),
)


def ball_centre(ball: Ball, time: float) -> np.ndarray:
    """Return the world position [3] of a ball's centre: parabolic jumps over a straight way."""
    share = (ball.phase + ball.bounces * time) % 1.0
    height = 4.0 * ball.jump * share * (1.0 - share)
    x, y = (start + time * way for start, way in zip(ball.start, ball.drift))
    return np.array([x, y, TABLE_TOP + ball.radius + height])


def ball_transforms(time: float, spins: bool = True) -> dict[str, np.ndarray]:
    """Return body-to-world [4, 4] of the balls and of the table; balls turn if ``spins``."""
    transforms = {"table": placed(0.0, 0.0, TABLE_TOP - TABLE_HALF_HEIGHT, rotation(0.0, 0.0, 25.0))}
    for ball in BALLS:
        x, y, z = ball.spin if spins else (0.0, 0.0, 0.0)
        spun = rotation(time * x, time * y, time * z)
        transforms[ball.name] = placed(*ball_centre(ball, time), turn=spun)
    return transforms


def make_balls(device: str, shading: Shading, spins: bool = True) -> SurfaceSubject:
    """Make the balls, which turn if ``spins``, and their table."""
    pieces = [Piece(*disc(TABLE_RADIUS, TABLE_HALF_HEIGHT, TABLE_STEP), TABLE, "table", np.eye(4))]
    for ball in BALLS:
        divisions = 6 + math.ceil(40 * ball.radius)
        solid = rounded_box((ball.radius, ball.radius, ball.radius), ball.radius, divisions)
        pieces.append(Piece(*solid, ball.material, ball.name, np.eye(4)))
    return SurfaceSubject(RigidParts(merge(pieces), partial(ball_transforms, spins=spins)), device, shading, LAMP)
