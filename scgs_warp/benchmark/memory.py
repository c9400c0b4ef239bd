"""Memory of a benchmark: the model's own, and what measuring takes beyond it."""

from __future__ import annotations

import contextlib
import gc
import platform
from pathlib import Path

import torch

from ..runtime import memory
from ..scene.scene import Scene

MIB = 2**20


def model_mib(scene: Scene) -> float:
    """Return the size of the Gaussians' tensors and the motion model's, which a checkpoint of the scene holds."""
    return sum(tensor.numel() * tensor.element_size() for tensor in scene.tensors().values()) / MIB


def _status(key: str) -> float | None:
    """Read a line of /proc/self/status in MiB; None outside of Linux."""
    value = memory.status(key)
    return None if value is None else value / MIB


def hand_back() -> None:
    """Return freed memory to the system (glibc would keep it), so that resident memory is memory in use."""
    gc.collect()
    memory.hand_back()


def resident_mib(device: str) -> float | None:
    """Return the memory in use: allocated by torch on CUDA, resident on a CPU; None if the system does not say."""
    hand_back()
    if device == "cuda":
        torch.cuda.synchronize()
        return torch.cuda.memory_allocated() / MIB
    return _status("VmRSS")


def reset_peak(device: str) -> None:
    """Reset the peak of :func:`peak_mib`, where the system can do that."""
    hand_back()
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        return
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_mib(device: str) -> float | None:
    """Return the peak of memory. CUDA: allocated by torch since :func:`reset_peak`; CPU on Linux: resident since then;
    other systems: resident since the process began. None if the system does not say."""
    if device == "cuda":
        return torch.cuda.max_memory_allocated() / MIB
    peak = _status("VmHWM")
    if peak is not None:
        return peak
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (MIB if platform.system() == "Darwin" else 2**10)


def extra_mib(peak: float | None, before: float | None) -> float | None:
    """Return the memory that measuring took: ``peak`` less the use ``before`` the first frame; None if unknown."""
    return None if peak is None or before is None else max(peak - before, 0.0)
