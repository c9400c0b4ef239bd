"""Tables of what CUDA kernels take, from ``kernel_table.py``, and of estimated times, from ``estimate.py``."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from markdown_table import number, percent, table
from provenance import OLDER, changed_since, older_note

Report = dict[str, Any]
ASIDE = (
    *("benchmark", "fusion", "harmonics_rotation", "raycast_figure", "raycast_hits", "raycast_mesh", "sampling"),
    *("solid_textures", "surface_depth"),
)
"""Modules that neither a frame nor a training step launches; their kernels are in the JSON file alone."""
COUNTED = ("all", "FP32", "MUFU", "shared", "SHFL", "global", "atomic", "vote", "barrier", "branch", "local", "other")
CODE = ("kernels", "benchmarks/cubins.py", "benchmarks/sass.py")


def head_lines(report: Report) -> tuple[str, str]:
    """Return the command with tools and date, and the note where the counted code has changed since."""
    older = changed_since(report.get("commit"), CODE)
    tools = "".join(f", {name} {version}" for name, version in report.get("tools", {}).items())
    line = f"`{report['command']}`{f' {OLDER}' if older else ''}: Warp {report['machine']['warp']}{tools}; no GPU."
    return line, older_note([report["commit"]]) if older else ""


def three(row: Report, key: str) -> str:
    values = [entry[key] for entry in row["architectures"].values()]
    return str(values[0]) if len(set(values)) == 1 else " / ".join(map(str, values))


def kernels(report: Report) -> list[str]:
    head = ["kernel", "registers", "stack", "shared", "constant", "occupancy, %"]
    head += ["sm_90: all", "FP32", "MUFU", "shared", "global", "SHFL", "barrier", "branch", "local"]
    lines = []
    for row in report["kernels"]:
        if row["module"] not in ASIDE:
            shares = [f"{100 * entry['occupancy']:.0f}" for entry in row["architectures"].values()]
            occupancy = shares[0] if len(set(shares)) == 1 else " / ".join(shares)
            taken = [three(row, key) for key in ("registers", "stack", "shared", "constant")]
            classes = ("all", "FP32", "MUFU", "shared", "global", "SHFL", "barrier", "branch", "local")
            counts = [str(row["instructions"][name]) for name in classes]
            lines.append([f"`{row['module']}.{row['kernel']}`", *taken, occupancy, *counts])
    return [table(head, lines)]


def loops(report: Report) -> list[str]:
    head = ["instructions of a warp for a splat, sm_90", *COUNTED]
    lines = []
    for which in ("forward", "adjoint"):
        for name, kinds in report["loops"].items():
            for kind in ("hit", "miss"):
                lines.append([f"{which}, {name}, {kind}", *(str(kinds[which][kind][key]) for key in COUNTED)])
    return [table(head, lines)]


def microseconds(stage: Report | None) -> str:
    return "" if stage is None else number(stage["us"])


def whole(report: Report, name: str) -> str:
    entry = report[name]
    lines = []
    for stage, row in entry["stages"].items():
        amounts = [number(row[key] / 1e6) if row[key] else "" for key in ("bytes", "flops", "instructions")]
        lines.append([stage, *amounts, microseconds(row)])
    lines.append([f"**{name}**", "", "", "", microseconds(entry)])
    head = [f"{name}: {size_text(entry)}", "MB", "Mflop", "M warp instructions", "estimate, µs"]
    return table(head, lines)


def size_text(entry: Report) -> str:
    return f"{entry['gaussians']:,} Gaussians, {entry['width']} x {entry['height']}"


def against(entry: Report) -> str:
    """Write the stages of both renderers, and the quotient of their sums with and without the adjoint."""
    ours, theirs = entry["scgs_warp"], entry["gsplat"]
    lines = [
        [stage, microseconds(row), microseconds(theirs["stages"][stage]), ""] for stage, row in ours["stages"].items()
    ]
    for text, backward in (("**forward**", False), ("**forward and adjoint**", True)):
        sums = [
            sum(row["us"] for stage, row in side["stages"].items() if backward or "adjoint" not in stage)
            for side in (ours, theirs)
        ]
        lines.append([text, *(number(value) for value in sums), f"{number(sums[1] / sums[0])} x"])
    return table([f"{size_text(entry)}, three channels", "scgs_warp, µs", "gsplat, µs", "ratio"], lines)


def visits(report: Report) -> str:
    head = ["", "pairs", "visits forwards", "visits backwards", "hits", "hits of visits forwards"]
    lines = []
    for entry in report["rasterisation"]:
        for name, row in entry["visits"].items():
            counts = [f"{row[key]:,}" for key in ("pairs", "forward", "backward", "hits")]
            lines.append([f"{size_text(entry)}: {name}", *counts, percent(100 * row["hits"] / row["forward"], 0)])
    return table(head, lines)


def estimates(report: Report) -> list[str]:
    parts = [whole(report, name) for name in ("frame", "step")]
    return [*parts, visits(report), *(against(entry) for entry in report["rasterisation"])]


WRITERS: dict[str, tuple[str, Callable[[Report], list[str]]]] = {
    "kernels-cuda": ("kernels-cuda", kernels),
    "compositing-loops": ("kernels-cuda", loops),
    "estimates-h200": ("estimates-h200", estimates),
}
"""For each table the name of its JSON file, and its writer."""


def kernel_table(name: str, results: Path) -> str:
    """Write a table below the command that produced its result."""
    file, write = WRITERS[name]
    path = results / f"{file}.json"
    if not path.is_file():
        return "Not counted yet."
    report = json.loads(path.read_text(encoding="utf-8"))
    line, note = head_lines(report)
    return "\n\n".join(part for part in (line, *write(report), note) if part)
