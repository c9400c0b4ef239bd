"""Timing for benchmarks: repeats under a time budget, and stages of the code in use."""

from __future__ import annotations

import contextlib
import gc
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import torch

from ..kernels import benchmark as kernels
from ..runtime import environment
from ..runtime.launch import launch

WARM_UP = 2
MIN_REPEATS = 5
"""Least number of repeats, however slow they are."""
MAX_REPEATS = 300
ROUNDS = 100_000
"""Steps of the arithmetic loop in one chunk, which takes about 0.2 ms, far longer than handing it to a thread."""
CHUNKS = 32
TURNS = 7


class Timing(NamedTuple):
    """Milliseconds of repeated calls, without warm-up."""

    median: float
    least: float


def repeat(function: Callable[[int], Any], seconds: float, device: str) -> Timing:
    """Time ``function(0)``, ``function(1)`` ... for about ``seconds``, at least ``MIN_REPEATS`` after ``WARM_UP``."""
    wait = torch.cuda.synchronize if device == "cuda" else _nothing
    for index in range(WARM_UP):
        function(index)
    times: list[float] = []
    with _no_garbage_collection():
        while len(times) < MIN_REPEATS or (sum(times) < seconds and len(times) < MAX_REPEATS):
            wait()
            began = time.perf_counter()
            function(WARM_UP + len(times))
            wait()
            times.append(time.perf_counter() - began)
    return Timing(1e3 * statistics.median(times), 1e3 * min(times))


def turns(functions: list[Callable[[int], Any]], seconds: float, device: str) -> list[list[float]]:
    """Time several functions, one call each in turn, for about ``seconds`` per function and at least ``MIN_REPEATS``.

    Returns:
        Milliseconds of every function's calls, without warm-up.
    """
    wait = torch.cuda.synchronize if device == "cuda" else _nothing
    times: list[list[float]] = [[] for _ in functions]
    for index in range(WARM_UP):
        for function in functions:
            function(index)
    with _no_garbage_collection():
        while len(times[0]) < MIN_REPEATS or (
            sum(map(sum, times)) < 1e3 * seconds * len(times) and len(times[0]) < MAX_REPEATS
        ):
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
    """Keep garbage of earlier rows out of the times, as ``timeit`` does."""
    gc.collect()
    with environment.no_collection():
        yield


class Stages:
    """Times of stages, taken from the code in use: named functions are wrapped while it is timed.

    A stage inside another one counts for the outer one. On CUDA both ends of a stage wait for the device, so the sum of
    stages exceeds the time of an undisturbed call, which is taken separately.
    """

    def __init__(self, device: str, targets: Mapping[str, list[tuple[Any, str]]]) -> None:
        """``targets`` holds, by stage, the (owner, attribute) pairs of the functions that belong to the stage."""
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
        """Return the times and the share of each stage, and of the ``rest``; shares add up to 1."""
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
    """Measure the speed-up of two threads at pure arithmetic, 2 at best.

    On a shared machine it may be near 1 for minutes; times of two threads mean nothing then.
    """
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
