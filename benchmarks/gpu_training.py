"""Parts of ``gpu_check`` that train one scene with the longest presets, each against a deadline."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from gpu_rules import TRAINING_SECONDS, at_most
from gpu_session import ROOT, Call, Report, Unfinished
from gpu_speed import met

from scgs_warp.runtime.progress import progress
from scgs_warp.storage.json_files import read_json
from scgs_warp.visualization.figures import read_log

PAPER_SECONDS = 120.0
"""Seconds of training after which ``paper`` is stopped; its total is extrapolated."""
RESERVE = 8.0
"""Seconds before the end of a call at which a run is asked to save and stop."""
LOOKS_EVERY, SAVES_EVERY = 0.5, 5.0
RECENT = 0.1
"""Share of the log from which the present rate is taken: later steps take longer."""
END_OF_OUTPUT = 3000
QUICK = "--downscale 2 --steps 60 --nodes 40 --max-gaussians 2000 --threads 1".split()
SMALL = "--size 96 --train 8 --test 2".split()
INTERRUPTED = 130
"""Status of a run that has saved and stopped."""


def paper(call: Call) -> Report:
    """Train with the paper's schedule for a while, and extrapolate."""
    return train("paper", call, PAPER_SECONDS)


def best(call: Call) -> Report:
    """Train with the preset of most steps, until the goal is missed."""
    return train("best", call, TRAINING_SECONDS)


def train(preset: str, call: Call, deadline: float) -> Report:
    """Train until the end, or until ``deadline`` seconds of training are over.

    Raises:
        Unfinished: the call ends; the run is saved and continues in the next call.
        RuntimeError: the run has failed.
    """
    folder, log = call.work / preset, call.work / f"{preset}-run.log"
    if not call.earlier.get("steps"):
        shutil.rmtree(folder, ignore_errors=True)  # of another commit, perhaps
    command = command_of(preset, call, folder)
    with open(log, "wb") as output:
        process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=output, stderr=output)
        try:
            stopped = _until(process, folder, call, deadline)
        finally:
            process.kill()
            process.wait()
    report = figures(folder, call)
    call.save(report)
    if not stopped and process.returncode != 0:
        end = log.read_text(encoding="utf-8", errors="replace")[-END_OF_OUTPUT:]
        raise RuntimeError(f"training ended with status {process.returncode}: {end}")
    if not report["finished"] and (report["trained"] or report["seconds_of_training"] < deadline):
        raise Unfinished(f"{report['steps']:,} of {report['of']:,} steps after {report['seconds_of_training']:.0f} s")
    total = report["seconds_in_all"]
    goals = {"seconds of training": at_most(total, TRAINING_SECONDS)} if total is not None else {}
    report = {**report, "goals": goals}
    return {**report, "passed": total is not None and met(report, call.setting)}


def command_of(preset: str, call: Call, folder: Path) -> list[str]:
    data = call.data
    if data is None:
        data = call.work / "scene"
        if not (data / "transforms_test.json").is_file():
            small = SMALL if call.setting.quick else []
            shutil.rmtree(data, ignore_errors=True)
            command = [sys.executable, "apps/synthesize.py", "--output", str(data), *small]
            try:
                subprocess.run(command, cwd=ROOT, check=True, timeout=max(call.left(), 1.0), stdout=subprocess.DEVNULL)
            except subprocess.TimeoutExpired:
                raise Unfinished("the time did not suffice to make the built-in scene") from None
    command = [sys.executable, "apps/train.py", "--data", str(data), "--preset", preset, "--output", str(folder)]
    command += ["--device", call.setting.device, *(QUICK if call.setting.quick else [])]
    return [*command, "--resume"] if (folder / "config.json").is_file() else command


def _until(process: subprocess.Popen[bytes], folder: Path, call: Call, deadline: float) -> bool:
    """Wait for the run; ask it to save and stop if either time is over. Return whether it was asked."""
    asked, saved_at = False, time.monotonic()
    with progress(0, str(folder.name), start=call.earlier.get("steps", 0)) as bar:
        while process.poll() is None:
            time.sleep(LOOKS_EVERY)
            report = figures(folder, call)
            bar.total = report["of"]
            bar.advance(report["steps"] - bar.done)
            if time.monotonic() - saved_at > SAVES_EVERY:
                saved_at = time.monotonic()
                call.save(report)
            late = not report["trained"] and report["seconds_of_training"] >= deadline
            if not asked and (late or call.left() < RESERVE):
                process.send_signal(signal.SIGINT)
                asked = True
            if call.left() < -RESERVE:
                return True  # what it has not saved by now is repeated by the next call
    return asked


def figures(folder: Path, call: Call) -> Report:
    """Read from the run folder how far the run is."""
    of = read_json(folder / "config.json")["steps"] if (folder / "config.json").is_file() else 0
    log = read_log(folder / "log.jsonl") if (folder / "log.jsonl").is_file() else []
    steps, seconds = (log[-1]["step"], log[-1]["seconds"]) if log else (0, 0.0)
    metrics: dict[str, Any] = {}
    if (folder / "metrics.json").is_file():
        metrics = read_json(folder / "metrics.json")
    left = None
    if log:
        first = log[min(int((1.0 - RECENT) * len(log)), len(log) - 2)] if len(log) > 1 else {"step": 0, "seconds": 0.0}
        rate = (seconds - first["seconds"]) / max(steps - first["step"], 1)
        left = rate * (of - steps)
    finished = bool(metrics)
    return {
        "data": call.data.name if call.data else "built-in",
        "steps": steps,
        "of": of,
        "seconds_of_training": metrics["seconds"] if finished else seconds,
        "seconds_left": 0.0 if finished else left,
        "seconds_in_all": metrics["seconds"] if finished else None if left is None else seconds + left,
        "trained": bool(of) and steps >= of,
        "finished": finished,
        **{name: metrics.get(name) for name in ("psnr", "ssim", "gaussians") if finished},
    }
