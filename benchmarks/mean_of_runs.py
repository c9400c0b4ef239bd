"""Measure how much less the mean of several runs errs than each (``scgs_warp.scene.mean``).

    python benchmarks/mean_of_runs.py --scene "built-in scene" figure long-0 long-1 long-2 \\
        --json benchmarks/results/mean-of-runs.json

Each ``--scene`` takes a title, the folder of the data set, and runs that differ in their seeds alone. Rows hold
`scene`, `runs`, `psnr`, `worst` (the lowest PSNR of an image) and `ssim`, on the test images; those of one run are the
means over all of them, those of several are of the first ones.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from scgs_warp.config.fields import IMAGE_SETTINGS
from scgs_warp.data import load
from scgs_warp.evaluation.evaluate import evaluate
from scgs_warp.runtime.environment import configure
from scgs_warp.runtime.provenance import command_line, provenance
from scgs_warp.scene.mean import load_mean

SCORES = ("psnr", "psnr_worst", "ssim")


def rows_of(title: str, data: Path, runs: list[Path]) -> list[dict[str, Any]]:
    """Score each run, then the means of two, three and so on."""
    settings = load_mean(runs[:1]).settings["data"]
    truth = load(data, "test", **{key: settings[key] for key in IMAGE_SETTINGS if key in settings})
    alone = [evaluate(load_mean([run]), truth) for run in runs]
    rows = [row(title, 1, {name: sum(one[name] for one in alone) / len(alone) for name in SCORES})]
    return rows + [row(title, count, evaluate(load_mean(runs[:count]), truth)) for count in range(2, len(runs) + 1)]


def row(title: str, runs: int, scores: dict[str, Any]) -> dict[str, Any]:
    return {
        "scene": title, "runs": runs, "psnr": scores["psnr"], "worst": scores["psnr_worst"], "ssim": scores["ssim"]
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", nargs="+", action="append", required=True, metavar="TITLE DATA RUN")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if any(len(words) < 3 for words in options.scene):
        parser.error("--scene takes a title, a data folder, and runs")
    configure(1)
    rows = []
    for title, data, *runs in options.scene:
        rows += rows_of(title, Path(data), [Path(run) for run in runs])
    for one in rows:
        print(f"{one['scene']:30} {one['runs']} {one['psnr']:.2f} {one['worst']:.2f} {one['ssim']:.4f}")
    if options.json:
        origin = {"provenance": "measured", "command": command_line("benchmarks/mean_of_runs.py", sys.argv[1:])}
        options.json.write_text(json.dumps({**origin, **provenance("cpu"), "rows": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
