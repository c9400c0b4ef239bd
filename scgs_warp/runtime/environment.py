"""Process-wide settings: OpenMP's waiting policy, thread counts, denormals, Warp's start."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import gc
import math
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from ..errors import UserError

_threads: int | None = None
_configured = False
_torch_spins = False
"""True if torch was imported before this package, so that its OpenMP threads spin between torch calls."""
_shares_grids = False
"""True once several threads share the grids of kernels."""


def prepare_environment() -> None:
    """Set environment variables that torch reads when it is imported; values set by the user take precedence.

    OpenMP threads sleep instead of spinning between torch calls, because kernels use those cores meanwhile. cuBLAS gets
    a workspace of fixed size, which makes its sums reproducible. MKL is set to a mode whose results do not depend on
    the number of threads; otherwise the gradient of a layer narrower than 64 would. On processors of other makers than
    Intel MKL ignores that mode; there the project's own kernels, which run the networks on the CPU, keep the promise.

    If torch is loaded already, its OpenMP has chosen to spin; see :func:`quiet_torch`.
    """
    global _torch_spins
    _torch_spins = _torch_spins or ("torch" in sys.modules and "OMP_WAIT_POLICY" not in os.environ)
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("KMP_BLOCKTIME", "0")
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    os.environ.setdefault("MKL_CBWR", "AUTO,STRICT")


def init_warp() -> None:
    """Initialise Warp without its banner, and without the CUDA driver's message on a machine that has no GPU.

    Raises:
        UserError: there is no folder for compiled kernels.
    """
    import warp as wp

    from .kernel_cache import initialise_warp

    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    driver = os.path.exists("/dev/nvidiactl") or os.name != "posix"
    initialise_warp(wp.init if driver else _init_silently)


def _init_silently() -> None:
    import warp as wp

    try:
        saved = os.dup(2)
    except OSError:  # a daemon's standard error may be closed
        wp.init()
        return
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)  # the driver's message comes from C
        wp.init()
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(sink)


def warp_finds_gpu() -> bool:
    """Return whether Warp, which has its own requirements on the driver, lists a CUDA device."""
    import warp as wp

    init_warp()
    return wp.is_cuda_available()


def check_device(device: str) -> None:
    """Check the name of a device, and that it is there.

    Raises:
        UserError: names the argument and the remedy.
    """
    import torch

    try:
        kind = torch.device(device).type
    except (RuntimeError, TypeError):
        kind = ""
    if kind not in ("cpu", "cuda"):
        raise UserError(f"device is {device!r}; choose cpu or cuda")
    if kind == "cuda" and not torch.cuda.is_available():
        raise UserError(f"device is {str(device)!r}, but torch finds no CUDA GPU here; choose cpu")


def available_threads() -> int:
    """Count the cores that this process may use, limited by its affinity and a container's share of processor time."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, math.ceil(min(cores, container_quota())))


@functools.cache
def container_quota(folder: str = "/sys/fs/cgroup") -> float:
    """Return the control group's limit on processor time, in processors (Linux); infinite without a limit."""
    for names in (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")):  # version 2, version 1
        try:
            words = " ".join(Path(folder, name).read_text(encoding="ascii") for name in names).split()
            quota, period = float(words[0]), float(words[1])
        except (OSError, ValueError, IndexError):  # not Linux, no limit ("max"), or another layout
            continue
        if quota > 0.0 and period > 0.0:
            return quota / period
    return math.inf


def thread_count() -> int:
    """Return the number of threads that kernel launches and torch use on the CPU."""
    return _threads or available_threads()


def configured() -> bool:
    """Return whether :func:`configure` was called; if so, helper threads flush denormals as the main thread does."""
    return _configured


def ensure_configured() -> None:
    """Call :func:`configure` with its defaults, unless it was called before, and flush denormals in this thread, too:
    one that began earlier does not, and would round unlike its helpers."""
    if not _configured:
        configure()
    import torch

    torch.set_flush_denormal(True)


def _keep_freed_memory() -> None:
    """Ask glibc to keep freed buffers instead of returning them to the system.

    Every step allocates buffers of the same sizes again, and faulting in their pages would take a quarter of the
    compositing time."""
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):  # not glibc
        return
    trim_threshold, mmap_threshold = -1, -3
    if not mallopt(mmap_threshold, 1 << 30):  # older glibc: 32 MiB at most
        mallopt(mmap_threshold, 32 << 20)
    mallopt(trim_threshold, 1 << 30)


def configure(threads: int | None = None) -> None:
    """Set the number of CPU threads for Warp and torch, flush denormals to zero, choose deterministic algorithms.

    Call it before the first tensor operation: OpenMP's workers inherit the flush-to-zero mode from the thread that
    starts them. Denormals can make training steps 20 times slower.

    Args:
        threads: number of CPU threads. None: all available ones.

    Raises:
        NotEnoughMemory: the limit of addresses (``ulimit -v``) leaves too little to work with.
    """
    global _threads, _configured
    import numpy as np
    import torch

    from . import addresses

    addresses.prepare()
    for dtype in (np.float32, np.float64):
        np.finfo(dtype)  # asked before flushing: older versions of NumPy warn of missing denormals
    _threads, _configured = threads, True
    _keep_freed_memory()
    torch.set_flush_denormal(True)
    torch.set_num_threads(thread_count())
    if _shares_grids:
        quiet_torch()
    torch.set_deterministic_debug_mode("warn")  # use_deterministic_algorithms would import the compiler, for a second
    # This switch would make torch.empty fill every buffer with NaN; the kernels write all they allocate.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]


def quiet_torch() -> None:
    """Give torch's own operations a single thread if its threads spin between them: called before several threads share
    the grids of kernels, which need the same cores."""
    global _shares_grids
    import torch

    _shares_grids = True
    if _torch_spins:
        torch.set_num_threads(1)


@contextlib.contextmanager
def no_collection() -> Iterator[None]:
    """Collect no garbage meanwhile: imports make many objects and no garbage, and a collection would be timed."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


@contextlib.contextmanager
def one_piece() -> Iterator[None]:
    """Run torch's exp, sigmoid, sine and the like in one thread, so that results do not depend on the thread count.

    Torch cuts large tensors into one piece per thread and computes the last elements of each piece with different
    instructions, which round differently. At the sizes in use, one thread is fast enough.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
