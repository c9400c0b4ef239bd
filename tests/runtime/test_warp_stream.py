"""Warp's object for torch's current stream: one for each stream, found by the stream's handle."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from scgs_warp.runtime import cuda_graph

DEVICE = torch.device("cuda:1")


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Pretend that torch's current stream of the device is the one whose handle is the last of the list."""
    handles = [5]
    stream = lambda device: SimpleNamespace(device_index=1, cuda_stream=handles[-1])  # noqa: E731
    monkeypatch.setattr(torch.cuda, "current_stream", stream)
    monkeypatch.setattr(cuda_graph.wp, "stream_from_torch", lambda stream: object())
    monkeypatch.setattr(cuda_graph, "_streams", {})
    return handles


@pytest.mark.parametrize("raw", [True, False])
def test_the_same_object_for_the_same_stream(raw: bool, made: list[int], monkeypatch: pytest.MonkeyPatch):
    asked: list[int] = []

    def handle(index: int) -> int:
        asked.append(index)
        return made[-1]

    monkeypatch.setattr(cuda_graph, "_raw_stream", handle if raw else None)
    first = cuda_graph.warp_stream(DEVICE)
    assert cuda_graph.warp_stream(DEVICE) is first
    made.append(6)
    second = cuda_graph.warp_stream(DEVICE)
    assert second is not first and cuda_graph.warp_stream(DEVICE) is second
    made.append(5)
    assert cuda_graph.warp_stream(DEVICE) is first
    assert set(asked) == ({1} if raw else set())


def test_a_known_stream_costs_no_object_of_torch(made: list[int], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cuda_graph, "_raw_stream", lambda index: made[-1])
    known = cuda_graph.warp_stream(DEVICE)
    monkeypatch.setattr(torch.cuda, "current_stream", None)
    assert cuda_graph.warp_stream(DEVICE) is known
