"""The table of the mutation run, from results/mutation.json, which tests/mutation/run.py writes."""

from __future__ import annotations

import json
from pathlib import Path

NAME = "mutation"
AREAS = {
    "kernels/": "kernels",
    "scgs_warp/training/": "training",
    "scgs_warp/optim": "training",
    "scgs_warp/motion/": "motion models",
    "scgs_warp/config/": "settings",
    "scgs_warp/data/": "data sets",
    "scgs_warp/geometry/": "data sets",
    "scgs_warp/evaluation/": "evaluation",
    "scgs_warp/edit/": "editing",
    "scgs_warp/export/": "export and formats",
    "scgs_warp/formats/": "export and formats",
    "scgs_warp/gaussians": "export and formats",
    "": "files, requests, memory",
}
"""Areas by the beginning of the file's path; the first that fits counts."""


def area_of(mutant: str) -> str:
    return next(area for start, area in AREAS.items() if mutant.startswith(start))


def mutation_table(results: Path) -> str:
    """Write the table: mutants by area, and how many the tests noticed."""
    path = results / f"{NAME}.json"
    if not path.is_file():
        return "Not measured yet."
    report = json.loads(path.read_text(encoding="utf-8"))
    counts: dict[str, list[int]] = {area: [0, 0, 0, 0] for area in AREAS.values()}
    for row in report["results"]:
        told = "equivalent" in row and row["verdict"] != "killed"
        column = 2 if told else 1 if row["verdict"] == "killed" else 3
        for index in (0, column):
            counts[area_of(row["mutant"])][index] += 1
    lines = ["| mutants in | run | killed | equivalent | survived |", "| --- | ---: | ---: | ---: | ---: |"]
    lines += [f"| {area} | {' | '.join(map(str, row))} |" for area, row in counts.items() if row[0]]
    total = [sum(row[column] for row in counts.values()) for column in range(4)]
    lines.append(f"| all | {' | '.join(map(str, total))} |")
    left = report["mutants"] - report["run"]
    commits = ", ".join(sorted({row["commit"] for row in report["results"]}))
    rest = f" {left} of {report['mutants']} mutants have not been run yet." if left else ""
    return "\n".join([*lines, "", f"Run at commit {commits}.{rest}"])
