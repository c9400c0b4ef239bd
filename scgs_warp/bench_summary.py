"""What rows say together: the price of motion, and the paper's Table S2."""

from __future__ import annotations

from typing import Any

PAPER_FPS = {"control-points": 295.4, "static": 298.5, "hexplane": 145.8, "per-gaussian": 113.3}
"""Frames a second in the seed's Table S2: 800 x 800, 48,980 Gaussians on average, RTX 3090 (SC-GS, 3D-GS, 4D-GS, and
the baseline that asks the network for every Gaussian)."""

Rows = list[dict[str, Any]]


def wholes(rows: Rows, name: str = "frame") -> Rows:
    """The rows of that name, in their order; stages have other names."""
    return [row for row in rows if row["name"] == name]


def _fps(frames: Rows, motion: str) -> float | None:
    return next((row["fps"] for row in frames if row["motion"] == motion), None)


def motion_costs(rows: Rows) -> Rows:
    """For every moving model and number of threads: ``ms_median`` and ``ms_min`` of network and skinning together,
    and ``ratio_to_static``, its frames a second divided by those of Gaussians at rest (None unless measured)."""
    found = []
    for whole in wholes(rows):
        same = [row for row in rows if all(row[key] == whole[key] for key in ("motion", "threads"))]
        parts = [row for row in same if row["name"] in ("frame/network", "frame/skin")]
        if not parts:
            continue
        rest = _fps([row for row in wholes(rows) if row["threads"] == whole["threads"]], "static")
        figures = {key: sum(row[key] for row in parts) for key in ("ms_median", "ms_min")}
        ratio = None if rest is None else whole["fps"] / rest
        found.append({"motion": whole["motion"], "threads": whole["threads"], **figures, "ratio_to_static": ratio})
    return found


def table_s2(rows: Rows) -> Rows:
    """Speeds relative to Gaussians at rest and to the model that asks the network for every Gaussian, here and in the
    paper: the machines differ, the ratios compare."""
    found = []
    for threads in sorted({row["threads"] for row in rows}):
        frames = [row for row in wholes(rows) if row["threads"] == threads]
        here = {row["motion"]: row["fps"] for row in frames}
        for name, fps in here.items():
            found.append(
                {
                    "motion": name,
                    "threads": threads,
                    "fps": fps,
                    "ratio_to_static": fps / here["static"],
                    "ratio_to_per_gaussian": fps / here["per-gaussian"],
                    "paper_fps": PAPER_FPS[name],
                    "paper_ratio_to_static": PAPER_FPS[name] / PAPER_FPS["static"],
                    "paper_ratio_to_per_gaussian": PAPER_FPS[name] / PAPER_FPS["per-gaussian"],
                }
            )
    return found
