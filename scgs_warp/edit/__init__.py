"""Editing: take hold of control points, move them, and the scene follows.

``EditSession`` is all that an editor needs; ``Edit`` is what it makes, ``render_film`` what it is for.
"""

from __future__ import annotations

from .document import Edit, Film, Shot, View
from .filming import film_camera, render_film
from .graph import ControlGraph, build_graph
from .handles import Handle, Target
from .keyframes import Keyframe
from .playback import Exaggerate, Hold, Playback
from .session import EditSession
from .solver import ArapSolver

__all__ = [
    "ArapSolver",
    "ControlGraph",
    "Edit",
    "EditSession",
    "Exaggerate",
    "Film",
    "Handle",
    "Hold",
    "Keyframe",
    "Playback",
    "Shot",
    "Target",
    "View",
    "build_graph",
    "film_camera",
    "render_film",
]
