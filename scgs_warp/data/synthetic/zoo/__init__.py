"""Built-in moving subjects, each a test of one difficulty."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from ..builtin import FigureSubject
from ..renderer import Subject
from ..shading import Shading
from .balls import make_balls
from .cloth import make_cloth
from .fan import make_fan
from .opening import make_opening
from .rods import make_rods
from .still import make_still
from .touch import make_touch

Maker = Callable[[str, Shading], Subject]
"""Makes a subject on a device (``cpu`` or ``cuda``) under a light."""

SUBJECTS: dict[str, Maker] = {
    "robot": FigureSubject,
    "rods": partial(make_rods, dark=False),
    "rods-dark": partial(make_rods, dark=True),
    "balls": make_balls,
    "balls-steady": partial(make_balls, spins=False),
    "cloth": make_cloth,
    "fan": make_fan,
    "touch": make_touch,
    "opening": make_opening,
    "still": make_still,
}
"""Maker of each subject, by the name that ``apps/synthesize.py --subject`` takes."""

VERSION = 1
"""Version of the shapes, motions and looks of all subjects but the robot."""
