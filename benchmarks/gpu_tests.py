"""The part of ``gpu_check`` that runs the tests which need the GPU, in several processes, continued by later calls.

A test that has passed or was skipped is not repeated. If a process dies, the test that it was running has failed, and
the others go on in a new process.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import IO

from gpu_outcomes import BEGAN, COUNTED, ENDED, VARIABLE
from gpu_session import ROOT, Call, NotRun, Report, Unfinished

from scgs_warp.runtime import environment
from scgs_warp.runtime.progress import Progress, progress

MOST_PROCESSES, CORES_OF_ONE = 8, 2
HANGS_AFTER = 200
"""Seconds after which a single test has failed."""
RESERVE = 5.0
"""Seconds before the deadline at which the tests are stopped."""
SAVES_EVERY, LOOKS_EVERY = 5.0, 0.2
END_OF_OUTPUT = 3000
QUICK = ["tests/kernels/test_ssim.py", "-k", "bad_arguments"]


class Share:
    """The tests of one process: its outcomes, and a new process as long as tests are left."""

    def __init__(self, work: Path, which: int, count: int, quick: bool, done: set[str]) -> None:
        self.work, self.which, self.count, self.quick = work, which, count, quick
        self.outcomes: dict[str, tuple[str, str]] = {}
        """Outcome and text of a failure, by test."""
        self.total, self.running, self.ended, self.broken = 0, "", False, ""
        self._before, self._read, self._at_start = done, 0, 0
        self._file = work / f"tests-{which}.jsonl"
        self._file.unlink(missing_ok=True)
        self._process: subprocess.Popen[bytes] | None = None
        self._log: IO[bytes] | None = None
        self.start()

    def start(self) -> None:
        done = self.work / f"tests-{self.which}-done.json"
        done.write_text(json.dumps([*self._before, *self.outcomes]), encoding="utf-8")
        share = [self.which, self.count]
        task = {"done": str(done), "outcomes": str(self._file), "share": share, "all": self.quick}
        command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "gpu_outcomes", "-o", "addopts="]
        command += ["--import-mode=importlib", "-m", "not slow", "-q", "--tb=short", *(QUICK if self.quick else [])]
        if importlib.util.find_spec("pytest_timeout"):
            command += ["--timeout", str(HANGS_AFTER)]
        paths = os.pathsep.join([str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])])
        variables = {**os.environ, VARIABLE: json.dumps(task), "PYTHONPATH": paths}
        self._at_start, self.running = len(self.outcomes), ""
        self._log = open(self.work / f"tests-{self.which}.log", "wb")
        self._process = subprocess.Popen(
            command, cwd=ROOT, env=variables, stdin=subprocess.DEVNULL, stdout=self._log, stderr=self._log
        )

    def look(self) -> int:
        """Read the new outcomes, and start another process if one has died; return the number of new outcomes."""
        assert self._process is not None
        status = self._process.poll()  # before reading: nothing is written afterwards
        new = self.read()
        if status is not None and not self.ended:
            if self.running:
                text = f"its process ended with status {status}: {self._end()}"
                self.outcomes[self.running] = ("failed", text)
            if len(self.outcomes) == self._at_start:
                self.ended, self.broken = True, f"pytest ended with status {status}: {self._end()}"
            else:
                self.stop()
                self.start()
        return new

    def read(self) -> int:
        """Read the new outcomes; return their number."""
        if not self._file.exists():
            return 0
        new, lines = 0, self._file.read_bytes()[self._read :].splitlines(keepends=True)
        for line in lines:
            if not line.endswith(b"\n"):
                break
            self._read += len(line)
            name, outcome, text = json.loads(line)
            if outcome == COUNTED:
                self.total = int(name)
            elif outcome == ENDED:
                self.ended = True
            elif outcome == BEGAN:
                self.running = name
            else:
                self.outcomes[name], self.running = (outcome, text), ""
                new += 1
        return new

    def _end(self) -> str:
        text = (self.work / f"tests-{self.which}.log").read_text(encoding="utf-8", errors="replace")
        return text[-END_OF_OUTPUT:]

    def stop(self) -> None:
        if self._process is not None and self._log is not None:
            self._process.kill()
            self._process.wait()
            self._log.close()


def tests(call: Call) -> Report:
    """Run the tests that need the GPU.

    Raises:
        NotRun: pytest is not installed.
        Unfinished: the time did not suffice.
    """
    if importlib.util.find_spec("pytest") is None:
        raise NotRun('pytest is not installed: pip install -e ".[dev]"')
    fine = dict.fromkeys(call.earlier.get("fine", []))
    quick = call.setting.quick
    count = 1 if quick else max(1, min(MOST_PROCESSES, environment.available_threads() // CORES_OF_ONE))
    with ExitStack() as stack:
        shares = [Share(call.work, which, count, quick, set(fine)) for which in range(count)]
        for share in shares:
            stack.callback(share.stop)
        with progress(0, "tests", start=len(fine)) as bar:
            _watch(call, shares, list(fine), bar)
        for share in shares:
            share.stop()
            share.read()
        report = summary(shares, list(fine))
        if all(share.ended for share in shares):
            passed = not report["failures"] and report["total"] > 0
            if passed:
                del report["fine"]
            return {**report, "passed": passed}
        call.save(report)
        failed = f", {len(report['failures'])} have failed" if report["failures"] else ""
        raise Unfinished(f"{len(report['fine'])} of {report['total']} tests have passed{failed}")


def _watch(call: Call, shares: list[Share], fine: list[str], bar: Progress) -> None:
    """Wait for all shares or the deadline, and save the outcomes from time to time."""
    saved_at = time.monotonic()
    while not all(share.ended for share in shares) and call.left() > RESERVE:
        new = sum(share.look() for share in shares if not share.ended)
        bar.total = sum(share.total for share in shares)
        if new:
            bar.advance(new, failed=len(summary(shares, fine)["failures"]))
            if time.monotonic() - saved_at > SAVES_EVERY:
                saved_at = time.monotonic()
                call.save(summary(shares, fine))
        else:
            time.sleep(LOOKS_EVERY)


def summary(shares: list[Share], fine: list[str]) -> Report:
    """Return the numbers, the failures with their texts, and the tests that need not be repeated."""
    outcomes = {name: own for share in shares for name, own in share.outcomes.items()}
    failures = {name: text for name, (outcome, text) in outcomes.items() if outcome == "failed"}
    failures.update({f"process {share.which}": share.broken for share in shares if share.broken})
    return {
        "total": sum(share.total for share in shares),
        "processes": len(shares),
        "skipped": sum(outcome == "skipped" for outcome, _ in outcomes.values()),
        "failures": failures,
        "fine": [*fine, *(name for name, (outcome, _) in outcomes.items() if outcome != "failed")],
    }
