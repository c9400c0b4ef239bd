"""Watch for leaks in the editor under random input and in training in a loop, from within the process.

    python benchmarks/soak.py --minutes 60                        # half an hour of each
    python benchmarks/soak.py --minutes 10 --part editor
    python benchmarks/soak.py --minutes 60 --run runs/figure-quick # the editor on a trained scene
    python benchmarks/soak.py --minutes 60 --json soak.json

Memory, open handles and threads are sampled all the time. The first quarter of a part is warm-up. After the warm-up,
allocated memory may grow by ``STEEPEST`` and resident memory by ``HIGHEST`` (the process keeps freed memory, so
resident memory follows the largest film so far); the numbers of handles and threads may not grow. Otherwise the exit
status is 1.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import scgs_warp  # noqa: F401  (sets the environment before torch is imported)

import numpy as np  # isort: skip
from scipy.stats import theilslopes
from soak_editor import RandomUser

from scgs_warp.config.presets import MOTIONS, TrainConfig, from_dict, preset, with_steps
from scgs_warp.data.synthetic.builtin import make_synthetic
from scgs_warp.edit import EditSession
from scgs_warp.runtime import environment
from scgs_warp.runtime.provenance import command_line, provenance
from scgs_warp.scene.scene import Scene
from scgs_warp.training.run import train_and_evaluate

STEEPEST = 30.0
"""Allowed growth of allocated memory, MiB per hour: a quarter of a GiB in a working day."""
HIGHEST = 128.0
"""Allowed growth of resident memory from a part's second quarter to its last, MiB."""
WARM_UP = 0.25
SAMPLES = 40
"""Approximate number of samples in a part."""
PAGE = os.sysconf("SC_PAGE_SIZE") / 2**20


class _Allocated(ctypes.Structure):
    """glibc's ``struct mallinfo2``."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()
    ]


def allocated() -> float | None:
    """Return allocated memory in MiB; None if the C library does not say."""
    try:
        ask = ctypes.CDLL(None).mallinfo2
    except (OSError, AttributeError):
        return None
    ask.restype = _Allocated
    counts = ask()
    return (counts.uordblks + counts.hblkhd) / 2**20


class Watch:
    """Samples of the process' memory, handles and threads."""

    def __init__(self, seconds: float) -> None:
        self.seconds, self.began = seconds, time.monotonic()
        self._every, self._due = max(0.2, seconds / SAMPLES), 0.0
        self.rows: list[tuple[float, float, float, int, int]] = []

    @property
    def elapsed(self) -> float:
        return time.monotonic() - self.began

    def sample(self, rest: Callable[[], object] = lambda: None) -> bool:
        """Take a sample if one is due, after calling ``rest`` to finish running work; return whether the part is
        over."""
        if self.elapsed >= self._due:
            rest()
            self._due = self.elapsed + self._every
            gc.collect()  # Cycles that wait for the collector are not leaks.
            resident = int(Path("/proc/self/statm").read_text().split()[1]) * PAGE
            threads = len(os.listdir("/proc/self/task"))
            asked = allocated()
            handles = len(os.listdir("/proc/self/fd"))
            self.rows.append((self.elapsed, resident, resident if asked is None else asked, handles, threads))
        return self.elapsed >= self.seconds

    def verdict(self) -> dict[str, Any]:
        """Summarise the samples; ``wrong`` lists what grew."""
        table = np.array(self.rows)
        warm = table[table[:, 0] >= WARM_UP * self.seconds]
        slope, _, low, high = (3600.0 * np.array(theilslopes(warm[:, 2], warm[:, 0]), np.float64)).tolist()
        quarter = max(1, len(warm) // 3)
        early, late = warm[:quarter], warm[-quarter:]
        figures: dict[str, Any] = {
            "seconds": round(self.elapsed, 1),
            "samples": len(table),
            "allocated_mib": [round(float(np.median(part[:, 2])), 1) for part in (early, late)],
            "allocated_mib_per_hour": round(slope, 1),
            "allocated_mib_per_hour_95": [round(low, 1), round(high, 1)],
            "resident_mib": [round(float(part[:, 1].max()), 1) for part in (early, late)],
        }
        wrong = [f"memory grows by {slope:.0f} MiB an hour"] if low > STEEPEST else []
        if late[:, 1].max() > early[:, 1].max() + HIGHEST:
            wrong.append(f"resident memory: {early[:, 1].max():.0f} MiB became {late[:, 1].max():.0f}")
        for column, name in ((3, "handles"), (4, "threads")):
            figures[name] = [int(part[:, column].max()) for part in (early, late)]
            if np.median(late[:, column]) > early[:, column].max():
                wrong.append(f"{name}: {figures[name][0]} became {figures[name][1]}")
        return {**figures, "wrong": wrong, "rows": np.round(table, 1).tolist()}


def small(motion: str) -> TrainConfig:
    """Configure a run of a second or two."""
    fields = {
        "init_points": 300,
        "checkpoint_seconds": 0.2,
        "evaluate_every": 20,
        "motion": {"model": motion, "nodes": 24, "layers": 3, "width": 32, "skip": 2},
        "data": {"cache_mib": 1},
    }
    return from_dict(fields, "soak", with_steps(preset("cpu"), 60))


def train_once(folder: Path, motion: str, resume: bool = False) -> Path:
    data = make_synthetic(folder / "data", size=96, train=16, test=2)
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        train_and_evaluate(small(motion), data, folder / "run", frames=4, resume=resume)
    return folder / "run"


def soak_training(seconds: float, work: Path) -> dict[str, Any]:
    """Train from images to film with each motion model in turn, and resume each run once when it is complete."""
    watch, runs = Watch(seconds), 0
    while not watch.sample():
        with tempfile.TemporaryDirectory(dir=work) as folder:
            inner = Path(folder)
            (inner / "data").symlink_to(work / "data")
            for resume in (False, True):
                train_once(inner, MOTIONS[runs % len(MOTIONS)], resume)
                watch.sample()
        runs += 1
    return {"runs": runs, **watch.verdict()}


def soak_editor(seconds: float, work: Path, run: Path, seed: int) -> dict[str, Any]:
    """Send random input of every kind to the editor as fast as it draws."""
    user = RandomUser(EditSession(Scene.load(run)), work / "edits", seed)
    watch = Watch(seconds)
    try:
        while not watch.sample(user.rest):
            user.act()
    finally:
        user.stop()
    return {"actions": dict(sorted(user.done.items())), "refused": user.refused, **watch.verdict()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0, help="for all parts together")
    parser.add_argument("--part", choices=("editor", "training", "both"), default="both")
    parser.add_argument("--run", type=Path, help="run folder of the scene to edit; a small one is trained by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if not Path("/proc/self/statm").exists():
        print("error: memory and handles are read from /proc, which is not here", file=sys.stderr)
        return 2
    environment.configure(options.threads)
    parts = ("editor", "training") if options.part == "both" else (options.part,)
    seconds = 60.0 * options.minutes / len(parts)
    report: dict[str, Any] = {"command": command_line("benchmarks/soak.py", sys.argv[1:]), **provenance("cpu")}
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        run = train_once(work, "control-points")
        for part in parts:
            if part == "editor":
                report[part] = soak_editor(seconds, work, options.run or run, options.seed)
            else:
                report[part] = soak_training(seconds, work)
            shown = {name: value for name, value in report[part].items() if name != "rows"}
            print(json.dumps({part: shown}, indent=1), flush=True)
            if options.json is not None:
                options.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    wrong = [f"{part}: {line}" for part in parts for line in report[part]["wrong"]]
    print("\n".join(wrong) or "nothing grows")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
