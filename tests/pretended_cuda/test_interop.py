"""Streams, captures and errors that torch and Warp share."""

from __future__ import annotations

import threading

import pytest
import torch

from scgs_warp.ops import radix
from scgs_warp.runtime import cuda_graph
from scgs_warp.runtime.cuda_graph import CudaGraph, on_torch_stream

CUDA = torch.device("cuda:0")


def test_a_sort_that_fails_raises(monkeypatch):
    """Warp's sort returns nothing; its errors are a text that stays."""
    texts = iter(["an old error", "an old error", "an old error", "Warp CUDA error 2: out of memory"])
    monkeypatch.setattr(cuda_graph, "warp_error", lambda: next(texts))
    keys, values = (torch.zeros(8, dtype=torch.int32, device=CUDA) for _ in range(2))
    radix.radix_sort(keys, values, 4, 32)
    with pytest.raises(RuntimeError, match=r"cuda:0: Warp CUDA error 2: out of memory"):
        radix.radix_sort(keys, values, 4, 32)


def test_no_sort_enters_the_capture_of_another_thread():
    """Warp's current stream belongs to the device, not to the thread."""
    value, order = torch.ones(3, device=CUDA), []
    began = threading.Event()

    def sort() -> None:
        began.wait()
        with on_torch_stream(CUDA):
            order.append("sort")

    def body() -> torch.Tensor:
        if torch.cuda.is_current_stream_capturing():
            began.set()
            other.join(0.2)
            order.append("captured")
        return value + 1

    other = threading.Thread(target=sort)
    other.start()
    CudaGraph(body, CUDA)
    other.join()
    assert order == ["captured", "sort"]


def test_all_graphs_share_one_pair_of_streams(monkeypatch):
    CudaGraph(lambda: torch.ones(3, device=CUDA), CUDA)
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: pytest.fail("a new stream"))
    CudaGraph(lambda: torch.ones(4, device=CUDA), CUDA)


def test_a_failed_capture_tells_the_cause(monkeypatch):
    """CUDA then refuses the end of the capture as well."""

    def body() -> None:
        if torch.cuda.is_current_stream_capturing():
            raise RuntimeError("the cause")

    end = torch.cuda.CUDAGraph.capture_end

    def refuse(graph: torch.cuda.CUDAGraph) -> None:
        end(graph)
        raise RuntimeError("CUDA error: operation failed due to a previous error during capture")

    monkeypatch.setattr(torch.cuda.CUDAGraph, "capture_end", refuse)
    with pytest.raises(RuntimeError, match="the cause"):
        CudaGraph(body, CUDA)
    with pytest.raises(RuntimeError, match="previous error"):
        CudaGraph(lambda: None, CUDA)
