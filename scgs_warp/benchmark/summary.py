"""Summaries of rows: the cost of motion, and the paper's Table S2."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

from .timing import turns

PAPER_FPS = {"control-points": 295.4, "static": 298.5, "hexplane": 145.8, "per-gaussian": 113.3}
"""Frames per second in the paper's Table S2: 800 x 800, 48,980 Gaussians on average, RTX 3090 (SC-GS, 3D-GS, 4D-GS, and
the baseline with one network query per Gaussian)."""

Rows = list[dict[str, Any]]


def compare_frames(scenes: dict[str, Callable[[int], Any]], threads: int, seconds: float, device: str) -> Rows:
    """Draw frames of several motion models in turns, so that a disturbance of the machine affects all of them alike.

    Args:
        scenes: By motion model, the function that draws frame ``index``.
        threads: Number of threads that they use, for the rows only.
        seconds: Time for each model.

    Returns:
        By model ``ms_median``, ``ms_min``, ``fps`` by the median, and ``ratios``: the speed relative to every model, as
        the median over turns of the other model's time divided by this model's.
    """
    times = dict(zip(scenes, turns(list(scenes.values()), seconds, device)))
    rows = []
    for motion, own in times.items():
        ratios = {peer: statistics.median(b / a for a, b in zip(own, other)) for peer, other in times.items()}
        middle = statistics.median(own)
        figures = {"ms_median": middle, "ms_min": min(own), "fps": 1e3 / middle, "ratios": ratios}
        rows.append({"motion": motion, "threads": threads, **figures})
    return rows


def motion_costs(rows: Rows, compared: Rows) -> Rows:
    """Add up the times of network and skinning for every moving model and number of threads.

    Returns:
        ``ms_median``, ``ms_min``, and ``ratio_to_static``: frames per second relative to Gaussians at rest, None unless
        compared.
    """
    ratios = {(one["motion"], one["threads"]): one["ratios"].get("static") for one in compared}
    costs: dict[tuple[str, int], dict[str, Any]] = {}
    for row in rows:
        if row["name"] in ("frame/network", "frame/skin"):
            key = row["motion"], row["threads"]
            fresh = {"motion": key[0], "threads": key[1], "ms_median": 0.0, "ms_min": 0.0}
            cost = costs.setdefault(key, {**fresh, "ratio_to_static": ratios.get(key)})
            for figure in ("ms_median", "ms_min"):
                cost[figure] += row[figure]
    return list(costs.values())


def table_s2(compared: Rows) -> Rows:
    """Compute speeds relative to ``static`` and to ``per-gaussian``, here and in the paper.

    The machines differ, so only the ratios are comparable.
    """
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
