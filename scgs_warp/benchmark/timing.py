"""Timing for benchmarks: repeats under a time budget, stages of the code that really runs, what the machine gave."""

from __future__ import annotations

import contextlib
import gc
import platform
import statistics
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple

import torch
import warp as wp

from ..kernels import benchmark as kernels
from ..runtime import environment
from ..runtime.launch import launch

WARM_UP = 2
FEWEST = 5
"""Repeats, however slow they are."""
MOST = 300
ROUNDS = 100_000
"""Steps of the arithmetic loop in one chunk: some 0.2 ms, far above what handing it to a thread costs."""
CHUNKS = 32
TURNS = 7


class Timing(NamedTuple):
    """Milliseconds of repeated calls, warm-up left out."""

    median: float
    least: float


def repeat(function: Callable[[int], Any], seconds: float, device: str) -> Timing:
    """Call ``function(0)``, ``function(1)`` ... for about ``seconds``, at least ``FEWEST`` times after ``WARM_UP``."""
    wait = torch.cuda.synchronize if device == "cuda" else _nothing
    for index in range(WARM_UP):
        function(index)
    times: list[float] = []
    with _no_garbage_collection():
        while len(times) < FEWEST or (sum(times) < seconds and len(times) < MOST):
            wait()
            began = time.perf_counter()
            function(WARM_UP + len(times))
            wait()
            times.append(time.perf_counter() - began)
    return Timing(1e3 * statistics.median(times), 1e3 * min(times))


def turns(functions: list[Callable[[int], Any]], seconds: float, device: str) -> list[list[float]]:
    """Milliseconds of every function's calls, one call each in turn, warm-up left out; as many turns as take about
    ``seconds`` per function, at least ``FEWEST``."""
    wait = torch.cuda.synchronize if device == "cuda" else _nothing
    times: list[list[float]] = [[] for _ in functions]
    for index in range(WARM_UP):
        for function in functions:
            function(index)
    with _no_garbage_collection():
        while len(times[0]) < FEWEST or (sum(map(sum, times)) < 1e3 * seconds * len(times) and len(times[0]) < MOST):
            for own, function in zip(times, functions):
                wait()
                began = time.perf_counter()
                function(WARM_UP + len(own))
                wait()
                own.append(1e3 * (time.perf_counter() - began))
    return times


def _nothing() -> None:
    pass


@contextlib.contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """As ``timeit`` does: a collection of another row's leavings is no part of this one."""
    gc.collect()
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


class Stages:
    """Stage times of the very code that runs: named functions are wrapped while it is timed, and unwrapped after.

    A stage inside another one counts for the outer. On CUDA the device is waited for at both ends of a stage, so the
    stages' sum exceeds what an undisturbed call takes; times without stages are taken apart from these.
    """

    def __init__(self, device: str, targets: Mapping[str, list[tuple[Any, str]]]) -> None:
        """``targets``: per stage, the (owner, attribute) pairs whose calls belong to it."""
        self.device, self.targets = device, targets
        self._spent: dict[str, float] = {}
        self._inside = False

    def _wrap(self, stage: str, function: Callable) -> Callable:
        wait = torch.cuda.synchronize if self.device == "cuda" else _nothing

        def timed(*args: Any, **kwargs: Any) -> Any:
            if self._inside:
                return function(*args, **kwargs)
            self._inside = True
            wait()
            began = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                wait()
                self._spent[stage] = self._spent.get(stage, 0.0) + time.perf_counter() - began
                self._inside = False

        return timed

    @contextlib.contextmanager
    def _wrapped(self) -> Iterator[None]:
        with contextlib.ExitStack() as undo:
            for stage, places in self.targets.items():
                for owner, name in places:
                    function = getattr(owner, name)
                    inherited = name not in vars(owner)
                    setattr(owner, name, self._wrap(stage, function))
                    if inherited:
                        undo.callback(delattr, owner, name)
                    else:
                        undo.callback(setattr, owner, name, function)
            yield

    def repeat(self, function: Callable[[int], Any], seconds: float) -> dict[str, tuple[Timing, float]]:
        """Per stage its times and its share of the whole; ``rest`` is what belongs to none. Shares add up to 1."""
        spent: list[dict[str, float]] = []

        def once(index: int) -> None:
            self._spent = dict.fromkeys(self.targets, 0.0)
            began = time.perf_counter()
            function(index)
            if self.device == "cuda":
                torch.cuda.synchronize()
            total = time.perf_counter() - began
            spent.append({**self._spent, "rest": max(total - sum(self._spent.values()), 0.0)})

        with self._wrapped():
            repeat(once, seconds, self.device)
        spent = spent[WARM_UP:]
        sums = {stage: sum(row[stage] for row in spent) for stage in spent[0]}
        whole = sum(sums.values())
        return {
            stage: (
                Timing(1e3 * statistics.median(row[stage] for row in spent), 1e3 * min(row[stage] for row in spent)),
                total / whole,
            )
            for stage, total in sums.items()
            if total > 0.0
        }


def two_thread_scaling() -> float:
    """How much faster two threads do pure arithmetic than one, now, on this machine: 2 at best. On a shared machine it
    is near 1 for minutes at a time, and times of two threads mean nothing then."""
    before = environment.thread_count()
    values = torch.empty(CHUNKS)
    times: dict[int, list[float]] = {1: [], 2: []}
    for turn in range(TURNS + 1):
        for threads in times:
            environment.configure(threads)
            began = time.perf_counter()
            launch(kernels.arithmetic, CHUNKS, ROUNDS, values, grain=1)
            if turn:
                times[threads].append(time.perf_counter() - began)
    environment.configure(before)
    return statistics.median(times[1]) / statistics.median(times[2])


def processor() -> str:
    """The processor's name, as well as the system tells it."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def machine(device: str) -> dict[str, Any]:
    """What figures depend on; neither names nor paths of the machine."""
    import scgs_warp

    return {
        "processor": processor(),
        "cores": environment.available_threads(),
        "gpu": torch.cuda.get_device_name() if device == "cuda" else None,
        "system": platform.system(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "warp": wp.__version__,
        "scgs_warp": getattr(scgs_warp, "__version__", None),
    }


def commit() -> str | None:
    """The commit of the checkout that is measured, followed by ``-dirty`` if code differs from it; None outside of a
    checkout."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    code = [".", ":(exclude)docs", ":(exclude)README.md", ":(exclude)benchmarks/results"]
    try:
        head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=root, capture_output=True, text=True, check=True)
        differs = subprocess.run(["git", "diff", "--quiet", "HEAD", "--", *code], cwd=root, check=False).returncode
    except (OSError, subprocess.CalledProcessError):
        return None
    return head.stdout.strip() + ("-dirty" if differs else "")


def provenance(device: str) -> dict[str, Any]:
    """``date``, ``commit`` and ``machine`` of a measurement."""
    now = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return {"date": now, "commit": commit(), "machine": machine(device)}
