"""Warp on torch's streams, and both in one CUDA graph."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import torch
import warp as wp

_streams: dict[int, dict[int, wp.Stream]] = {}


def on_torch_stream(device: torch.device) -> contextlib.AbstractContextManager:
    """Warp's launches go to torch's current stream of ``device``; nobody waits for anybody."""
    return wp.ScopedStream(warp_stream(device), sync_enter=False)


def warp_stream(device: torch.device) -> wp.Stream:
    """Torch's current stream as Warp's, the same object every time.

    Warp keeps what belongs to a stream (an event, the radix sort's memory, a capture in progress) only as long as the
    object lives: a new one a launch would throw all that away each time. Torch's streams live as long as the process.
    """
    stream = torch.cuda.current_stream(device)
    of_device = _streams.setdefault(stream.device_index, {})
    if stream.cuda_stream not in of_device:
        of_device[stream.cuda_stream] = wp.stream_from_torch(stream)
    return of_device[stream.cuda_stream]


class CudaGraph:
    """What ``body`` launches, through torch and Warp alike, as one CUDA graph.

    ``body`` may not wait for the device nor copy to or from the host; tensors it makes live in the graph's own memory
    and are overwritten by every replay.
    """

    overwrites = True
    """Whether the next replay changes the result of the last."""

    def __init__(self, body: Callable[[], Any], device: torch.device) -> None:
        """Run ``body`` twice to load and compile everything it needs, then capture it.

        Raises:
            RuntimeError: something in ``body`` cannot be captured.
        """
        warming, capturing = torch.cuda.Stream(device), torch.cuda.Stream(device)
        warming.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(warming):
            for _ in range(2):
                body()
        torch.cuda.current_stream(device).wait_stream(warming)
        with torch.cuda.stream(capturing):
            warp_stream(device)  # Warp makes an event for a stream it does not know, better not during the capture
        self.graph = torch.cuda.CUDAGraph()
        with (
            torch.cuda.device(device),
            torch.cuda.graph(self.graph, stream=capturing, capture_error_mode="thread_local"),
        ):
            # Warp must know of the capture: its radix sort then takes its memory from the graph.
            capture = wp.ScopedCapture(stream=warp_stream(device), external=True)
            with capture:
                self.result = body()
        self._modules = capture.graph
        """Keeps the captured kernels' modules loaded."""

    def replay(self) -> Any:
        """Launch the graph on torch's current stream; its result's tensors are the same ones every time."""
        self.graph.replay()
        return self.result
