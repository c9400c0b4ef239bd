"""Exposures of a rig's cameras, by the points that several of their still pictures show. Training averages the colours
of all cameras, so that a darker one darkens what it sees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..colmap import quiet, read_model
from ..features import FrameFiles
from ..source import read_rgb

DARKEST, BRIGHTEST = 6, 250
"""Levels between which pixels tell the exposure."""
FEWEST = 20
"""Least number of points that two cameras share, for their exposures to be compared."""
DIFFERENT = 1.15
"""Ratio of brightness above which the user gets a note."""


def describe_exposures(folder: Path, stills: FrameFiles, names: Sequence[str]) -> list[str]:
    """Name the cameras that show the same points darker or brighter than most, by the model in a folder."""
    model = read_model(folder)
    with quiet():
        levels = _levels(model, stills)
    found = relative_brightness(levels, [name for name in stills.names if name in levels])
    odd = {stem: found[name] for stem, name in zip(names, stills.names) if name in found}
    odd = {stem: times for stem, times in odd.items() if max(times, 1.0 / times) > DIFFERENT}
    if not odd:
        return []
    shown = ", ".join(f"{stem} {times:.2f}" for stem, times in odd.items())
    return [
        f"note: exposures differ; times as bright as most cameras: {shown}. Training averages colours; --set "
        "optim.frame_colors=2e-3 gives each frame its own"
    ]


def _levels(model: Any, stills: FrameFiles) -> dict[str, dict[int, float]]:
    """Return the logarithm of the brightness at which each picture shows points, by its name and their numbers."""
    levels = {}
    for image in model.images.values():
        if image.has_pose:
            gray = cv2.blur(cv2.cvtColor(read_rgb(stills.folder / image.name), cv2.COLOR_RGB2GRAY), (5, 5))
            own = {each.point3D_id: np.floor(each.xy).astype(int) for each in image.points2D if each.has_point3D()}
            height, width = gray.shape
            seen = {
                key: int(gray[min(max(y, 0), height - 1), min(max(x, 0), width - 1)]) for key, (x, y) in own.items()
            }
            levels[image.name] = {k: float(np.log(v)) for k, v in seen.items() if DARKEST <= v <= BRIGHTEST}
    return levels


def relative_brightness(levels: Mapping[str, Mapping[int, float]], names: Sequence[str]) -> dict[str, float]:
    """Return how many times as bright as most pictures each one shows the points that they share.

    Args:
        levels: logarithm of the brightness of points, by the picture's name and the number of the point.
        names: names of the pictures. Pictures that share too little with all others are left out.
    """
    used: set[int] = set()
    rows, wanted = [], []
    for a, b in combinations(range(len(names)), 2):
        one, two = levels[names[a]], levels[names[b]]
        shared = [two[key] - one[key] for key in one.keys() & two.keys()]
        if len(shared) >= FEWEST:
            row, weight = np.zeros(len(names)), np.sqrt(len(shared))
            row[a], row[b] = -weight, weight
            rows.append(row)
            wanted.append(weight * float(np.median(shared)))
            used |= {a, b}
    if not rows:
        return {}
    found = np.linalg.lstsq(np.array(rows), np.array(wanted), rcond=None)[0]
    usual = float(np.median(found[sorted(used)]))
    return {names[k]: float(np.exp(found[k] - usual)) for k in sorted(used)}
