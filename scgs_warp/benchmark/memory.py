"""Memory of a benchmark: what a model holds, and what measuring it takes on top."""

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
    """The Gaussians' own tensors and those of the motion model: what a checkpoint of the scene holds."""
    return sum(tensor.numel() * tensor.element_size() for tensor in scene.tensors().values()) / MIB


def _status(key: str) -> float | None:
    """A line of /proc/self/status in MiB; None where there is none (outside Linux)."""
    found = memory.status(key)
    return None if found is None else found / MIB


def hand_back() -> None:
    """Freed memory goes back to the system, so that what is resident is what is used (glibc keeps it otherwise)."""
    gc.collect()
    memory.hand_back()


def resident_mib(device: str) -> float | None:
    """In use now: allocated by torch on CUDA, resident on a CPU; None where the system does not say."""
    hand_back()
    if device == "cuda":
        torch.cuda.synchronize()
        return torch.cuda.memory_allocated() / MIB
    return _status("VmRSS")


def reset_peak(device: str) -> None:
    """From here on :func:`peak_mib` counts anew, where the system can do that."""
    hand_back()
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        return
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")


def peak_mib(device: str) -> float | None:
    """Most memory since :func:`reset_peak` (CUDA: what torch allocated; Linux: resident) or since the process began
    (elsewhere: resident); None where the system does not say."""
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
    """What measuring took beyond what was there ``before`` the first frame; None where either is unknown."""
    return None if peak is None or before is None else max(peak - before, 0.0)
