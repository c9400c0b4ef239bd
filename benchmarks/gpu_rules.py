"""Targets of ``gpu_check``, the rules by which two results agree, and timings."""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

FRAMES_A_SECOND = 1500.0
"""Least number of frames per second of the moving scene."""
MOTION_MS = 0.15
"""Most milliseconds for the motion of a frame."""
GSPLAT_RATIO = 1.5
"""Least ratio of gsplat's time to ours, forward and with gradients, at every size."""
TRAINING_SECONDS = 300.0
"""Most seconds of training with the longest presets."""
PIXEL_TOLERANCE = 1e-4
WITHIN = 0.999
"""Least share of pixels within the tolerance."""
LARGEST_DIFFERENCE = 8e-3
"""Largest allowed difference of a pixel. A splat with an alpha of about 1/255 may be drawn by one renderer and skipped
by the other, which moves the pixel by up to 1/255; two such splats are allowed."""
GRADIENT_TOLERANCE = 1e-2
WARM_UP = 3


def at_least(figure: float, goal: float) -> dict[str, Any]:
    return {"figure": figure, "least": goal, "met": bool(figure >= goal)}


def at_most(figure: float, goal: float) -> dict[str, Any]:
    return {"figure": figure, "most": goal, "met": bool(figure <= goal)}


def compare_images(a: Tensor, b: Tensor) -> dict[str, Any]:
    """Compare images [C, H, W]: ``WITHIN`` of the pixels agree within the tolerance, and none differs by more than
    ``LARGEST_DIFFERENCE``."""
    difference = (a.detach().cpu() - b.detach().cpu()).abs().amax(0)
    within = float((difference <= PIXEL_TOLERANCE).double().mean())
    largest = float(difference.max())
    passed = within >= WITHIN and largest <= LARGEST_DIFFERENCE
    return {"pixels_within_1e-4": within, "largest_difference": largest, "passed": passed}


def compare_gradients(ours: Tensor, theirs: Tensor) -> dict[str, Any]:
    """Compare gradients by each Gaussian's L2 error, relative to the Gaussian's norm or 1e-6 of the whole tensor's."""
    a, b = (t.detach().cpu().double().reshape(len(t), -1) for t in (ours, theirs))
    error = (a - b).norm(dim=1) / torch.maximum(b.norm(dim=1), 1e-6 * b.norm())
    p99 = float(error.kthvalue(max(1, int(0.99 * len(error)))).values)
    return {"median": float(error.median()), "p99": p99, "passed": p99 <= GRADIENT_TOLERANCE}


def wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def laps(calls: list[Callable[[], Any]], device: str) -> list[float]:
    """Return the milliseconds of calls that are made one after the other; on a GPU the host waits only at the end."""
    if device != "cuda":
        times = [time.perf_counter()]
        for call in calls:
            call()
            times.append(time.perf_counter())
        return [1e3 * (b - a) for a, b in itertools.pairwise(times)]
    events = [torch.cuda.Event(enable_timing=True) for _ in range(len(calls) + 1)]
    wait(device)
    events[0].record()
    for call, event in zip(calls, events[1:]):
        call()
        event.record()
    events[-1].synchronize()
    return [a.elapsed_time(b) for a, b in itertools.pairwise(events)]


def alternate(functions: Mapping[str, Callable[[], Any]], device: str, repeats: int) -> dict[str, dict[str, float]]:
    """Time several functions in turns, without waiting between the calls.

    Returns:
        For each function, ``ms_median``, ``ms_min`` and ``ms_mean`` of its calls after the warm-up.
    """
    calls = list(functions.values())
    laps(calls * min(WARM_UP, repeats), device)
    times = laps(calls * repeats, device)
    return {name: _summary(times[index :: len(calls)]) for index, name in enumerate(functions)}


def _summary(times: list[float]) -> dict[str, float]:
    return {"ms_median": statistics.median(times), "ms_min": min(times), "ms_mean": statistics.fmean(times)}


def time_of(function: Callable[[], Any], device: str, repeats: int) -> dict[str, float]:
    """Time calls of ``function`` in milliseconds.

    Returns:
        ``ms_median`` and ``ms_min`` of calls that are waited for one by one; ``ms_in_a_row``, the median of calls
        without waiting between them.
    """
    in_a_row = alternate({"": function}, device, repeats)[""]["ms_median"]
    times = []
    for _ in range(repeats):
        wait(device)
        start = time.perf_counter()
        function()
        wait(device)
        times.append(1e3 * (time.perf_counter() - start))
    return {"ms_median": statistics.median(times), "ms_min": min(times), "ms_in_a_row": in_a_row}
