"""Parts and joints of a page's control points, for an editor in the page."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..edit import EditSession
from ..edit.skeleton import Skeleton
from ..geometry.normalisation import Normalisation
from ..scene.scene import Scene
from .page_data import Column, integers


def part_columns(scene: Scene) -> tuple[list[dict[str, Any]], list[Column]]:
    """Return the parts for a page's header, and the part of every control point as a column.

    Raises:
        UserError: the run's skeleton cannot be read.
    """
    skeleton = EditSession(scene).skeleton
    return part_facts(skeleton, scene.normalisation), [integers("part", skeleton.owners())]


def part_facts(skeleton: Skeleton, unit: Normalisation) -> list[dict[str, Any]]:
    """Describe parts: ``name``, ``parent`` (its row; -1: a root), ``joint`` [3] at time 0, normalised, ``axis`` [3] or
    None, ``degrees`` and ``confidence`` as in :class:`~scgs_warp.edit.skeleton.Part`."""
    rows = {name: row for row, name in enumerate(skeleton.names)}
    centre = np.asarray(unit.centre, np.float64)
    return [
        {
            "name": part.name,
            "parent": -1 if part.parent is None else rows[part.parent],
            "joint": ((np.array(part.joint) - centre) * unit.scale).tolist(),
            "axis": None if part.axis is None else list(part.axis),
            "degrees": part.degrees,
            "confidence": part.confidence,
        }
        for part in skeleton.parts
    ]
