"""The part of ``gpu_check`` that looks for races and bad memory accesses, with NVIDIA's ``compute-sanitizer``."""

from __future__ import annotations

import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from gpu_session import Call, NotRun, Report, Unfinished

SMALL = Path(__file__).with_name("gpu_small.py")
DONE = "gpu_small: done"
"""Last line of the program under test."""
SUMMARY = re.compile(r"^=+ (?:ERROR SUMMARY: (\d+) errors?|RACECHECK SUMMARY: (\d+) hazards? displayed)", re.MULTILINE)
UNABLE = re.compile(r"^=+ .*(?:not supported|Unable to|not found).*$", re.MULTILINE | re.IGNORECASE)
KEPT = 40
"""Number of lines of a report that are kept."""
LEAST = 5.0
NO_GRAPHS = ("--no-graphs",)
"""Recording needs torch's own allocator, and racecheck ends it: "operation failed due to a previous error"."""


class Check(NamedTuple):
    tool: str | None
    """None: without the sanitizer, to compile the kernels and to see that the program works."""
    words: tuple[str, ...] = ()
    variables: tuple[str, ...] = ()


CHECKS = {
    "plain": Check(None),
    # Each tensor in memory of its own, so that memcheck sees its end.
    "memcheck": Check("memcheck", NO_GRAPHS, ("PYTORCH_NO_CUDA_MEMORY_CACHING",)),
    "racecheck": Check("racecheck", NO_GRAPHS),
}


def find() -> str | None:
    """Return the path of compute-sanitizer, on PATH or in CUDA_HOME."""
    home = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH") or "/usr/local/cuda"
    return shutil.which("compute-sanitizer") or shutil.which("compute-sanitizer", path=str(Path(home) / "bin"))


def sanitizer(call: Call) -> Report:
    """Draw a frame and take a training step of a small scene under memcheck and racecheck.

    Raises:
        NotRun: there is no compute-sanitizer, or it cannot examine this device.
        Unfinished: the time did not suffice; checks that have ended are not repeated.
    """
    program = find()
    if call.setting.device != "cuda":
        raise NotRun("compute-sanitizer examines GPUs only")
    if program is None:
        raise NotRun("there is no compute-sanitizer on PATH or in CUDA_HOME/bin")
    rows = dict(call.earlier.get("checks", {}))
    for name, check in CHECKS.items():
        if name in rows:
            continue
        if (left := call.left()) < LEAST:
            raise Unfinished(f"no time left for {name}")
        rows[name] = examined(program, check, left)
        call.save({"program": Path(program).name, "checks": rows})
        if name == "plain" and not rows[name]["passed"]:
            break
    return {
        **call.earlier,
        "checks": rows,
        "passed": len(rows) == len(CHECKS) and all(r["passed"] for r in rows.values()),
    }


def examined(program: str, check: Check, seconds: float) -> Report:
    """Run the small program under a tool and read its report.

    Raises:
        NotRun: the tool cannot examine this device.
        Unfinished: the time did not suffice.
    """
    command = [sys.executable, str(SMALL), *check.words]
    if check.tool is not None:
        command = [program, "--tool", check.tool, "--error-exitcode", "86", *command]
    variables = {**os.environ, **dict.fromkeys(check.variables, "1")}
    try:
        done = subprocess.run(
            command,
            env=variables,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            check=False,
            timeout=seconds if math.isfinite(seconds) else None,
        )
    except subprocess.TimeoutExpired:
        raise Unfinished(f"{check.tool or 'the program alone'} took more than the {seconds:.0f} s left") from None
    output, summary = done.stdout, SUMMARY.search(done.stdout)
    if check.tool is not None and summary is None and (unable := UNABLE.search(output)):
        raise NotRun(f"compute-sanitizer cannot examine this device: {unable[0].strip('= ')}")
    reports = int(summary[1] or summary[2]) if summary else None
    finished = done.returncode == 0 and DONE in output
    row: Report = {"status": done.returncode, "reports": reports}
    if finished and (check.tool is None or reports == 0):
        return {**row, "passed": True}
    marked = [line for line in output.splitlines() if line.startswith("=====")]
    return {**row, "passed": False, "report": (marked or output.splitlines())[:KEPT], "end": output[-800:]}
