"""Launches: arguments are checked and arrive, every grid index runs once, whoever runs it."""

from __future__ import annotations

import os
import threading
import time

import numpy as np
import pytest
import torch
import warp as wp

from helpers.python_kernel import PythonKernel, single_chunks
from scgs_warp.runtime import cpu_threads, environment
from scgs_warp.runtime.cpu_threads import Chunks, cut_by_load, cut_evenly, share
from scgs_warp.runtime.launch import launch


@wp.struct
class Pair:
    a: wp.int64
    b: float


@wp.kernel(enable_backward=False)
def mixed(
    first: int,
    flag: bool,
    values: wp.array[wp.vec3],
    nothing: wp.array[float],
    scale: float,
    corner: wp.vec2i,
    pair: Pair,
    big: wp.uint64,
    small: wp.uint8,
    out: wp.array2d[float],
):
    i = first + wp.tid()
    total = scale * values[i][2] + float(corner[1]) + float(pair.a) + pair.b + float(small)
    if flag and nothing.shape[0] == 0 and big == wp.uint64(1) << wp.uint64(63):
        total += 1000.0
    out[i, 0] = out[i, 0] + total


def mixed_arguments(count: int) -> list:
    pair = Pair()
    pair.a, pair.b = 7, 0.5
    values = torch.arange(3.0 * count).view(count, 3)
    return [True, values, None, 2.0, wp.vec2i(3, 4), pair, 2**63, 200, torch.zeros(count, 2)]


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("count", [1, 2, 37, 1000])
def test_every_kind_of_argument_arrives_once(all_threads: None, threads: int, count: int):
    environment.configure(threads=threads)
    arguments = mixed_arguments(count)
    expected = 2.0 * arguments[1][:, 2] + 4.0 + 7.0 + 0.5 + 200.0 + 1000.0
    for load in (None, torch.arange(count) ** 2):
        arguments[-1].zero_()
        launch(mixed, count, *arguments, grain=1, load=load)
        assert torch.equal(arguments[-1][:, 0], expected)
        assert not arguments[-1][:, 1].any()


@pytest.mark.parametrize(
    ("place", "value", "error", "message"),
    [
        (1, torch.zeros(4, 2), ValueError, "values must be contiguous"),
        (1, torch.zeros(4, 3, dtype=torch.float64), ValueError, "values must be contiguous"),
        (1, torch.zeros(4, 6)[:, ::2], ValueError, "values must be contiguous"),
        (1, torch.zeros(4, 3, device="meta"), ValueError, "values is on meta"),
        (3, torch.zeros(1), TypeError, "no array"),
        (3, "two", TypeError, "mixed"),
    ],
)
def test_wrong_arguments_are_named(place: int, value: object, error: type[Exception], message: str):
    arguments = mixed_arguments(4)
    launch(mixed, 4, *arguments)  # known shapes must not hide what else is wrong
    arguments[place] = value
    with pytest.raises(error, match=message):
        launch(mixed, 4, *arguments)
    with pytest.raises(TypeError, match="takes 9 arguments"):
        launch(mixed, 4, *arguments[:-1])


def test_many_shapes(all_threads: None):
    """More than are remembered."""
    for count in range(1, 600):
        arguments = mixed_arguments(count)
        launch(mixed, count, *arguments)
        assert bool((arguments[-1][:, 0] > 1000.0).all()), count


def covered(chunks: Chunks) -> list[int]:
    return sorted(i for begin, size in chunks for i in range(begin, begin + size))


@pytest.mark.parametrize("threads", [2, 3, 16])
@pytest.mark.parametrize("grain", [1, 7, 512])
@pytest.mark.parametrize("count", [1, 2, 50, 2500, 49_001])
def test_even_chunks(count: int, grain: int, threads: int):
    chunks = cut_evenly(count, threads, grain)
    assert covered(chunks) == list(range(count))
    sizes = [size for _, size in chunks]
    assert all(size >= grain for size in sizes[:-1])
    assert max(sizes) <= max(grain, count / (2 * threads) + grain)


def makespan(costs: list[int], threads: int) -> int:
    """When all are done if each goes to the thread that is free first."""
    ends = [0] * threads
    for cost in costs:
        ends[ends.index(min(ends))] += cost
    return max(ends)


@pytest.mark.parametrize("threads", [2, 3, 8])
@pytest.mark.parametrize("seed", range(4))
def test_chunks_by_load_balance(seed: int, threads: int):
    """A few indices hold nearly all the work, next to each other; the heaviest is a lower bound."""
    random = np.random.default_rng(seed)
    costs = random.integers(0, 3, 2500)
    at = int(random.integers(0, 2480))
    costs[at : at + 20] += random.integers(0, 20_000, 20)
    chunks = cut_by_load(torch.from_numpy(np.cumsum(costs)), threads)
    assert covered(chunks) == list(range(2500))
    taken = [int(costs[begin : begin + size].sum()) for begin, size in chunks]
    assert taken == sorted(taken, reverse=True)
    least = max(costs.sum() / threads, costs.max())
    assert makespan(taken, threads) <= least + costs.max() / 2 + costs.sum() / (8 * threads)
    assert len(chunks) < 40 * threads


@pytest.mark.parametrize("load", [[0, 0, 0], [5], [0, 0, 9, 9], [9, 9, 9]])
def test_chunks_of_no_load(load: list[int]):
    assert covered(cut_by_load(torch.tensor(load), 2)) == list(range(len(load)))


@pytest.fixture
def own_helpers(monkeypatch: pytest.MonkeyPatch) -> cpu_threads.HelperThreads:
    helpers = cpu_threads.HelperThreads(environment.configured())
    monkeypatch.setattr(cpu_threads, "helpers", helpers)
    return helpers


@pytest.mark.parametrize("begin", [0, 1000])
@pytest.mark.parametrize("count", [1, 2, 3, 300])
def test_every_chunk_runs_once(own_helpers, count: int, begin: int):
    for _ in range(20):
        ran: list[int] = []
        assert share(PythonKernel(lambda first, size, ran=ran: ran.append(first)), b"", single_chunks(count), 3, begin)
        assert sorted(ran) == list(range(begin, begin + count))


def seen_by(threads: int) -> set[int]:
    """Share a grid whose chunks wait until ``threads`` have come; return the threads that ran any."""
    own: set[int] = set()
    ends = time.monotonic() + 20

    def call(first: int, size: int) -> None:
        own.add(threading.get_ident())
        while len(own) < threads and time.monotonic() < ends:
            time.sleep(0.001)
        time.sleep(0.001)

    assert share(PythonKernel(call), b"", single_chunks(40), threads)
    return own


def test_only_as_many_threads_as_asked_share(own_helpers):
    """Others, which an earlier job has started, are awake and stay away."""
    assert len(seen_by(4)) == 4 and own_helpers.count == 3
    assert len(seen_by(2)) == 2


def test_a_sleeping_helper_wakes_up(own_helpers):
    for _ in range(3):
        assert len(seen_by(2)) == 2
        ends = time.monotonic() + 20
        while own_helpers._job[cpu_threads.AWAKE]:
            assert time.monotonic() < ends, "it never sleeps"
            time.sleep(0.001)


def test_a_job_has_no_more_seats_than_its_bits_hold(own_helpers, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(own_helpers, "_wake", lambda helpers: None)
    ran: list[int] = []
    for _ in range(2):
        assert share(PythonKernel(lambda first, size: ran.append(first)), b"", single_chunks(600), 500)
        assert own_helpers._job[cpu_threads.SPINS - 1] == 255
    assert ran == 2 * list(range(600))
    assert int(own_helpers._job[cpu_threads.STATE]) >> 40 == 2, "jobs are counted one by one"


def test_threads_that_share_a_core_do_not_look_for_jobs(own_helpers, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(environment, "available_threads", lambda: 1)
    ran: list[int] = []
    assert share(PythonKernel(lambda first, size: ran.append(first)), b"", single_chunks(9), 2)
    assert sorted(ran) == list(range(9)) and own_helpers._job[cpu_threads.SPINS] == 0


def test_a_second_grid_meanwhile_runs_alone(all_threads: None, own_helpers):
    environment.configure(2)
    hold, started = threading.Event(), threading.Event()

    def slow(first: int, size: int) -> None:
        started.set()
        assert hold.wait(10)

    asking = threading.Thread(target=lambda: share(PythonKernel(slow), b"", single_chunks(2), 2))
    asking.start()
    assert started.wait(10)
    assert not share(PythonKernel(lambda first, size: None), b"", single_chunks(2), 2)
    arguments = mixed_arguments(37)
    launch(mixed, 37, *arguments, grain=1)
    assert bool((arguments[-1][:, 0] > 1000.0).all()) and not hold.is_set()
    hold.set()
    asking.join(10)
    assert not asking.is_alive()
    assert share(PythonKernel(lambda first, size: None), b"", single_chunks(2), 2)


def test_an_interrupt_waits_until_no_helper_writes_any_more(own_helpers, monkeypatch: pytest.MonkeyPatch):
    started, ended = threading.Event(), threading.Event()

    def call(first: int, size: int) -> None:
        if threading.current_thread() is threading.main_thread():
            assert started.wait(10)
        else:
            started.set()
            time.sleep(0.2)
            ended.set()

    share(PythonKernel(lambda first, size: None), b"", single_chunks(2), 2)
    offer = own_helpers._calls["share_job"]

    def interrupt() -> None:
        offer()
        raise KeyboardInterrupt

    monkeypatch.setitem(own_helpers._calls, "share_job", interrupt)
    with pytest.raises(KeyboardInterrupt):
        share(PythonKernel(call), b"", single_chunks(2), 2)
    assert ended.is_set()


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_what_is_raised_before_the_offer_is_raised_at_once(error, own_helpers, monkeypatch: pytest.MonkeyPatch):
    share(PythonKernel(lambda first, size: None), b"", single_chunks(2), 2)

    def refuse() -> None:
        raise error

    ran: list[int] = []
    with monkeypatch.context() as patch:
        patch.setitem(own_helpers._calls, "share_job", refuse)
        with pytest.raises(error):
            share(PythonKernel(lambda first, size: ran.append(first)), b"", single_chunks(2), 2)
    assert not ran
    assert share(PythonKernel(lambda first, size: ran.append(first)), b"", single_chunks(2), 2), "the next one runs"
    assert sorted(ran) == [0, 1]


def test_at_the_end_no_helper_runs_any_more(own_helpers):
    """Not even one that would look for jobs for ever."""
    assert share(PythonKernel(lambda first, size: time.sleep(0.001)), b"", single_chunks(40), 3)
    threads = [thread for thread in threading.enumerate() if thread in own_helpers._threads]
    assert len(threads) == 2
    own_helpers._job[cpu_threads.SPINS] = 1 << 40
    own_helpers.end()
    assert not any(thread.is_alive() for thread in threads)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_starts_threads_of_its_own():
    share(PythonKernel(lambda first, size: None), b"", single_chunks(2), 2)
    child = os.fork()
    if child == 0:
        done: list[int] = []
        ran = share(PythonKernel(lambda first, size: done.append(first)), b"", single_chunks(4), 2)
        own = any(thread.name.startswith("warp-") for thread in threading.enumerate())
        os._exit(0 if ran and sorted(done) == [0, 1, 2, 3] and own else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
