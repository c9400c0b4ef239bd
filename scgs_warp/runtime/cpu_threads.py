"""Sharing of a grid among CPU threads: cutting the grid into chunks, and running them.

Chunks get smaller towards the end (guided self-scheduling, Polychronopoulos and Kuck 1987): a few large chunks have
little overhead, and small final ones let all threads end at about the same time. If the cost of each grid index is
known beforehand, chunks are cut by cost and the heaviest come first.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from queue import SimpleQueue

import numpy as np
import torch
from torch import Tensor

from ..kernels.cpu import sharing as kernels
from ..kernels.types import SHARED_ARGUMENTS
from . import addresses, environment
from .cpu_kernel import CpuKernel
from .kernel_arguments import FIRST_SIZE
from .kernel_cache import prepared
from .memory import NotEnoughMemory

STATE, DONE, AWAKE, ENTRY, SPINS, JOB_SIZE = 0, 8, 16, 24, 32, 33
"""Indices of a job's numbers (``kernels/native/sharing.h``), and how many there are."""
MOST_SEATS = 255
"""Largest number of helpers that share a grid; a job has eight bits for it."""
LOOKS = 40_000
"""Number of looks in vain after which a helper sleeps: about a millisecond, more than Python takes between two kernels
of a frame. Waking a helper costs the caller more than a short kernel takes, since both need the interpreter."""

CHUNKS_PER_SHARE = 3
"""Number of chunks in a thread's fair share of the remaining grid. More than one, because costs are estimates and the
first chunk must not end last."""
MAX_CHUNKS_PER_SHARE = 32
"""Largest number of chunks in a thread's fair share of the whole grid; it limits how small chunks get."""

IMPATIENCE = 1.5e-4
"""Seconds for which the caller, which waits for the last chunks, offers its core without sleeping. Since Python 3.11, a
sleep of 0 seconds takes 50 microseconds or more on Linux, as long as a short kernel."""
_yield_core: Callable[[], object] = getattr(os, "sched_yield", functools.partial(time.sleep, 0.0))


@functools.cache
def _shares(threads: int) -> np.ndarray:
    """Return the ends of the chunks as fractions of the whole grid, ascending to 1."""
    ends, left = [], 1.0
    while left > 0.0:
        left -= max(left / (CHUNKS_PER_SHARE * threads), 1.0 / (MAX_CHUNKS_PER_SHARE * threads))
        ends.append(1.0 - max(left, 0.0))
    return np.array(ends)


class Chunks:
    """Chunks of a grid, in the order in which threads take them. Iteration yields the first index and the size."""

    def __init__(self, firsts: np.ndarray, sizes: np.ndarray) -> None:
        self.firsts, self.sizes = np.ascontiguousarray(firsts, np.int32), sizes
        self._placed: tuple[np.ndarray, int, int, int] | None = None

    def __len__(self) -> int:
        return len(self.firsts)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return zip(self.firsts.tolist(), self.sizes.tolist())

    def placed(self, of_size: Callable[[int], bytes]) -> tuple[np.ndarray, int, int, int]:
        """Return the launch bounds of the chunks, [chunks, bytes], their address, their bytes per chunk, and the
        address of the first indices."""
        placed = self._placed
        if placed is None:
            raw = b"".join(map(of_size, self.sizes.tolist()))
            bounds = np.frombuffer(raw, np.uint8).reshape(len(self), -1)
            placed = self._placed = bounds, bounds.ctypes.data, bounds.shape[1], self.firsts.ctypes.data
        return placed


@functools.lru_cache(maxsize=1024)
def cut_evenly(count: int, threads: int, grain: int) -> Chunks:
    """Cut a grid into chunks of multiples of ``grain`` indices; the last may be smaller."""
    ends = np.minimum(np.ceil(_shares(threads) * (count / grain)).astype(np.int64) * grain, count)
    return Chunks(*_between(np.unique(ends)))


def cut_by_load(load: Tensor, threads: int) -> Chunks:
    """Cut a grid into chunks of similar cost, heaviest first.

    Args:
        load: [count] integers, on the CPU: cumulative cost of the indices, each included.
        threads: number of threads that share the work.
    """
    running = load.numpy()
    ends = np.minimum(np.searchsorted(running, _shares(threads) * float(running[-1])) + 1, len(running))
    ends[-1] = len(running)
    ends = ends[np.append(ends[:-1] != ends[1:], True)]
    costs = running[ends - 1]
    costs[1:] -= running[ends[:-1] - 1]
    order = np.argsort(-costs, kind="stable")
    firsts, sizes = _between(ends)
    return Chunks(firsts[order], sizes[order])


def _between(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first indices and the sizes of consecutive chunks."""
    firsts = np.zeros_like(ends)
    firsts[1:] = ends[:-1]
    return firsts, ends - firsts


class HelperThreads:
    """Threads that take chunks of the same job (``kernels/native/sharing.h``).

    A helper without work looks for the next job for about a millisecond, because a short kernel would be over
    before it woke up; then it sleeps.
    """

    def __init__(self, flush_denormals: bool) -> None:
        # Either all threads flush denormals or none does, so that results do not depend on the thread.
        self.flush_denormals = flush_denormals
        self._threads: list[threading.Thread] = []
        self._wakes: SimpleQueue[bool] = SimpleQueue()
        """For each helper that is to wake up: True to look for jobs, False to end."""
        self._busy = threading.Lock()
        self._shared = torch.zeros(JOB_SIZE, dtype=torch.int64)
        self._job = self._shared.numpy()
        self._arguments = bytearray(SHARED_ARGUMENTS)
        self._address = ctypes.addressof(ctypes.c_char.from_buffer(self._arguments))
        self._calls: dict[str, Callable[[], None]] = {}

    @property
    def count(self) -> int:
        """Number of helpers that have been started."""
        return len(self._threads)

    def share(self, kernel: CpuKernel, arguments: bytes, chunks: Chunks, threads: int, begin: int) -> bool:
        """As :func:`share`."""
        size = FIRST_SIZE + len(arguments)
        if size > SHARED_ARGUMENTS or not self._busy.acquire(blocking=False):
            return False
        try:
            if not self._calls and not self._prepare():
                return False
            placed = chunks.placed(kernel.bounds)  # held until the job is done, as are the first indices
            places, firsts = placed[1:], chunks.firsts
            if begin:
                firsts = firsts + np.int32(begin)
                places = (*placed[1:3], firsts.ctypes.data)
            self._arguments[FIRST_SIZE:size] = arguments
            seats = min(threads, len(chunks), MOST_SEATS + 1) - 1
            self._job[ENTRY:SPINS] = kernel.address, *places, self._address, size, len(chunks), seats
            self._run(len(chunks), seats)
        finally:
            self._busy.release()
        return True

    def _prepare(self) -> bool:
        """Compile the kernels that share a job; return False if there is no room for them."""
        environment.quiet_torch()
        calls = {}
        with suppress(NotEnoughMemory):
            for kernel in (kernels.share_job, kernels.finish_job, kernels.serve_job):
                cpu = prepared(kernel, lambda kernel=kernel: CpuKernel(kernel, (self._shared,)))
                calls[kernel.key] = cpu.bound((self._shared,))
            self._calls = calls
        return bool(self._calls)

    def _wake(self, helpers: int) -> None:
        """Wake as many helpers as are missing, fewer where no more can be started."""
        missing = helpers - int(self._job[AWAKE])
        if missing <= 0:
            return
        with suppress(NotEnoughMemory):
            while self.count < helpers:
                thread = threading.Thread(target=self._serve, name=f"warp-{self.count + 1}", daemon=True)
                addresses.start(thread)
                self._threads.append(thread)
        # Threads that share a core would take it from each other while they look for jobs.
        self._job[SPINS] = LOOKS if environment.available_threads() > helpers else 0
        for _ in range(min(missing, self.count) - self._wakes.qsize()):
            self._wakes.put(True)

    def _run(self, chunks: int, helpers: int) -> None:
        """Run the job. After an interrupt as well, return only when no helper writes to its tensors any more.

        What is raised before the job was offered is raised at once.
        """
        job, before, called, sleep_at, interrupt = self._job, int(self._job[STATE]), False, 0.0, None
        while True:
            try:
                if job[STATE] == before:
                    self._calls["share_job"]()
                elif job[DONE] == chunks:
                    break
                elif not called:
                    called = True
                    self._wake(helpers)
                else:
                    self._calls["finish_job"]()
                    now = time.perf_counter()
                    sleep_at = sleep_at or now + IMPATIENCE
                    if now < sleep_at:
                        _yield_core()
                    else:
                        time.sleep(0.0)
            except BaseException as error:
                if job[STATE] == before:
                    raise
                interrupt = error
        if interrupt is not None:
            raise interrupt

    def dismiss(self) -> None:
        """Let the helpers end."""
        self._job[SPINS] = 0
        for _ in range(self.count):
            self._wakes.put(False)

    def end(self) -> None:
        """Let the helpers end, and wait for them: none may run compiled code that is being unloaded."""
        self.dismiss()
        for thread in self._threads:
            thread.join(1.0)

    def _serve(self) -> None:
        torch.set_flush_denormal(self.flush_denormals)
        while self._wakes.get():
            self._calls["serve_job"]()


helpers = HelperThreads(False)


def _forked() -> None:
    """Start anew in a child process, which inherits no threads: torch's OpenMP would wait for those of the parent."""
    global helpers
    torch.set_num_threads(1)
    helpers = HelperThreads(helpers.flush_denormals)


atexit.register(lambda: helpers.end())
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)


def share(kernel: CpuKernel, arguments: bytes, chunks: Chunks, threads: int, begin: int = 0) -> bool:
    """Run each chunk of a grid once, in this thread and up to ``threads - 1`` others.

    The function returns when all chunks are done, even if some helpers have not woken up yet.

    Args:
        arguments: those after ``first``, as ``kernel.pack`` returns them; the caller keeps their tensors alive.
        begin: added to the chunks' first indices.

    Returns:
        False if nothing was run, because another thread shares a grid, or because there is no room.
    """
    global helpers
    flush = environment.configured()
    if helpers.flush_denormals != flush:
        helpers.dismiss()
        helpers = HelperThreads(flush)
    return helpers.share(kernel, arguments, chunks, threads, begin)
