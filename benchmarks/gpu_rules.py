"""Timings in ``gpu_check``, and the rules by which two results agree."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from scgs_warp.runtime.cuda_graph import CudaGraph
from scgs_warp.scene.frame_graph import FrameGraph
from scgs_warp.scene.scene import Scene
from scgs_warp.types import Camera

PIXEL_TOLERANCE = 1e-4
LARGEST_DIFFERENCE = 8e-3
"""Largest allowed difference of a pixel. A splat with an alpha of about 1/255 may be drawn by one renderer and skipped
by the other, which moves the pixel by up to 1/255; two such splats are allowed."""
GRADIENT_TOLERANCE = 1e-2


def time_of(function: Callable[[], Any], device: str, repeats: int) -> dict[str, float]:
    """Time calls of ``function`` in milliseconds, after three calls to warm up.

    Returns:
        ``ms_median`` and ``ms_min`` of calls that are waited for one by one; ``ms_in_a_row``, the mean of calls without
        waiting between them.
    """
    wait = torch.cuda.synchronize if device == "cuda" else lambda: None
    for _ in range(3):
        function()
    times = []
    for _ in range(repeats):
        wait()
        start = time.perf_counter()
        function()
        wait()
        times.append(1e3 * (time.perf_counter() - start))
    start = time.perf_counter()
    for _ in range(repeats):
        function()
    wait()
    in_a_row = 1e3 * (time.perf_counter() - start) / repeats
    return {"ms_median": statistics.median(times), "ms_min": min(times), "ms_in_a_row": in_a_row}


def compare_images(a: Tensor, b: Tensor) -> dict[str, Any]:
    """Compare images: 99.9 % of pixels within the tolerance, none beyond ``LARGEST_DIFFERENCE``."""
    difference = (a.detach().cpu() - b.detach().cpu()).abs().amax(0)
    within = float((difference <= PIXEL_TOLERANCE).double().mean())
    largest = float(difference.max())
    passed = within >= 0.999 and largest <= LARGEST_DIFFERENCE
    return {"pixels_within_1e-4": within, "largest_difference": largest, "passed": passed}


def compare_gradients(ours: Tensor, theirs: Tensor) -> dict[str, Any]:
    """Compare gradients by each Gaussian's L2 error, relative to the Gaussian's norm or 1e-6 of the whole tensor's."""
    a, b = (t.detach().cpu().double().reshape(len(t), -1) for t in (ours, theirs))
    error = (a - b).norm(dim=1) / torch.maximum(b.norm(dim=1), 1e-6 * b.norm())
    p99 = float(error.kthvalue(max(1, int(0.99 * len(error)))).values)
    return {"median": float(error.median()), "p99": p99, "passed": p99 <= GRADIENT_TOLERANCE}


def motion_ms(scene: Scene, device: str, repeats: int) -> float:
    """Return the milliseconds for posing all Gaussians, from a recorded graph if possible."""
    at = torch.full((1,), 0.4, device=scene.device)

    @torch.no_grad()
    def pose() -> Any:
        return scene.motion.gaussians_at(scene.gaussians, at if scene.motion.takes_time_tensor else 0.4)

    recorded = device == "cuda" and scene.motion.takes_time_tensor
    call = CudaGraph(pose, scene.device).replay if recorded else pose
    return time_of(call, device, repeats)["ms_in_a_row"]


def two_under_way(graph: FrameGraph, scene: Scene, camera: Camera, repeats: int) -> float:
    """Return milliseconds per frame if each frame is submitted before the previous one is finished."""
    view, color = scene.normalisation.apply_camera(camera), torch.tensor(scene.background_color)
    start, last = time.perf_counter(), graph.submit(view, 0.1, color)
    for index in range(repeats):
        following = graph.submit(view, (0.37 * index) % 1.0, color)
        graph.finish(last)
        last = following
    graph.finish(last)
    return 1e3 * (time.perf_counter() - start) / (repeats + 1)
