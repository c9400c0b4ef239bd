"""CUDA streams and graphs shared by torch and Warp."""

from __future__ import annotations

import contextlib
import gc
import threading
from collections.abc import Callable, Iterator
from typing import Any

import torch
import warp as wp
import warp._src.context as warp_context

_raw_stream: Callable[[int], int] | None = getattr(torch._C, "_cuda_getCurrentRawStream", None)
"""Returns the handle alone of torch's current stream of a device: making torch's stream object at each launch costs
more. None: this torch has no such function."""
_streams: dict[int, dict[int, wp.Stream]] = {}
_recording_streams: dict[int, tuple[torch.cuda.Stream, torch.cuda.Stream]] = {}
_current_stream = threading.RLock()
"""Held while Warp's current stream, one per device for all threads, is not its own: by sorts and captures."""


class GraphMemory:
    """Memory shared by recordings that never run at the same time and do not read each other's results.

    The memory of a dropped recording serves the next one, instead of staying reserved.
    """

    def __init__(self) -> None:
        self._first: CudaGraph | None = None
        """A recording of one operation: torch forgets a memory pool that no recording uses."""

    def renew(self) -> None:
        """Start anew after a failed recording, which may leave the memory in an unfinished state. Recordings that exist
        keep theirs."""
        self._first = None

    def pool(self, device: torch.device) -> Any:
        if self._first is None:
            self._first = CudaGraph(lambda: torch.zeros(1, device=device), device, warm_ups=1)
        return self._first.graph.pool()


@contextlib.contextmanager
def on_torch_stream(device: torch.device) -> Iterator[None]:
    """Send Warp's own operations to torch's current stream of ``device``, without synchronising.

    Raises:
        RuntimeError: an operation of Warp failed. Warp reports this only as a text, which stays: a second failure with
            the same text is not noticed.
    """
    # A capture holds the lock already, on another thread if this is a backward pass.
    capturing = torch.cuda.is_current_stream_capturing()
    lock = contextlib.nullcontext() if capturing else _current_stream
    with lock, wp.ScopedStream(warp_stream(device), sync_enter=False):
        before = warp_error()
        yield
        after = warp_error()
    if after and after != before:
        raise RuntimeError(f"Warp on {device}: {after}")


def warp_error() -> str:
    """Return the last error of Warp's native code, which stays until the next; empty if there was none."""
    return warp_context.runtime.get_error_string()


def warp_stream(device: torch.device) -> wp.Stream:
    """Return Warp's object for torch's current stream, the same object every time.

    Warp keeps a stream's state (an event, the radix sort's memory, a capture in progress) only as long as this object
    lives, so a new object for each launch would discard the state. Torch's streams live as long as the process.
    """
    if _raw_stream is not None and device.index is not None:
        known = _streams.get(device.index, {}).get(_raw_stream(device.index))
        if known is not None:
            return known
    stream = torch.cuda.current_stream(device)
    of_device = _streams.setdefault(stream.device_index, {})
    if stream.cuda_stream not in of_device:
        of_device[stream.cuda_stream] = wp.stream_from_torch(stream)
    return of_device[stream.cuda_stream]


def _streams_for_recording(device: torch.device) -> tuple[torch.cuda.Stream, torch.cuda.Stream]:
    """Return the streams on which graphs are warmed up and captured, the same pair for all graphs of a device: cuBLAS
    keeps a workspace for every stream that it ever saw."""
    index = torch.cuda.current_device() if device.index is None else device.index
    with _current_stream:
        if index not in _recording_streams:
            _recording_streams[index] = torch.cuda.Stream(device), torch.cuda.Stream(device)
        return _recording_streams[index]


@contextlib.contextmanager
def _captured(graph: torch.cuda.CUDAGraph, stream: torch.cuda.Stream, pool: Any) -> Iterator[None]:
    """Capture the block. Unlike ``torch.cuda.graph``, which collects garbage and empties the cache, this takes
    milliseconds; garbage is not collected within the block, because a graph that is deleted there would spoil it."""
    torch.cuda.synchronize(stream.device)
    collects = gc.isenabled()
    gc.disable()
    try:
        with torch.cuda.stream(stream):
            graph.capture_begin(**({} if pool is None else {"pool": pool}), capture_error_mode="thread_local")
            try:
                yield
            except BaseException:
                with contextlib.suppress(RuntimeError):  # it would hide the cause
                    graph.capture_end()
                raise
            graph.capture_end()
    finally:
        if collects:
            gc.enable()


class CudaGraph:
    """A CUDA graph of everything that ``body`` launches through torch and Warp.

    ``body`` must neither wait for the device nor copy to or from the host. The tensors that it allocates are in the
    graph's own memory and are overwritten by every replay.
    """

    overwrites = True
    """Flag that a replay overwrites the previous result, always True here."""

    def __init__(
        self, body: Callable[[], Any], device: torch.device, *, warm_ups: int = 2, memory: GraphMemory | None = None
    ) -> None:
        """Run ``body`` to load and compile its kernels, then capture it.

        Args:
            warm_ups: number of runs before the capture.
            memory: shared with other recordings. None: the recording's own.

        Raises:
            RuntimeError: ``body`` cannot be captured.
        """
        warming, capturing = _streams_for_recording(device)
        warming.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(warming):
            for _ in range(warm_ups):
                body()
        torch.cuda.current_stream(device).wait_stream(warming)
        with torch.cuda.stream(capturing):
            warp_stream(device)  # Warp makes an event for a new stream, which a capture does not allow
        self.graph = torch.cuda.CUDAGraph()
        pool = None if memory is None else memory.pool(device)
        with _current_stream, torch.cuda.device(device), _captured(self.graph, capturing, pool):
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


class PlainGraph:
    """Stand-in for a ``CudaGraph`` on a CPU: it runs ``body`` at every replay."""

    overwrites = False

    def __init__(self, body: Callable[[], Any]) -> None:
        self.replay = body
