"""Processes under unusual conditions: closed streams, plain terminals, little memory, no place for kernels."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import warp as wp

from helpers.full_disk import small_disk
from helpers.paths import ROOT
from scgs_warp.apps import cli
from scgs_warp.errors import UserError
from scgs_warp.kernels.cpu import activations as cpu_kernels
from scgs_warp.ops.activations import exponential
from scgs_warp.runtime import kernel_cache

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "tests"), str(ROOT)])}
HELPERS = ROOT / "tests/helpers"
posix = pytest.mark.skipif(os.name != "posix", reason="signals, limits and owners of POSIX systems")


def start(helper: str, **more: Any) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, str(HELPERS / helper)], timeout=300, **{"env": ENVIRONMENT, **more})


def close_streams() -> None:
    for number in range(3):
        os.close(number)


@posix
def test_closed_standard_streams():
    """As a daemon or cron starts a process. The next opened files would take their numbers."""
    done = start("one_kernel.py", stderr=subprocess.PIPE, preexec_fn=lambda: os.close(1))
    assert (done.returncode, done.stderr) == (0, b"")
    assert start("one_kernel.py", preexec_fn=close_streams).returncode == 0


FILM = """
import os, signal, sys, time
from pathlib import Path
import numpy as np
from scgs_warp.apps.cli import run
from scgs_warp.visualization.video import film

def main(words):
    with film(Path(words[0])) as writer:
        writer.write(np.zeros((16, 16, 3), np.uint8))
        assert len(os.listdir(".")) == 1
        os.kill(os.getpid(), getattr(signal, words[1]))
        time.sleep(60)

sys.exit(run(main, sys.argv[1:]))
"""


@posix
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_program_that_is_ended_removes_what_is_unfinished(tmp_path, name):
    done = subprocess.run(
        [sys.executable, "-c", FILM, "frames", name], cwd=tmp_path, env=ENVIRONMENT, timeout=300, capture_output=True,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (130, b"interrupted\n")
    assert list(tmp_path.iterdir()) == []


@posix
def test_files_do_not_take_the_places_of_closed_streams(tmp_path):
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        close_streams()
        sys.stdin = sys.stdout = sys.stderr = None  # type: ignore[assignment]
        opened = []
        cli.run(lambda _: opened.append(os.open(tmp_path, os.O_RDONLY)))
        print("nobody reads this")
        os.write(writer, bytes([*opened, os.get_inheritable(2), sys.stderr is not None]))
        os._exit(0)
    os.close(writer)
    os.waitpid(child, 0)
    number, inherited, there = os.read(reader, 3)
    os.close(reader)
    assert number > 2 and inherited and there


def test_a_terminal_without_the_character(monkeypatch):
    """The progress of ``Bäume`` on a terminal that knows ASCII only."""
    seen, told = io.BytesIO(), io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(seen, encoding="ascii", write_through=True))
    monkeypatch.setattr(sys, "stderr", io.TextIOWrapper(told, encoding="ascii", errors="strict", write_through=True))

    def main(_: object) -> None:
        print("Bäume → 3")
        raise UserError("Bäume: no such file")

    assert cli.run(main) == 2
    assert seen.getvalue() == b"B\\xe4ume \\u2192 3\n"
    assert told.getvalue() == b"error: B\\xe4ume: no such file\n"


@posix
def test_sigterm_ends_a_process_that_uses_pycolmap():
    """pycolmap's library answers SIGTERM with the stack of its C++ code, unless its handler is replaced."""
    done = start("ended_by_sigterm.py", capture_output=True)
    assert done.returncode == -signal.SIGTERM and done.stderr == b""


FORKED = """
import os, signal
import torch
from scgs_warp.runtime import cpu_threads, environment

def work():
    return float(torch.ones(1 << 20).exp().sum())

environment.configure(2)
expected = work()
child = os.fork()
if child == 0:
    signal.alarm(20)
    os._exit(0 if work() == expected else 1)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@posix
def test_a_forked_process_computes():
    """As a worker of a ``ProcessPoolExecutor``. OpenMP would wait forever for the threads of the parent."""
    done = subprocess.run([sys.executable, "-c", FORKED], env=ENVIRONMENT, timeout=300, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("0\n", "")


def limit_addresses() -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (700 << 20, 700 << 20))


@pytest.mark.skipif(sys.platform != "linux", reason="address space is limited on Linux")
def test_too_little_address_space_is_one_line():
    done = start("one_kernel.py", capture_output=True, text=True, preexec_fn=limit_addresses)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert "not enough memory" in done.stderr and "700 MiB of addresses (ulimit -v)" in done.stderr


def test_a_lack_of_memory_without_a_limit_is_one_line(capsys):
    def main(_: object) -> None:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory")

    assert cli.run(main) == 2
    assert capsys.readouterr().err.strip().endswith("free some, or give less at once")


def test_kernels_are_compiled_where_the_usual_disk_is_full(tmp_path):
    """The compiler of Warp ends the process when it cannot write."""
    with small_disk(tmp_path / "disk", 1) as disk:
        done = start(
            "one_kernel.py",
            capture_output=True,
            text=True,
            env={**ENVIRONMENT, "WARP_CACHE_PATH": str(disk.folder)},
        )
    assert (done.returncode, done.stdout) == (0, "sum 3\n"), done.stderr
    assert done.stderr.count("\n") == 1 and "no room" in done.stderr and "WARP_CACHE_PATH" in done.stderr


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """A folder for kernels of this test, and a folder for temporary files."""
    for name in ("usual", "temporary"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(kernel_cache, "_private", None)
    monkeypatch.setattr(kernel_cache.tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "usual"))
    return tmp_path / "usual"


def compile_into(places: list[str], refused: tuple[str, ...] = ()) -> Any:
    """Return the compilation of a kernel, which notes its folder and fails in the ``refused`` ones."""

    def prepare() -> str:
        folder = str(wp.config.kernel_cache_dir)
        places.append(folder)
        if any(name in folder for name in refused):
            raise PermissionError(13, "Permission denied", folder)
        return "kernel"

    return prepare


def test_kernels_are_compiled_where_the_usual_folder_cannot_be_written(cache, capsys):
    places: list[str] = []
    for _ in range(2):
        assert kernel_cache.prepared(None, compile_into(places, ("usual",))) == "kernel"
    assert places[0] == str(cache) and places[1] == places[2] and places[1].startswith(str(cache.parent / "temporary"))
    assert os.stat(places[1]).st_mode & 0o077 == 0
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"{cache}: Permission denied" in said and "WARP_CACHE_PATH" in said


def test_kernels_that_are_compiled_need_no_room(cache, monkeypatch, capsys):
    monkeypatch.setattr(kernel_cache, "_room", lambda folder: 0 if folder == str(cache) else 1 << 30)
    places: list[str] = []
    monkeypatch.setattr(kernel_cache, "_is_compiled", lambda _: True)
    kernel_cache.prepared(None, compile_into(places))
    monkeypatch.setattr(kernel_cache, "_is_compiled", lambda _: False)
    kernel_cache.prepared(None, compile_into(places))
    assert places[0] == str(cache) and "temporary" in places[1]


def test_a_kernel_that_has_run_counts_as_compiled():
    exponential(torch.zeros(3))
    assert kernel_cache._is_compiled(cpu_kernels.exponential)


def test_code_that_cannot_be_loaded_is_one_line(cache):
    """Under a limit on memory the loader gives modules without their kernels."""
    kernel = SimpleNamespace(key="composite")

    def fail(message: str, kind: type[Exception] = RuntimeError) -> None:
        raise kind(message)

    with pytest.raises(UserError, match=r"usual: the code of composite .* cannot be loaded; free memory") as caught:
        kernel_cache.prepared(kernel, lambda: fail("Failed to find forward kernel 'composite' from module 'm'"))
    assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="cannot be loaded; free memory"):
        kernel_cache.prepared(kernel, lambda: fail("Failed to load CPU module 'm' (no memory)", Exception))
    for damaged in (b"{", b"\xff\xfe"):  # what describes the code, as a loss of power may leave it
        with pytest.raises(UserError, match="remove the folder if its files are damaged"):
            kernel_cache.prepared(kernel, lambda damaged=damaged: json.loads(damaged.decode()))
    with pytest.raises(RuntimeError, match="something else"):
        kernel_cache.prepared(kernel, lambda: fail("something else"))


def test_no_folder_for_kernels_is_one_line(cache, monkeypatch):
    monkeypatch.setattr(kernel_cache, "_room", lambda _: 0)
    monkeypatch.setattr(kernel_cache, "_is_compiled", lambda _: False)
    with pytest.raises(UserError, match=r"usual: no room\), nor in .*temporary \(no room\); name a folder"):
        kernel_cache.prepared(None, lambda: None)
    assert list((cache.parent / "temporary").iterdir()) == []
    monkeypatch.undo()


def test_a_private_folder_that_fails_is_one_line(cache, capsys):
    places: list[str] = []
    with pytest.raises(OSError, match="Permission denied"):
        kernel_cache.prepared(None, compile_into(places, ("usual", "temporary")))
    with pytest.raises(UserError, match=r"Permission denied; name a folder of yours .* in WARP_CACHE_PATH"):
        kernel_cache.prepared(None, compile_into(places, ("usual", "temporary")))


@posix
def test_kernels_of_another_user_are_not_run(cache, monkeypatch, capsys):
    """Whoever can write there can make this process run any machine code."""
    kernel_cache.initialise_warp(lambda: None)
    assert wp.config.kernel_cache_dir == str(cache)
    cache.chmod(0o777)
    kernel_cache.initialise_warp(lambda: None)
    assert "temporary" in str(wp.config.kernel_cache_dir) and "every user may write there" in capsys.readouterr().err
    cache.chmod(0o755)
    monkeypatch.setattr(os, "geteuid", lambda: os.stat(cache).st_uid + 7)
    owner = kernel_cache._distrust(str(cache))
    assert owner == (None if os.stat(cache).st_uid == 0 else f"belongs to user {os.stat(cache).st_uid}")


def test_a_folder_for_kernels_that_cannot_be_made(cache, capsys):
    calls: list[str] = []

    def init() -> None:
        calls.append(str(wp.config.kernel_cache_dir))
        if len(calls) == 1:
            raise NotADirectoryError(20, "Not a directory", str(cache))

    kernel_cache.initialise_warp(init)
    assert calls[0] == str(cache) and "temporary" in calls[1]
    assert "Not a directory" in capsys.readouterr().err
