"""Limits of addresses (ulimit -v): what does not fit is refused in one line before it begins."""

from __future__ import annotations

import subprocess
import sys
import threading
from concurrent.futures import Future

import pytest

from helpers.python_kernel import PythonKernel, single_chunks
from scgs_warp.apps import cli
from scgs_warp.data.cache import ImageCache
from scgs_warp.data.images import parallel_map
from scgs_warp.editor.jobs import Jobs
from scgs_warp.errors import UserError
from scgs_warp.live.server import PageServer
from scgs_warp.runtime import addresses, cpu_threads
from scgs_warp.runtime.memory import NotEnoughMemory

linux = pytest.mark.skipif(sys.platform != "linux", reason="addresses are limited on Linux")
MIB = 1 << 20


def leave(monkeypatch: pytest.MonkeyPatch, mib: int) -> None:
    monkeypatch.setattr(addresses, "limit", lambda: (1000 + mib) * MIB)
    monkeypatch.setattr(addresses, "status", lambda key: 1000 * MIB)


def test_the_refusal_gives_the_figures(monkeypatch: pytest.MonkeyPatch):
    leave(monkeypatch, 7)
    addresses.require(7 * MIB, "a thing")
    assert addresses.fits(7 * MIB) and not addresses.fits(7 * MIB + 1)
    with pytest.raises(NotEnoughMemory, match="a thing needs 8 MiB of addresses, and 7 MiB are left of the 1007 MiB"):
        addresses.require(8 * MIB, "a thing")
    monkeypatch.setattr(addresses, "limit", lambda: None)
    addresses.require(2**60, "a thing")
    assert addresses.fits(2**60)


def test_freed_memory_is_handed_back_first(monkeypatch: pytest.MonkeyPatch):
    leave(monkeypatch, 7)
    monkeypatch.setattr(addresses, "hand_back", lambda: monkeypatch.setattr(addresses, "status", lambda key: 998 * MIB))
    assert not addresses.fits(10 * MIB) and addresses.fits(9 * MIB)
    leave(monkeypatch, 7)
    addresses.require(9 * MIB, "a thing")


def run_limited(code: str, mib: int) -> subprocess.CompletedProcess[str]:
    """Run Python code in a process that may use ``mib`` MiB more than its libraries take."""
    code = (
        "import resource, sys, torch, scgs_warp.apps.cli as cli\n"
        "from scgs_warp.runtime import addresses, environment, memory\n"
        f"most = memory.status('VmSize') + {mib * MIB}\n"
        f"resource.setrlimit(resource.RLIMIT_AS, (most, most))\n{code}"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)


@linux
def test_a_program_that_is_left_too_little_ends_in_one_line():
    done = run_limited("sys.exit(cli.run(lambda _: environment.configure(1)))", 48)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert "a program needs 64 MiB of addresses" in done.stderr and "(ulimit -v)" in done.stderr


@linux
def test_threads_share_a_heap_where_addresses_are_limited():
    """Each heap of glibc would reserve 64 MiB or more."""
    code = """
import threading
environment.configure(1)
before, all_begun = memory.status("VmSize"), threading.Barrier(5)
def work():
    held = [bytes(1000) for _ in range(1000)]
    all_begun.wait()
    all_begun.wait()
for _ in range(4):
    threading.Thread(target=work).start()
all_begun.wait()
print((memory.status("VmSize") - before) >> 20)
all_begun.wait()
"""
    done = run_limited(code, 1000)
    assert done.returncode == 0 and int(done.stdout) < 100, done.stdout + done.stderr


@linux
def test_the_stack_is_there_before_addresses_run_out():
    """The kernel of projection takes 144 KiB of stack; at the limit the system ends a process whose stack grows."""
    done = run_limited("environment.configure(1); print(memory.status('VmStk'))", 1000)
    assert done.returncode == 0 and int(done.stdout) >= 400 << 10, done.stdout + done.stderr


def refuse(thread: threading.Thread) -> None:
    raise RuntimeError("can't start new thread")


@pytest.mark.parametrize("how", ["no room", "the system refuses"])
def test_a_thread_that_cannot_start_is_one_line(monkeypatch: pytest.MonkeyPatch, how: str):
    if how == "no room":
        leave(monkeypatch, 31)
    else:
        monkeypatch.setattr(threading.Thread, "start", refuse)
    thread = threading.Thread(target=lambda: None, name="helper")
    with pytest.raises(NotEnoughMemory, match="the thread 'helper'"):
        addresses.start(thread)
    assert not thread.is_alive()
    with pytest.raises(NotEnoughMemory, match="the thread 'page server'"):
        PageServer({})


@pytest.mark.parametrize("how", ["no room", "the system refuses"])
def test_a_grid_is_computed_without_helpers(monkeypatch: pytest.MonkeyPatch, how: str):
    if how == "no room":
        leave(monkeypatch, 31)
    else:
        monkeypatch.setattr(threading.Thread, "start", refuse)
    monkeypatch.setattr(cpu_threads, "helpers", cpu_threads.HelperThreads(cpu_threads.environment.configured()))
    done: list[int] = []
    assert cpu_threads.share(PythonKernel(lambda first, size: done.append(first)), b"", single_chunks(9), 4)
    assert done == list(range(9)) and cpu_threads.helpers.count == 0


def test_images_are_read_without_threads(monkeypatch: pytest.MonkeyPatch):
    leave(monkeypatch, 31)
    cache = ImageCache(1)
    cache.expect("a", lambda: pytest.fail("read in advance"))
    assert cache.read_ahead == 0
    seen: list[tuple[int, int]] = []
    here = threading.get_ident()
    found = parallel_map(lambda k: (k, threading.get_ident()), [1, 2, 3], lambda *now: seen.append(now))
    assert found == [(1, here), (2, here), (3, here)] and seen == [(1, 3), (2, 3), (3, 3)]


def test_a_job_that_cannot_start_leaves_room_for_the_next(monkeypatch: pytest.MonkeyPatch):
    ended: Future[str] = Future()
    jobs = Jobs(lambda progress: None, lambda who, name, result, problem: ended.set_result(result))
    with monkeypatch.context() as patch:
        leave(patch, 31)
        with pytest.raises(UserError, match="the thread 'job'"):
            jobs.start("film", 1, lambda advance: "no")
    assert jobs.wait(0.0)
    jobs.start("film", 1, lambda advance: "done")
    assert ended.result(30) == "done"


def test_a_pool_that_cannot_start_a_thread_means_a_lack_of_memory(capsys: pytest.CaptureFixture[str]):
    def main(_: object) -> None:
        refuse(threading.current_thread())

    assert cli.run(main) == 2
    assert "there is not enough memory for this" in capsys.readouterr().err
