"""The tables of a check on a GPU, from results/gpu_check_cuda.json, which gpu_check.py writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from gpu_session import FAILED, NOT_RUN, PASSED
from markdown_table import duration, number, table
from provenance import OLDER, RENDERING, changed_since, older_note

NAME = "gpu-check"
FILE = "gpu_check_cuda.json"
EARLIER = "gpu_check_cuda-*.json"
SUBJECTS = {
    "agreement": "images and gradients against the CPU's, all motion models",
    "bits": "two runs, recorded against plain frames and steps: the same bits",
    "sanitizer": "compute-sanitizer, memcheck and racecheck: a frame and a step, operation by operation",
    "tests": "all tests that need a GPU",
    "fuzz": "poisoned inputs of every operation",
    "crowded": "a million Gaussians that all fill a screen of 1920 x 1080, within 4 GiB",
    "share": "a process group of one (NCCL) against a plain run: the same bits",
}
"""What the parts check that yield no time."""


def gpu_table(results: Path) -> str:
    """Write the tables of the parts: checks, then times."""
    path = results / FILE
    if not path.is_file():
        return "Not measured yet."
    report = json.loads(path.read_text(encoding="utf-8"))
    parts, machine = with_earlier(report, results), report["machine"]
    older = changed_since(report["commit"], RENDERING)
    mark = f" {OLDER}" if older else ""
    head = (
        f"`python benchmarks/gpu_check.py` at commit {report['commit'][:7]}{mark}: {report['gpu']}, "
        f"torch {machine['torch']}, Warp {machine['warp']}."
    )
    checks = [
        [subject, outcome(parts[name]), lasted(parts[name].get("seconds"))]
        for name, subject in SUBJECTS.items()
        if name in parts
    ]
    blocks = [head, table(["check", "outcome", "time"], checks, numbers=False)]
    if rows := times(parts):
        blocks.append(table(["what", "milliseconds", "note"], rows, numbers=False))
    return "\n\n".join([*blocks, older_note([report["commit"]])] if older else blocks)


def with_earlier(report: dict[str, Any], results: Path) -> dict[str, dict[str, Any]]:
    """Return the parts of a report, and for those that it has not run the newest earlier ones, with their ``commit``.

    Earlier reports are those that gpu_check.py moved aside when it met another commit.
    """
    parts = {name: part for name, part in report["parts"].items() if part.get("state") != NOT_RUN}
    earlier = [json.loads(path.read_text(encoding="utf-8")) for path in results.glob(EARLIER)]
    for old in sorted(earlier, key=lambda one: one["date"], reverse=True):
        for name, part in old["parts"].items():
            if part["state"] in (PASSED, FAILED):
                parts.setdefault(name, {**part, "commit": old["commit"]})
    return parts


def at_commit(part: dict[str, Any]) -> str:
    """Name the commit of a part from an earlier report."""
    if "commit" not in part:
        return ""
    return f", at {part['commit'][:7]}" + (f" {OLDER}" if changed_since(part["commit"], RENDERING) else "")


def lasted(seconds: float | None) -> str:
    """Write a duration; below a minute in seconds alone."""
    return f"{seconds:.0f} s" if seconds is not None and seconds < 59.5 else duration(seconds)


def outcome(part: dict[str, Any]) -> str:
    """Return the state of a part, with the numbers that it counted."""
    counts = []
    if "total" in part:
        skipped = part.get("skipped", 0)
        counts = [f"{part['total'] - skipped - len(part['failures']):,} passed, {skipped} skipped"]
        counts += [f"{len(part['failures'])} failed"] if part["failures"] else []
    elif "cases" in part:
        counts = [f"{part['cases']:,} cases"]
    return f"{part['state']}{': ' if counts else ''}{', '.join(counts)}{at_commit(part)}"


def times(parts: dict[str, Any]) -> list[list[str]]:
    """Return rows of what was timed: subject, milliseconds, note."""
    rows = []
    for row in parts.get("frame", {}).get("rows", []):
        note = f"{row['fps']:,.0f} frames a second with two under way; motion {number(row['motion_ms'], 2)} ms"
        rows.append([f"frame, 49,000 Gaussians, 800 x 800, {row['motion']}", number(row["ms_median"], 2), note])
    for name, row in parts.get("step", {}).get("in_turns", {}).items():
        with_arap = ", with ARAP" if name.endswith("arap") else ""
        plain = number(row["plain"]["ms_median"], 1)
        subject = f"training step, 40,000 Gaussians, 400 x 400{with_arap}"
        rows.append([subject, number(row["recorded"]["ms_median"], 2), f"recorded; {plain} operation by operation"])
    for version, own in parts.get("gsplat", {}).get("versions", {}).items():
        for scene, row in own["rows"].items():
            for kind, label in (("forward", "image"), ("both", "image and gradients")):
                ours, theirs = (row[kind][name]["ms_median"] for name in ("ours", "theirs"))
                note = f"gsplat {version} takes {number(theirs, 2)}, {number(row['ratio'][kind], 2)} of our time"
                note += missed(parts["gsplat"], f"{kind} at {scene}, gsplat's time / ours") + at_commit(parts["gsplat"])
                rows.append([f"`rasterization`, {scene} Gaussians, {label}", number(ours, 2), note])
    for name in ("paper", "best"):
        if name in parts and parts[name].get("of"):
            rows.append(training_row(name, parts[name]))
    return rows


def missed(part: dict[str, Any], goal: str) -> str:
    """Say that a goal of a part was missed, if so."""
    own = part.get("goals", {}).get(goal)
    return "" if own is None or own["met"] else f" (goal: {own.get('least', own.get('most'))}, missed)"


def training_row(preset: str, part: dict[str, Any]) -> list[str]:
    steps = f"{part['steps']:,} of {part['of']:,} steps in {lasted(part['seconds_of_training'])}"
    per_step = number(1e3 * part["seconds_of_training"] / max(part["steps"], 1), 2)
    ended = f"; {number(part['psnr'], 2)} dB, {part['gaussians']:,} Gaussians" if part.get("finished") else ""
    return [f"training `{part['data']}` with `{preset}`, a step in the mean", per_step, steps + ended]
