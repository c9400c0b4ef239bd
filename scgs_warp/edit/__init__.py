"""Editing: move control points by handles, and the Gaussians follow.

``EditSession`` holds a scene and its ``Edit``, a plain value; ``render_film`` films the result.
"""

from __future__ import annotations

from .body_motion import BodyMotion, motion_of_gltf, motion_of_session
from .document import Edit, Film, Shot, View
from .filming import film_camera, render_film
from .graph import ControlGraph, build_graph
from .handles import Handle, Target
from .keyframes import Keyframe
from .playback import Exaggerate, Hold, Playback
from .retarget import retarget
from .session import EditSession
from .solver import ArapSolver

__all__ = [
    "ArapSolver",
    "BodyMotion",
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
    "motion_of_gltf",
    "motion_of_session",
    "render_film",
    "retarget",
]
