"""Replacements for torch's Python interface to CUDA, and graphs that repeat a recorded list of operations."""

from __future__ import annotations

import contextlib
import ctypes
import threading
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import torch

from . import ledger

DEVICE = torch.device("cuda:0")
TOTAL_MEMORY = 140 << 30
_CALL = ctypes.CFUNCTYPE(None, ctypes.c_int)


class Stream:
    """Everything happens at once, in order."""

    device_index, device = 0, DEVICE
    _next = 0

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.cuda_stream = Stream._next
        Stream._next += 1

    def wait_stream(self, stream: Stream) -> None: ...
    def wait_event(self, event: Event) -> None: ...
    def record_event(self, event: Event | None = None) -> Event:
        return event or Event()

    def synchronize(self) -> None:
        ledger.contact("stream.synchronize")

    def query(self) -> bool:
        return True


class Event:
    def __init__(self, *args: Any, **kwargs: Any) -> None: ...
    def record(self, stream: Stream | None = None) -> None: ...
    def wait(self, stream: Stream | None = None) -> None: ...
    def synchronize(self) -> None:
        ledger.contact("event.synchronize")

    def query(self) -> bool:
        return True

    def elapsed_time(self, end: Event) -> float:
        return 1.0


class Graph:
    """``torch.cuda.CUDAGraph``: the operations and launches of a capture, with their memory and numbers."""

    library: ctypes.CDLL

    def __init__(self) -> None:
        self._handle: int | None = None
        self._calls: list[Callable[[], None]] = []
        self._repeat = _CALL(lambda number: self._calls[number]())

    def capture_begin(self, *args: Any, **kwargs: Any) -> None:
        self._handle = self.library.pretended_graph_begin()
        if not self._handle:
            raise RuntimeError("CUDA error: operation not permitted when stream is capturing (a second capture)")
        Graph.capturing, Graph.thread = self, threading.get_ident()

    def capture_end(self) -> None:
        Graph.capturing = None
        self.library.pretended_graph_end()

    capturing: Graph | None = None
    thread = 0
    """The thread that captures."""

    def record(self, call: Callable[[], None]) -> None:
        """Add a launch, which holds all that it needs."""
        self.library.pretended_graph_call(len(self._calls))
        self._calls.append(call)

    def replay(self) -> None:
        ledger.count_launch("graph")
        if self.library.pretended_graph_replay(self._handle, self._repeat):
            raise RuntimeError(self.library.pretended_error().decode())

    def pool(self) -> tuple[int, int]:
        return 0, 1

    def __len__(self) -> int:
        return self.library.pretended_graph_size(self._handle) if self._handle else 0

    def reset(self) -> None:
        if self._handle:
            self.library.pretended_graph_free(self._handle)
        self._handle, self._calls = None, []

    def __del__(self) -> None:
        self.reset()


@contextlib.contextmanager
def graph(recorded: Graph, *args: Any, **kwargs: Any) -> Iterator[None]:
    """``torch.cuda.graph``."""
    torch.cuda.synchronize()
    recorded.capture_begin()
    try:
        yield
    finally:
        recorded.capture_end()


def install(library: ctypes.CDLL) -> None:
    """Replace the functions of ``torch.cuda`` that need a driver."""
    for name in ("begin", "free", "replay", "size", "call", "end"):
        getattr(library, f"pretended_graph_{name}").restype = ctypes.c_long
    library.pretended_graph_begin.restype = ctypes.c_void_p
    library.pretended_graph_free.argtypes = library.pretended_graph_size.argtypes = [ctypes.c_void_p]
    library.pretended_graph_replay.argtypes = [ctypes.c_void_p, _CALL]
    library.pretended_error.restype = ctypes.c_char_p
    library.pretended_allocated.restype = library.pretended_most.restype = ctypes.c_long
    Graph.library = library
    cuda, streams = torch.cuda, [Stream()]

    @contextlib.contextmanager
    def on_stream(stream: Stream | None) -> Iterator[None]:
        streams.append(stream or streams[-1])
        try:
            yield
        finally:
            streams.pop()

    def capturing_here() -> bool:
        # Autograd's threads, which Python has not started, work on the stream of the thread that waits for them.
        started = not isinstance(threading.current_thread(), threading._DummyThread)
        return bool(library.pretended_capturing()) and (not started or threading.get_ident() == Graph.thread)

    def free_and_total(device: Any = None) -> tuple[int, int]:
        return TOTAL_MEMORY - library.pretended_allocated(), TOTAL_MEMORY

    properties = SimpleNamespace(
        name="pretended", total_memory=TOTAL_MEMORY, multi_processor_count=132, major=9, minor=0
    )
    replaced: dict[str, Any] = {
        "_lazy_init": lambda: None,
        "is_initialized": lambda: True,
        "is_available": lambda: True,
        "device_count": lambda: 1,
        "current_device": lambda: 0,
        "set_device": lambda device: None,
        "device": lambda device: contextlib.nullcontext(),
        "current_stream": lambda device=None: streams[-1],
        "default_stream": lambda device=None: streams[0],
        "stream": on_stream,
        "Stream": Stream,
        "Event": Event,
        "CUDAGraph": Graph,
        "graph": graph,
        "synchronize": lambda device=None: ledger.contact("synchronize"),
        "is_current_stream_capturing": capturing_here,
        "mem_get_info": free_and_total,
        "memory_allocated": lambda device=None: library.pretended_allocated(),
        "memory_reserved": lambda device=None: library.pretended_allocated(),
        "max_memory_allocated": lambda device=None: library.pretended_most(),
        "reset_peak_memory_stats": lambda device=None: library.pretended_reset_most(),
        "empty_cache": lambda: None,
        "get_device_name": lambda device=None: "pretended",
        "get_device_properties": lambda device=None: properties,
        "get_device_capability": lambda device=None: (9, 0),
        "manual_seed": lambda seed: None,
        "manual_seed_all": lambda seed: None,
    }
    for name, value in replaced.items():
        setattr(cuda, name, value)
