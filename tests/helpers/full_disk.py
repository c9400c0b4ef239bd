"""Full disks: a real one of a few megabytes, and a simulated one."""

from __future__ import annotations

import builtins
import errno
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest


class RefusingFile:
    """A file that opens and refuses every write."""

    def __init__(self, inner: Any, number: int) -> None:
        self._inner, self._number = inner, number

    def __enter__(self) -> RefusingFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._inner.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def write(self, content: bytes) -> int:
        raise OSError(self._number, os.strerror(self._number))


class FakeDisk:
    """While ``full``, refuse writes to files whose names contain one of ``names``."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, names: tuple[str, ...], number: int = errno.ENOSPC) -> None:
        self.full, self.names, self.number = False, names, number
        self._open = builtins.open
        monkeypatch.setattr(builtins, "open", self.open)

    def open(self, file: Any, mode: str = "r", *arguments: Any, **fields: Any) -> Any:
        handle = self._open(file, mode, *arguments, **fields)
        refused = self.full and mode[0] in "wax" and any(name in Path(file).name for name in self.names)
        return RefusingFile(handle, self.number) if refused else handle


class SmallDisk:
    """A small file system. ``fill`` takes every byte of it, ``free`` releases them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._ballast = folder / "ballast"

    def fill(self) -> None:
        with open(self._ballast, "wb", buffering=0) as file:
            for size in (1 << 20, 1 << 12, 1):
                try:
                    while True:
                        file.write(bytes(size))
                except OSError:
                    continue

    def free(self) -> None:
        self._ballast.unlink()


@contextmanager
def nothing_may_be_written(folder: Path) -> Iterator[None]:
    """Take away the right to write to a folder; root changes its user for that."""
    root, mode = os.geteuid() == 0, folder.stat().st_mode
    folder.chmod(0o555)
    if root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if root:
            os.seteuid(0)
        folder.chmod(mode)


@contextmanager
def small_disk(folder: Path, mib: int) -> Iterator[SmallDisk]:
    """Mount a small file system at ``folder``; skip the test where that is not allowed."""
    folder.mkdir()
    try:
        made = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={mib}m", "tmpfs", str(folder)], capture_output=True)
    except OSError as error:
        pytest.skip(f"mount cannot be run ({error.strerror})")
    if made.returncode != 0:
        pytest.skip(f"a small disk cannot be mounted: {made.stderr.decode().strip()}")
    try:
        yield SmallDisk(folder)
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)
