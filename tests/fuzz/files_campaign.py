"""Fuzz the readers with damaged files: ``python tests/fuzz/files_campaign.py --cases 5000``.

Every case is (format, seed): ``--format NAME --seed N --cases 1`` repeats one. A case fails unless the file
is loaded into valid data or refused in one line, within the limits of time and memory. Exit status 1 if there was any.
"""

from __future__ import annotations

import argparse
import collections
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

TESTS = Path(__file__).resolve().parent.parent
GOOD = ("loaded", "refused")
PATIENCE = 60.0
"""Time limit of a case in seconds, preparation apart."""
START = 300.0
"""Time limit of a worker for making the formats' folders, in seconds."""


class WorkerProcess:
    """A worker process that runs cases and is replaced when it dies or hangs."""

    def __init__(self, formats: Sequence[str], modules: Sequence[str] = ()) -> None:
        self.formats, self.modules = list(formats), list(modules)
        self._process: subprocess.Popen[bytes] | None = None
        self._heard = b""

    def run(self, name: str, seed: int) -> dict[str, Any]:
        """Run one case; hangs and crashes are outcomes, too."""
        if self._process is None:
            self._start()
        found = self._ask({"format": name, "seed": seed}, PATIENCE)
        if isinstance(found, dict):
            return found
        status = self.stop()
        return {"outcome": found, "detail": f"exit status {status}" if found == "crash" else f"{PATIENCE:g} seconds"}

    def stop(self) -> int | None:
        if self._process is None:
            return None
        process, self._process, self._heard = self._process, None, b""
        assert process.stdin is not None
        process.stdin.close()
        try:
            return process.wait(5)
        except subprocess.TimeoutExpired:
            process.kill()
            return process.wait()

    def _start(self) -> None:
        paths = os.pathsep.join([str(TESTS), str(TESTS.parent), os.environ.get("PYTHONPATH", "")])
        environment = {**os.environ, "PYTHONPATH": paths, "OPENCV_LOG_LEVEL": "SILENT", "MPLBACKEND": "agg"}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "fuzz.files_worker", *self.modules],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL if not os.environ.get("FUZZ_LOUD") else None,
            env=environment,
            cwd=TESTS,
        )
        ready = self._ask({"prepare": self.formats}, START)
        if not isinstance(ready, dict):
            raise RuntimeError(f"the worker does not start ({ready}); set FUZZ_LOUD=1 to see why")

    def _ask(self, request: dict[str, Any], patience: float) -> dict[str, Any] | str:
        process = self._process
        assert process is not None and process.stdin is not None and process.stdout is not None
        try:
            process.stdin.write(json.dumps(request).encode() + b"\n")
            process.stdin.flush()
        except BrokenPipeError:
            return "crash"
        until = time.monotonic() + patience
        while b"\n" not in self._heard:
            ready, _, _ = select.select([process.stdout], [], [], max(until - time.monotonic(), 0.0))
            if not ready:
                return "hang"
            chunk = os.read(process.stdout.fileno(), 1 << 16)
            if not chunk:
                return "crash"
            self._heard += chunk
        line, _, self._heard = self._heard.partition(b"\n")
        return json.loads(line)


def shares(formats: dict[str, float], cases: int) -> dict[str, int]:
    """Return the number of cases of each format, at least one."""
    total = sum(formats.values())
    return {name: max(1, round(cases * share / total)) for name, share in formats.items()}


def campaign(counts: dict[str, int], first: int = 0, worker: WorkerProcess | None = None) -> Iterator[dict[str, Any]]:
    """Yield the outcome of every case, format by format, with seeds from ``first`` on."""
    worker = worker or WorkerProcess(list(counts))
    try:
        for name, count in counts.items():
            for seed in range(first, first + count):
                yield {"format": name, "seed": seed, **worker.run(name, seed)}
    finally:
        worker.stop()


def formats() -> dict[str, float]:
    """Collect names and shares of formats from the modules that define them."""
    sys.path[:0] = [str(TESTS), str(TESTS.parent)]
    from fuzz.files_worker import load_formats

    return {name: item.share for name, item in load_formats().items()}


def summary(rows: list[dict[str, Any]], seconds: float) -> dict[str, Any]:
    """Summarise counts by outcome and format, the slowest and the largest case, and every failure."""
    table: dict[str, dict[str, int]] = {}
    for row in rows:
        found = table.setdefault(row["format"], collections.Counter())
        found[row["outcome"]] += 1
    return {
        "cases": len(rows),
        "seconds": round(seconds, 1),
        "outcomes": dict(collections.Counter(row["outcome"] for row in rows)),
        "formats": {name: dict(found) for name, found in table.items()},
        "slowest_seconds": max((row.get("seconds", 0.0) for row in rows), default=0.0),
        "largest_mib": max((row.get("mib", 0) for row in rows), default=0),
        "failures": [row for row in rows if row["outcome"] not in GOOD],
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=5000, help="in all, shared among the formats")
    parser.add_argument("--seed", type=int, default=0, help="of the first case of every format")
    parser.add_argument("--format", nargs="*", help="only these")
    parser.add_argument("--json", type=Path, help="where the summary goes")
    options = parser.parse_args()
    known = formats()
    unknown = set(options.format or ()) - set(known)
    if unknown:
        parser.error(f"--format {sorted(unknown)[0]}: there are {', '.join(known)}")
    from scgs_warp.runtime.progress import progress

    counts = shares({name: known[name] for name in options.format or known}, options.cases)
    rows: list[dict[str, Any]] = []
    began = time.monotonic()
    with progress(sum(counts.values()), "damaged files") as bar:
        for row in campaign(counts, options.seed):
            rows.append(row)
            bar.advance(1, format=row["format"])
            if row["outcome"] not in GOOD:
                print(f"{row['format']} --seed {row['seed']}: {row['outcome']}: {row['detail']}", flush=True)
    found = summary(rows, time.monotonic() - began)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    print({key: value for key, value in found.items() if key not in ("formats", "failures")})
    return 1 if found["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
