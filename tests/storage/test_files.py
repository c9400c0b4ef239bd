"""Whole files: only regular ones are read, and several processes may write one name."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scgs_warp.errors import UserError
from scgs_warp.storage import files
from scgs_warp.storage.files import open_regular, read_bytes, read_text, write_atomically
from scgs_warp.visualization.video import film

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names here")


@pytest.fixture(params=["pipe", "device", "folder"])
def special(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A path that is there and is no regular file."""
    path = tmp_path / "special"
    if request.param == "pipe":
        os.mkfifo(path)
    elif request.param == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()
    return path


def test_only_regular_files_are_opened(special: Path):
    """A pipe would be waited for until somebody writes, and a device never ends."""
    with pytest.raises(OSError, match=r"not a regular file") as caught:
        open_regular(special)
    assert caught.value.filename == str(special)
    with pytest.raises(OSError, match="not a regular file"):
        read_text(special)
    with pytest.raises(UserError, match=r"special: cannot be read \(not a regular file\); give a \.spz"):
        read_bytes(special, "give a .spz")


def test_a_short_text_takes_little_memory(tmp_path: Path):
    path = tmp_path / "short.json"
    path.write_text("{}")
    tracemalloc.start()
    try:
        assert read_text(path) == "{}"
        assert tracemalloc.get_traced_memory()[1] < 4 * 2**20, "not room for the largest text"
    finally:
        tracemalloc.stop()


def test_text_is_bounded(tmp_path: Path):
    path = tmp_path / "a.json"
    path.write_bytes("ä\r\nb\rc\n".encode())
    size = path.stat().st_size
    assert read_text(path, size) == "ä\nb\nc\n"
    with pytest.raises(OSError, match="larger than 0 MiB"):
        read_text(path, size - 1)
    path.write_bytes(b"a\xff")
    with pytest.raises(UnicodeDecodeError):
        read_text(path)
    assert read_text(path, errors="replace") == "a\ufffd"


def test_a_huge_text_is_refused_without_reading_it(tmp_path: Path):
    path = tmp_path / "a.json"
    with open(path, "wb") as file:
        file.truncate(2**40)
    with pytest.raises(OSError, match=f"larger than {files.MAX_TEXT >> 20} MiB"):
        read_text(path)


def test_writers_of_one_name_do_not_share_a_temporary_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The second writer begins and ends while the first one is in the middle of its file."""
    path, sync, others = tmp_path / "scene.glb", os.fsync, [b"second" * 1000]

    def interrupted(number: int) -> None:
        if others:
            write_atomically(path, others.pop())
            assert path.read_bytes() == b"second" * 1000
        sync(number)

    monkeypatch.setattr(os, "fsync", interrupted)
    write_atomically(path, b"first" * 1000)
    assert path.read_bytes() == b"first" * 1000
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene.glb"]


def test_many_writers_of_one_name(tmp_path: Path):
    path, contents, failures = tmp_path / "scene.glb", [bytes([k]) * 20_000 for k in range(6)], []

    def write(content: bytes) -> None:
        try:
            for _ in range(10):
                write_atomically(path, content)
                if (found := path.read_bytes()) not in contents:
                    failures.append(len(found))
        except BaseException as error:
            failures.append(error)

    workers = [threading.Thread(target=write, args=(content,)) for content in contents]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert failures == [] and [entry.name for entry in tmp_path.iterdir()] == ["scene.glb"]


def test_leftovers_of_killed_writers_are_removed(tmp_path: Path):
    fcntl: Any = pytest.importorskip("fcntl")
    names = [".a.json.0123abcd.tmp", ".a.json.4567cdef.tmp", ".b.json.0123abcd.tmp", ".a.json.note.tmp"]
    for name in names:
        (tmp_path / name).write_text("half")
    with open(tmp_path / names[1]) as alive:  # its writer is at work
        fcntl.flock(alive, fcntl.LOCK_EX)
        write_atomically(tmp_path / "a.json", b"{}")
    left = {entry.name for entry in tmp_path.iterdir()}
    assert left == {"a.json", *names[1:]}


@pytest.mark.parametrize("name", ["film.mp4", "film.gif", "frames"])
def test_leftovers_of_killed_films_are_removed(name: str, tmp_path: Path):
    pytest.importorskip("fcntl")
    begin = (
        "import os, signal, sys, numpy; from scgs_warp.visualization.video import film\n"
        "with film(sys.argv[1]) as writer:\n"
        "    writer.write(numpy.zeros((16, 16, 3), numpy.uint8)); os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", begin, str(tmp_path / name)], check=False)
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(f".{name}.")
    with film(tmp_path / name) as writer:
        writer.write(np.zeros((16, 16, 3), np.uint8))
        with film(tmp_path / name) as other:  # does not take the first one's file for a leftover
            other.write(np.zeros((16, 16, 3), np.uint8))
    assert [entry.name for entry in tmp_path.iterdir()] == [name]


def test_the_longest_name_is_written(tmp_path: Path):
    path = tmp_path / ("ü" * 125 + ".json")
    for content in (b"one", b"two"):
        write_atomically(path, content)
        assert path.read_bytes() == content and list(tmp_path.iterdir()) == [path]


def test_a_writer_whose_new_file_is_taken_for_a_leftover_begins_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    fcntl: Any = pytest.importorskip("fcntl")
    lock, taken = fcntl.flock, []

    def late(number: int, how: int) -> None:
        if not taken:
            taken.extend(tmp_path.glob(".a.json.*.tmp"))
            taken[0].unlink()
        lock(number, how)

    monkeypatch.setattr(fcntl, "flock", late)
    write_atomically(tmp_path / "a.json", b"{}")
    assert taken and (tmp_path / "a.json").read_bytes() == b"{}"
