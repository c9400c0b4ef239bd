"""Fuzz the kernels: ``python tests/fuzz/campaign.py --cases 20000 --seed 0``.

The number of a case chooses the op, the sizes and every value: ``--cases 1 --seed 1234`` repeats one case. Cases run in
a worker process, which records the number first: a case that crashes or hangs is reported, and the next ones are run.
The summary is a JSON file; an interrupted campaign continues where its summary ends.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import Any, TextIO

HERE = Path(__file__).resolve().parent
MODULES = ("fuzz.cases_render", "fuzz.cases_motion", "fuzz.cases_training", "fuzz.cases_mesh", "fuzz.cases_cuda")
SAVE_EVERY = 5.0
"""Seconds between two summaries."""
PATIENCE = 240
"""Time limit of a case in seconds; the first ones compile kernels."""


def cases_of(modules: list[str], ops: list[str]) -> dict[str, tuple[Any, float]]:
    """Return every case and its frequency, by op."""
    found: dict[str, tuple[Any, float]] = {}
    for module in modules:
        found.update(importlib.import_module(module).CASES)
    unknown = set(ops) - set(found)
    if unknown:
        raise SystemExit(f"--ops {sorted(unknown)}: there are {sorted(found)}")
    return {op: case for op, case in found.items() if not ops or op in ops}


def op_of(number: int, cases: dict[str, tuple[Any, float]]) -> str:
    import numpy as np

    weights = np.array([weight for _, weight in cases.values()], np.float64)
    drawn = np.random.default_rng([number, 7]).random() * weights.sum()
    return list(cases)[int(np.searchsorted(weights.cumsum(), drawn, side="right"))]


def run_cases(first: int, last: int, device: str, cases: dict[str, tuple[Any, float]], folder: Path, patience: int):
    """Run cases ``first .. last - 1``, writing each outcome to ``folder`` at once."""
    from fuzz.fence import fenced
    from fuzz.poison import Draw

    place = os.open(folder / "place", os.O_RDWR | os.O_CREAT)
    with open(folder / "done", "a", encoding="utf-8", buffering=1) as done, fenced() as fence:
        for number in range(first, last):
            op = op_of(number, cases)
            os.pwrite(place, f"{number} {op}".ljust(80).encode(), 0)
            signal.alarm(patience)  # nobody catches it: the process ends, wherever it is
            fence.high, failure = number % 2 == 0, ""
            try:
                cases[op][0](Draw(number), device)
                fence.release()
            except Exception as error:
                where = traceback.extract_tb(error.__traceback__)[-1]
                failure = f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
                fence.held.clear()
            done.write(json.dumps([number, op, failure]) + "\n")


def prepared(own: argparse.Namespace) -> dict[str, tuple[Any, float]]:
    """Load and configure everything that cases need; return the cases."""
    import warnings

    import scgs_warp  # noqa: F401  (sets the environment before torch is imported)

    if own.debug:
        import warp as wp

        wp.config.mode = "debug"  # Warp checks every index; the first that is out of range ends the process

    import torch  # isort: skip

    from scgs_warp.runtime import environment

    environment.configure(threads=1)
    torch.utils.deterministic.fill_uninitialized_memory = True  # what no kernel has written is NaN
    warnings.simplefilter("ignore")
    return cases_of(own.modules, own.ops)


def work(own: argparse.Namespace) -> None:
    """Run all cases in child processes; a child that a case crashes is replaced."""
    folder: Path = own.worker
    first, last = own.seed, own.seed + own.cases
    (folder / "place").touch()
    # CUDA cannot be used in the child of a process that has initialised it, so there every child loads for itself.
    loaded = prepared(own) if own.device == "cpu" else None
    while first < last:
        child = os.fork()
        if child == 0:
            status = 1
            try:
                run_cases(first, last, own.device, prepared(own) if loaded is None else loaded, folder, own.patience)
                status = 0
            except Exception:
                traceback.print_exc()
            finally:
                os._exit(status)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if status == 0:
            return
        number, _, op = (folder / "place").read_text(encoding="utf-8").strip().partition(" ")
        if not number or int(number) < first:
            sys.exit(f"a worker ended with status {status} outside any case")
        failure = f"ended the process with status {status}"
        if status == -signal.SIGALRM:
            failure = f"took more than {own.patience} s"
        with open(folder / "done", "a", encoding="utf-8") as done:
            done.write(json.dumps([int(number), op, failure]) + "\n")
        first = int(number) + 1


class Campaign:
    """Counts and failures of cases ``seed .. seed + cases - 1``, stored in a file."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        self.arguments = arguments
        self.end = arguments.seed + arguments.cases
        self.counts: Counter[str] = Counter()
        self.failures: list[dict[str, Any]] = []
        self.next = arguments.seed
        self.seconds = 0.0
        if arguments.summary.is_file():
            self._go_on(json.loads(arguments.summary.read_text(encoding="utf-8")))

    def _go_on(self, before: dict[str, Any]) -> None:
        if (before["seed"], before["device"]) != (self.arguments.seed, self.arguments.device):
            raise SystemExit(f"{self.arguments.summary}: of another campaign; give another --summary or remove it")
        self.counts, self.failures = Counter(before["cases_of"]), before["failures"]
        self.next, self.seconds = before["next"], before["seconds"]

    def save(self) -> dict[str, Any]:
        summary = {
            "seed": self.arguments.seed,
            "device": self.arguments.device,
            "next": self.next,
            "cases": sum(self.counts.values()),
            "cases_of": dict(sorted(self.counts.items())),
            "failures": self.failures,
            "seconds": round(self.seconds, 1),
        }
        own = self.arguments.summary
        own.parent.mkdir(parents=True, exist_ok=True)
        fresh = own.with_name(own.name + ".new")
        fresh.write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
        os.replace(fresh, own)
        return summary

    def take(self, lines: list[str]) -> None:
        for line in lines:
            number, op, failure = json.loads(line)
            self.add(number, op, failure)

    def add(self, number: int, op: str, failure: str) -> None:
        self.counts[op] += 1
        self.next = number + 1
        if failure:
            self.failures.append({"case": number, "op": op, "failure": failure})
            print(f"case {number}, {op}: {failure}", flush=True)


def run(campaign: Campaign) -> None:
    """Start a worker process for the rest of the campaign."""
    own = campaign.arguments
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = [sys.executable, str(HERE / "campaign.py"), "--worker", name, "--seed", str(campaign.next)]
        command += ["--cases", str(campaign.end - campaign.next), "--device", own.device]
        command += ["--patience", str(own.patience), "--modules", *own.modules, "--ops", *own.ops]
        command += ["--debug"] if own.debug else []
        path = os.pathsep.join([str(HERE.parent), str(HERE.parent.parent), os.environ.get("PYTHONPATH", "")])
        (folder / "done").touch()
        with open(folder / "errors", "wb") as errors, open(folder / "done", encoding="utf-8") as done:
            worker = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": path}, stderr=errors)
            try:
                follow(campaign, worker, done)
            finally:
                worker.kill()
                worker.wait()
        if campaign.next < campaign.end:
            tail = (folder / "errors").read_text(encoding="utf-8", errors="replace")[-2000:]
            raise SystemExit(f"the worker ended with status {worker.returncode}:\n{tail}")


def follow(campaign: Campaign, worker: subprocess.Popen[bytes], done: TextIO) -> None:
    """Collect the worker's outcomes until it exits."""
    from scgs_warp.runtime.progress import progress

    begun = saved = time.monotonic()
    seconds, rest = campaign.seconds, ""
    with progress(campaign.arguments.cases, "fuzzing", start=campaign.next - campaign.arguments.seed) as bar:
        ended = False
        while not ended:
            ended = worker.poll() is not None
            lines = (rest + done.read()).split("\n")
            rest, before = lines.pop(), campaign.next
            campaign.take(lines)
            bar.advance(campaign.next - before, failures=len(campaign.failures))
            campaign.seconds = seconds + time.monotonic() - begun
            if time.monotonic() - saved > SAVE_EVERY:
                saved = time.monotonic()
                campaign.save()
            time.sleep(0.0 if ended else 0.1)


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=20_000, help="how many")
    parser.add_argument("--seed", type=int, default=0, help="number of the first one")
    parser.add_argument("--device", default="cpu", help="cpu, where memory is fenced, or cuda")
    parser.add_argument("--ops", nargs="*", default=[], help="only these")
    parser.add_argument("--summary", type=Path, default=Path("fuzz-kernels.json"), help="where the summary goes")
    parser.add_argument("--patience", type=int, default=PATIENCE, help="seconds a case may take")
    parser.add_argument("--debug", action="store_true", help="compile kernels with checked indices (takes minutes)")
    parser.add_argument("--modules", nargs="*", default=list(MODULES), help=argparse.SUPPRESS)
    parser.add_argument("--worker", type=Path, default=None, help=argparse.SUPPRESS)
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    own = parse(arguments)
    if own.worker is not None:
        work(own)
        return 0
    campaign = Campaign(own)
    try:
        if campaign.next < campaign.end:
            run(campaign)
    finally:
        summary = campaign.save()
    print(f"{summary['cases']:,} cases, {len(summary['failures'])} failures, {summary['seconds']:g} s; {own.summary}")
    return 1 if summary["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
