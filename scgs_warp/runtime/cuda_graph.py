"""CUDA streams and graphs shared by torch and Warp."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import torch
import warp as wp

_streams: dict[int, dict[int, wp.Stream]] = {}


def on_torch_stream(device: torch.device) -> contextlib.AbstractContextManager:
    """Send Warp's launches to torch's current stream of ``device``, without synchronising."""
    return wp.ScopedStream(warp_stream(device), sync_enter=False)


def warp_stream(device: torch.device) -> wp.Stream:
    """Return Warp's object for torch's current stream, the same object every time.

    Warp keeps a stream's state (an event, the radix sort's memory, a capture in progress) only as long as this object
    lives, so a new object for each launch would discard the state. Torch's streams live as long as the process.
    """
    stream = torch.cuda.current_stream(device)
    of_device = _streams.setdefault(stream.device_index, {})
    if stream.cuda_stream not in of_device:
        of_device[stream.cuda_stream] = wp.stream_from_torch(stream)
    return of_device[stream.cuda_stream]


class CudaGraph:
    """A CUDA graph of everything that ``body`` launches through torch and Warp.

    ``body`` must neither wait for the device nor copy to or from the host. The tensors that it allocates are in the
    graph's own memory and are overwritten by every replay.
    """

    overwrites = True
    """Flag that a replay overwrites the previous result, always True here."""

    def __init__(self, body: Callable[[], Any], device: torch.device) -> None:
        """Run ``body`` twice to load and compile its kernels, then capture it.

        Raises:
            RuntimeError: ``body`` cannot be captured.
        """
        warming, capturing = torch.cuda.Stream(device), torch.cuda.Stream(device)
        warming.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(warming):
            for _ in range(2):
                body()
        torch.cuda.current_stream(device).wait_stream(warming)
        with torch.cuda.stream(capturing):
            warp_stream(device)  # Warp makes an event for a new stream, which a capture does not allow
        self.graph = torch.cuda.CUDAGraph()
        with (
            torch.cuda.device(device),
            torch.cuda.graph(self.graph, stream=capturing, capture_error_mode="thread_local"),
        ):
            # Warp must know of the capture, so that its radix sort takes its memory from the graph.
            capture = wp.ScopedCapture(stream=warp_stream(device), external=True)
            with capture:
                self.result = body()
        self._modules = capture.graph
        """Warp's graph, which keeps the modules of the captured kernels loaded."""

    def replay(self) -> Any:
        """Launch the graph on torch's current stream and return its result, the same tensors every time."""
        self.graph.replay()
        return self.result
