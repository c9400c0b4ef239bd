"""The Clang that compiles native headers outside Warp."""

from __future__ import annotations

import functools
import shutil
import subprocess

import pytest

COMPILERS = ("clang++", *(f"clang++-{version}" for version in range(25, 15, -1)))


@functools.cache
def compiler_path() -> str | None:
    """Return a Clang with vectors of bool (16 or newer), if there is one."""
    for name in COMPILERS:
        path = shutil.which(name)
        if path is None:
            continue
        version = subprocess.run([path, "-dumpversion"], capture_output=True, text=True, check=True).stdout
        if int(version.split(".")[0]) >= 16:
            return path
    return None


def compiler() -> str:
    """Return a Clang with vectors of bool; skip the test where there is none."""
    path = compiler_path()
    if path is None:
        pytest.skip("no Clang of version 16 or newer is installed")
    return path
