"""Tables of what file formats take and lose, from ``still_formats.py`` and ``moving_formats.py``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from markdown_table import number, percent, table
from provenance import OLDER, changed_since, older_note

CODE = {
    "still-formats": ("scgs_warp/formats", "scgs_warp/export/glb.py", "benchmarks/still_formats.py"),
    "moving-formats": ("scgs_warp/formats", "scgs_warp/export", "benchmarks/moving_formats.py"),
}
NAMES = tuple(CODE)
EXACT = 1e-7
"""Largest loss of position, colour and opacity that counts as none."""


def cells(row: dict[str, Any]) -> list[str]:
    harmonics = "none" if row["harmonics"] is None else number(row["harmonics"], 3)
    losses = [f"{1e6 * row['position']:,.0f}", percent(100 * row["scale"], 1), number(row["color"], 4)]
    losses += [number(row["opacity"], 4), number(row["rotation"], 2), harmonics]
    if max(row["position"], row["color"], row["opacity"]) < EXACT:
        losses = ["0"] * len(losses)
    shown = "> 90" if row["psnr"] > 90 else number(row["psnr"])
    return [
        f"`{row['format']}`",
        number(row["bytes"] / 2**20, 2),
        number(row["bytes"] / row["gaussians"]),
        *losses,
        shown,
    ]


def moving_cells(row: dict[str, Any]) -> list[str]:
    losses = ["" if row.get(key) is None else percent(100 * row[key], 3) for key in MOVING]
    return [f"`{row['format']}`", number(row["bytes"] / 2**20, 1), *losses, number(row.get("psnr"))]


MOVING = {
    "position": "position, mean",
    "position_95": "95 % within",
    "between": "between instants, mean",
    "between_95": "95 % within",
}


def format_table(name: str, results: Path) -> str:
    """Write a table for each scene below the command that produced its result."""
    path = results / f"{name}.json"
    if not path.is_file():
        return "Not measured yet."
    report = json.loads(path.read_text(encoding="utf-8"))
    older = changed_since(report.get("commit"), CODE[name])
    parts = [f"`{report['command']}`{f' {OLDER}' if older else ''}"]
    for scene in dict.fromkeys(row["scene"] for row in report["rows"]):
        rows = [row for row in report["rows"] if row["scene"] == scene]
        first = f"{scene}: {rows[0]['gaussians']:,} Gaussians of degree {rows[0]['degree']}"
        if name == "moving-formats":
            parts.append(table([first, "MiB", *MOVING.values(), "PSNR, dB"], [moving_cells(row) for row in rows]))
            continue
        head = [
            first,
            "MiB",
            "bytes per Gaussian",
            "position, 10^-6",
            "scale",
            "colour",
            "opacity",
            "rotation, degrees",
        ]
        parts.append(table([*head, "harmonics", "PSNR, dB"], [cells(row) for row in rows]))
    return "\n\n".join([*parts, older_note([report["commit"]])] if older else parts)
