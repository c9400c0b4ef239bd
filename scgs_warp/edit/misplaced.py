"""Places in a script that lie far from the scene: signs of a script that was made for another one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ..storage.json_files import as_array
from .engine import Engine

FAR = 0.5
"""Distance from the nearest control point beyond which a place lies outside the scene, in units of the diagonal of the
box around the control points."""
TIMES = (0.0, 0.5, 1.0)


def misplaced(script: Any, engine: Engine) -> str | None:
    """Describe the place of a script that lies farthest from all control points, if it lies outside the scene.

    Args:
        script: JSON value of an edit file. Places are its regions ``{"point": [x, y, z]}``.

    Returns:
        The place, its distance and the size of the scene; None if all places are in the scene.
    """
    nodes = np.concatenate([engine.to_world(engine.motion_at(time).positions) for time in TIMES])
    size = float(np.linalg.norm(nodes.max(axis=0) - nodes.min(axis=0)))
    worst, found = FAR * size, None
    for place in _points(script):
        distance = float(np.linalg.norm(nodes - place, axis=1).min())
        if distance > worst:
            worst, found = distance, place
    if found is None:
        return None
    shown = ", ".join(f"{value:.3g}" for value in found)
    return f"the point ({shown}) is {worst:.3g} away from the nearest control point of a scene {size:.3g} in size"


def _points(value: Any) -> Iterator[np.ndarray]:
    if isinstance(value, dict):
        point = as_array(value.get("point"), (3,))
        if point is not None:
            yield point
        for inner in value.values():
            yield from _points(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _points(inner)
