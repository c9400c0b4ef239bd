"""Sharing of a grid among CPU threads: cutting the grid into chunks, and running them.

Chunks get smaller towards the end (guided self-scheduling, Polychronopoulos and Kuck 1987): a few large chunks have
little overhead, and small final ones let all threads end at about the same time. If the cost of each grid index is
known beforehand, chunks are cut by cost and the heaviest come first.
"""

from __future__ import annotations

import functools
import itertools
import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from queue import SimpleQueue

import numpy as np
import torch
from torch import Tensor

from . import addresses, environment
from .memory import NotEnoughMemory

Chunk = tuple[int, int]
"""Chunk of a grid: its first index and its number of indices."""

CHUNKS_PER_SHARE = 3
"""Number of chunks in a thread's fair share of the remaining grid. More than one, because costs are estimates and the
first chunk must not end last."""
MAX_CHUNKS_PER_SHARE = 32
"""Largest number of chunks in a thread's fair share of the whole grid; it limits how small chunks get."""


@functools.cache
def _shares(threads: int) -> np.ndarray:
    """Return the ends of the chunks as fractions of the whole grid, ascending to 1."""
    ends, left = [], 1.0
    while left > 0.0:
        left -= max(left / (CHUNKS_PER_SHARE * threads), 1.0 / (MAX_CHUNKS_PER_SHARE * threads))
        ends.append(1.0 - max(left, 0.0))
    return np.array(ends)


@functools.lru_cache(maxsize=1024)
def cut_evenly(count: int, threads: int, grain: int) -> list[Chunk]:
    """Cut a grid into chunks of multiples of ``grain`` indices; the last may be smaller."""
    ends = np.minimum(np.ceil(_shares(threads) * (count / grain)).astype(np.int64) * grain, count)
    return _chunks(np.unique(ends))


def cut_by_load(load: Tensor, threads: int) -> list[Chunk]:
    """Cut a grid into chunks of similar cost, heaviest first.

    Args:
        load: [count] integers, on the CPU: cumulative cost of the indices, each included.
        threads: number of threads that share the work.
    """
    running = load.numpy()
    last = np.searchsorted(running, _shares(threads) * float(running[-1]))
    ends = np.unique(np.append(np.minimum(last + 1, len(running)), len(running)))
    costs = np.diff(running[ends - 1], prepend=0)
    chunks = _chunks(ends)
    return [chunks[k] for k in np.argsort(-costs, kind="stable").tolist()]


def _chunks(ends: np.ndarray) -> list[Chunk]:
    begins = [0, *ends[:-1].tolist()]
    return [(begin, end - begin) for begin, end in zip(begins, ends.tolist())]


class HelperThreads:
    """Helper threads that wait for jobs as long as the process lives."""

    def __init__(self, flush_denormals: bool) -> None:
        # Either all threads flush denormals or none does, so that results do not depend on the thread.
        self.flush_denormals = flush_denormals
        self.jobs: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self.count = 0

    def submit(self, job: Callable[[], None], copies: int) -> int:
        """Let up to ``copies`` threads run ``job``, fewer where no more can be started; return their number."""
        with suppress(NotEnoughMemory):
            while self.count < copies:
                addresses.start(threading.Thread(target=self._serve, name=f"warp-{self.count + 1}", daemon=True))
                self.count += 1
        copies = min(copies, self.count)
        for _ in range(copies):
            self.jobs.put(job)
        return copies

    def dismiss(self) -> None:
        for _ in range(self.count):
            self.jobs.put(None)

    def _serve(self) -> None:
        torch.set_flush_denormal(self.flush_denormals)
        while (job := self.jobs.get()) is not None:
            job()


helpers = HelperThreads(False)


def _forked() -> None:
    """Start anew in a child process, which inherits no threads."""
    global helpers
    helpers = HelperThreads(helpers.flush_denormals)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)


def share(call: Callable[[int, int], None], chunks: Sequence[Chunk], threads: int) -> None:
    """Run ``call(first, size)`` once for each chunk, in this thread and up to ``threads - 1`` others.

    The function returns when all chunks are done, even if some helpers have not woken up yet. Such a helper finds
    nothing to do and does not keep ``call`` and its tensors alive, because the next step needs their memory.
    """
    global helpers
    flush = environment.configured()
    if helpers.flush_denormals != flush:
        helpers.dismiss()
        helpers = HelperThreads(flush)
    ticket, finished, all_done = itertools.count(), itertools.count(1), threading.Lock()
    all_done.acquire()
    errors: list[BaseException] = []
    calls = [call]

    def work() -> None:
        while (turn := next(ticket)) < len(chunks):
            try:
                calls[0](*chunks[turn])
            except BaseException as error:  # raised again below, in the calling thread
                errors.append(error)
            if next(finished) == len(chunks):
                all_done.release()

    left = threading.Semaphore(0)

    def help_out() -> None:
        work()
        left.release()

    copies = helpers.submit(help_out, min(threads, len(chunks)) - 1)
    try:
        work()
        all_done.acquire()
    except BaseException:  # after an interrupt, helpers may still write to memory that would be freed
        _acquire_all(left, copies)
        raise
    finally:
        calls.clear()
    if errors:
        raise errors[0]


def _acquire_all(semaphore: threading.Semaphore, count: int) -> None:
    while count > 0:
        try:
            semaphore.acquire()
            count -= 1
        except KeyboardInterrupt:
            continue
