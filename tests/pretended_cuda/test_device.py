"""The pretended device refuses, counts, records and replays as a GPU would."""

from __future__ import annotations

import threading

import pytest
import torch

from pretended_cuda import ledger
from pretended_cuda.torch_device import Graph
from scgs_warp.ops.adam import first_not_finite_by_norm
from scgs_warp.ops.neighbors import nearest
from scgs_warp.runtime import environment
from scgs_warp.runtime.cuda_graph import CudaGraph

CUDA = torch.device("cuda:0")


@pytest.fixture
def device() -> torch.device:
    return CUDA


def test_tensors_of_two_devices_do_not_mix(device):
    ours, theirs = torch.ones(3, device=device), torch.ones(3)
    with pytest.raises(RuntimeError, match="same device"):
        ours + theirs
    with pytest.raises(RuntimeError, match="same device"):
        torch.cat([ours, theirs])
    assert (ours + torch.tensor(2.0)).tolist() == [3.0, 3.0, 3.0]  # a number is no tensor of a device
    with pytest.raises(TypeError, match="cuda:0"):
        ours.numpy()


def test_an_infinity_norm_of_an_empty_tensor_is_refused(device):
    tensors = [torch.ones(3, device=device), torch.empty(0, device=device)]
    with pytest.raises(RuntimeError, match="infinity norm on an empty tensor"):
        torch.nn.utils.get_total_norm(tensors, float("inf"))
    assert first_not_finite_by_norm(tensors) is None


def test_a_generator_belongs_to_a_device(device):
    torch.randn(3, device=device, generator=torch.Generator(device).manual_seed(0))
    with pytest.raises(RuntimeError, match="generator"):
        torch.randn(3, device=device, generator=torch.Generator().manual_seed(0))


def test_products_round_alike_on_any_number_of_threads(device, all_threads):
    gradients, inputs = torch.randn(600, 13, device=device), torch.randn(600, 16, device=device)
    results = []
    for threads in (1, 2, 3):
        environment.configure(threads)
        results.append(gradients.T @ inputs)
    assert results[0].equal(results[1]) and results[0].equal(results[2])


def test_new_memory_is_not_zero(device):
    assert torch.empty(5, device=device).isnan().all()
    assert torch.zeros(5, device=device).sum() == 0


def test_contacts_are_counted_with_their_line(device):
    value = torch.tensor([1.0, 0.0], device=device)
    with ledger.counted() as counts:
        first_not_finite_by_norm([value])
        value.nonzero()
    assert [(kind, line.split(":")[0]) for kind, line in counts.contacts] == [
        ("_local_scalar_dense", "scgs_warp/ops/adam.py"),
        ("nonzero", "elsewhere"),
    ]
    with ledger.counted() as counts:
        value.add_(1).mul_(2)
        value.view(1, 2)
    assert not counts.contacts and dict(counts.operations) == {"add": 1, "mul": 1}


@pytest.mark.parametrize(("pinned", "waits"), [(False, 1), (True, 0)])
def test_only_copies_from_pinned_memory_do_not_wait(device, pinned, waits):
    value = torch.ones(3).pin_memory() if pinned else torch.ones(3)
    with ledger.counted() as counts:
        value.to(device, non_blocking=True)
    assert sum(counts.contacts.values()) == waits
    with ledger.counted() as counts:
        value.to(device)
    assert sum(counts.contacts.values()) == 1


def test_launches_are_counted(device):
    points = torch.rand(10, 3, device=device)
    with ledger.counted() as counts:
        nearest(points, points, 3)[1]
    assert sum(counts.launches.values()) >= 1


def test_autograd_runs_on_a_thread_of_the_device(device):
    seen = []

    class Note(torch.autograd.Function):
        @staticmethod
        def forward(ctx, value):
            return value.clone()

        @staticmethod
        def backward(ctx, *gradients):
            seen.append(threading.get_ident())
            return gradients[0]

    Note.apply(torch.ones(3, device=device, requires_grad=True)).sum().backward()
    assert seen and seen[0] != threading.get_ident()


@pytest.mark.parametrize(
    "touch",
    [
        lambda value: value.sum().item(),
        lambda value: value.cpu(),
        lambda value: value.add_(torch.ones(3).to(value.device)),
        lambda value: value[value > 0],
        lambda value: torch.cuda.synchronize(),
        lambda value: torch.cuda.current_stream().synchronize(),
    ],
    ids=["item", "copy out", "copy in", "mask", "synchronize", "stream"],
)
def test_a_capture_forbids_contact(device, touch):
    value = torch.ones(3, device=device)
    with pytest.raises(RuntimeError, match="not permitted when stream is capturing"), torch.cuda.graph(Graph()):
        touch(value)
    assert not torch.cuda.is_current_stream_capturing()


def test_a_replay_repeats_operations_but_no_python(device):
    inputs, bodies = torch.tensor([1.0, 2.0], device=device), []

    def body():
        bodies.append(len(bodies))
        kept = inputs.clone()
        kept[1:].mul_(3)
        return kept + bodies[-1], torch.cumsum(kept, 0, out=torch.empty(0, device=device))

    graph = CudaGraph(body, CUDA)
    assert bodies == [0, 1, 2]
    inputs.copy_(torch.tensor([10.0, 20.0]))
    first, sums = graph.replay()
    assert bodies == [0, 1, 2], "Python does not run again"
    assert first.tolist() == [12.0, 62.0], "the number of the capture stays: a stale value shows"
    assert sums.tolist() == [10.0, 70.0]
    assert graph.replay()[0] is first


def test_a_replay_repeats_launches(device):
    points = torch.rand(20, 3, device=device)
    graph = CudaGraph(lambda: nearest(points, points, 3)[1], CUDA)
    points.copy_(torch.rand(20, 3, generator=torch.Generator().manual_seed(4)))
    torch.testing.assert_close(graph.replay().clone(), nearest(points, points, 3)[1], rtol=0, atol=0)


def test_one_capture_at_a_time(device):
    with torch.cuda.graph(Graph()), pytest.raises(RuntimeError, match="second capture"):
        Graph().capture_begin()
