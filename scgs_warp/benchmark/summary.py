"""What rows say together: the price of motion, and the paper's Table S2."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

from .timing import turns

PAPER_FPS = {"control-points": 295.4, "static": 298.5, "hexplane": 145.8, "per-gaussian": 113.3}
"""Frames a second in the seed's Table S2: 800 x 800, 48,980 Gaussians on average, RTX 3090 (SC-GS, 3D-GS, 4D-GS, and
the baseline that asks the network for every Gaussian)."""

Rows = list[dict[str, Any]]


def compare_frames(scenes: dict[str, Callable[[int], Any]], threads: int, seconds: float, device: str) -> Rows:
    """Frames of several motion models in turns, one frame each: what disturbs the machine meets all of them alike.

    Args:
        scenes: per motion model, what draws frame ``index``.
        threads: they draw on; for the rows only.
        seconds: for each model.

    Returns:
        Per model ``ms_median``, ``ms_min``, ``fps`` by the median, and ``ratios``: to every model's speed, the median
        over turns of its time divided by one's own in the same turn.
    """
    times = dict(zip(scenes, turns(list(scenes.values()), seconds, device)))
    found = []
    for motion, own in times.items():
        ratios = {peer: statistics.median(b / a for a, b in zip(own, other)) for peer, other in times.items()}
        middle = statistics.median(own)
        figures = {"ms_median": middle, "ms_min": min(own), "fps": 1e3 / middle, "ratios": ratios}
        found.append({"motion": motion, "threads": threads, **figures})
    return found


def motion_costs(rows: Rows, compared: Rows) -> Rows:
    """For every moving model and number of threads: ``ms_median`` and ``ms_min`` of network and skinning together, and
    ``ratio_to_static``, its frames a second divided by those of Gaussians at rest (None unless compared)."""
    ratios = {(one["motion"], one["threads"]): one["ratios"].get("static") for one in compared}
    found: dict[tuple[str, int], dict[str, Any]] = {}
    for row in rows:
        if row["name"] in ("frame/network", "frame/skin"):
            key = row["motion"], row["threads"]
            fresh = {"motion": key[0], "threads": key[1], "ms_median": 0.0, "ms_min": 0.0}
            cost = found.setdefault(key, {**fresh, "ratio_to_static": ratios.get(key)})
            for figure in ("ms_median", "ms_min"):
                cost[figure] += row[figure]
    return list(found.values())


def table_s2(compared: Rows) -> Rows:
    """Speeds relative to Gaussians at rest and to the model that asks the network for every Gaussian, here and in the
    paper: the machines differ, the ratios compare."""
    return [
        {
            "motion": one["motion"],
            "threads": one["threads"],
            "fps": one["fps"],
            "ratio_to_static": one["ratios"]["static"],
            "ratio_to_per_gaussian": one["ratios"]["per-gaussian"],
            "paper_fps": PAPER_FPS[one["motion"]],
            "paper_ratio_to_static": PAPER_FPS[one["motion"]] / PAPER_FPS["static"],
            "paper_ratio_to_per_gaussian": PAPER_FPS[one["motion"]] / PAPER_FPS["per-gaussian"],
        }
        for one in compared
    ]
