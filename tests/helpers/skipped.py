"""What a test run did not test, for want of what, and how to get it."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from typing import NamedTuple

VARIABLE = "SCGS_NEEDS"
"""Environment variable with the names of wants, in words, for which nothing may be skipped on this machine."""


class Want(NamedTuple):
    """Something that tests need and a machine may lack."""

    name: str
    reasons: str
    """Regular expression of the reasons of tests that are skipped for want of it."""
    remedy: str


WANTS = (
    Want("chromium", r"no Chromium", "apt-get install chromium, or name a browser in CHROMIUM"),
    Want("npm", r"no node package|node is not installed", "install node and npm, then run .ci/run, or see .ci/run"),
    Want(
        "data",
        r"SCGS_DATA|folder of data sets|no such (model|video) here",
        "name a folder of data sets in SCGS_DATA (CONTRIBUTING.md)",
    ),
    Want("clang", r"no Clang|clang-format", "apt-get install clang-19; pip install -e '.[dev]'"),
    Want("compiler", r"no C\+\+ compiler", "apt-get install g++ (Linux)"),
    Want(
        "emulator",
        r"no qemu-aarch64",
        "apt-get install qemu-user gcc-aarch64-linux-gnu libc6-dev-arm64-cross (Debian)",
    ),
    Want("mount", r"small disk|mount cannot", "run as root outside of a container"),
    Want("players", r"Mono is not installed|names no Python with the package bpy", "see the reason of each test"),
    Want("packages", r"is not installed|could not import|cannot be imported", "pip install -e '.[dev]'"),
)
"""The first want whose reasons fit counts."""


def wanted_by(reason: str) -> Want | None:
    """Return what a skipped test needs; None if it does not belong on this machine at all."""
    return next((want for want in WANTS if re.search(want.reasons, reason)), None)


def lines(reasons: Iterable[str]) -> list[str]:
    """Describe what is skipped, a line for each want."""
    counts: dict[Want, int] = {}
    for want in filter(None, map(wanted_by, reasons)):
        counts[want] = counts.get(want, 0) + 1
    return [
        f"{count} test{'s' if count > 1 else ''} for want of {want.name}: {want.remedy}"
        for want, count in sorted(counts.items(), key=lambda pair: WANTS.index(pair[0]))
    ]


def needed_here(reasons: Iterable[str]) -> list[str]:
    """Return the names of wants, listed in ``SCGS_NEEDS``, for which a test was skipped all the same.

    Raises:
        ValueError: the list has a name that is none of a want.
    """
    needs = os.environ.get(VARIABLE, "").replace(",", " ").split()
    unknown = [name for name in needs if name not in {want.name for want in WANTS}]
    if unknown:
        raise ValueError(f"{VARIABLE}: {unknown[0]!r} is none of {', '.join(want.name for want in WANTS)}")
    found = {want.name for want in filter(None, map(wanted_by, reasons))}
    return [name for name in needs if name in found]
