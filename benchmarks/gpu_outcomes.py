"""A plugin of pytest for ``gpu_check``: picks the tests that need the GPU, and notes each outcome at once.

The environment variable ``GPU_CHECK_TESTS`` holds JSON: ``done``, a file with the identifiers of tests to leave out;
``outcomes``, the file to append to; ``share``, [which, of how many], this process's share of the files; ``all``, true
for all tests, whether they need a GPU or not.
"""

from __future__ import annotations

import json
import os
import re
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pytest

VARIABLE = "GPU_CHECK_TESTS"
TASK: dict[str, Any] = json.loads(os.environ.get(VARIABLE, "{}"))
BEGAN, COUNTED, ENDED = "began", "counted", "ended"
"""Notes beside ``passed``, ``failed`` and ``skipped``: of a test, of the number of tests, of a whole process."""
WITHOUT_PARAMETER = ("kernels/cuda/", "runtime/test_cuda_launch.py")
"""Tests that choose the GPU themselves."""
ANYWHERE = re.compile(r"gpu_check|emulated|test_compile|pretended_cuda")
"""Tests that run as well without a GPU."""
BROKEN = re.compile(r"CUDA error|cudaError|CUDA_ERROR")
"""What is said on a GPU that stays unusable for the rest of the process."""
COMPLETE = (0, 1, 5)
"""Statuses of a session that has run all its tests: they passed, some failed, there were none."""
TEXT = 2000
"""Number of characters of a failure that are kept."""

_worst: dict[str, str] = {}
_texts: dict[str, str] = {}
_sessions: list[pytest.Session] = []
_left_out: list[int] = []
"""Number of tests that are done."""


def note(identifier: str, outcome: str, text: str = "") -> None:
    with open(TASK["outcomes"], "a", encoding="utf-8") as file:
        file.write(json.dumps([identifier, outcome, text]) + "\n")


def needs_gpu(item: pytest.Item) -> bool:
    if ANYWHERE.search(item.nodeid):
        return False
    call = getattr(item, "callspec", None)
    chosen = call is not None and call.params.get("device") == "cuda"
    return chosen or any(place in item.nodeid for place in WITHOUT_PARAMETER)


def pytest_sessionstart(session: pytest.Session) -> None:
    _sessions.append(session)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    which, count = TASK["share"]
    done = set(json.loads(Path(TASK["done"]).read_text(encoding="utf-8")))
    wanted = [item for item in items if TASK["all"] or needs_gpu(item)]
    # Tests of one file stay together: they share fixtures and compiled kernels.
    own = [item for item in wanted if zlib.crc32(item.nodeid.split("::")[0].encode()) % count == which]
    items[:] = [item for item in own if item.nodeid not in done]
    _left_out.append(len(own) - len(items))


def pytest_collection_finish(session: pytest.Session) -> None:
    note(str(len(session.items) + sum(_left_out)), COUNTED)


def pytest_runtest_logstart(nodeid: str) -> None:
    note(nodeid, BEGAN)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    name = report.nodeid
    before = _worst.get(name, "passed")
    _worst[name] = report.outcome if before == "passed" else before
    if report.failed:
        _texts[name] = report.longreprtext[-TEXT:]
        if BROKEN.search(report.longreprtext):
            _sessions[-1].shouldstop = "the GPU is in an error, which all later tests of this process would meet"
    if report.when == "teardown":
        note(name, _worst.pop(name), _texts.pop(name, ""))


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    if int(exitstatus) in COMPLETE and not session.shouldstop:
        note("", ENDED)
