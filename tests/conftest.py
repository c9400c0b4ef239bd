"""Fixtures: devices that are present, thread counts, data sets at hand; the number of processes that run the tests;
and the list of what was skipped."""

from __future__ import annotations

import gc
import os
from pathlib import Path
from typing import Any

import pytest

import scgs_warp  # noqa: F401  (sets the environment before torch is imported)
from helpers import skipped

import torch  # isort: skip

from scgs_warp.runtime import environment, memory

THREADS = 1 if "PYTEST_XDIST_WORKER" in os.environ else None
"""Threads of a process of tests: where several share the cores, helpers would only wait for each other."""

environment.configure(THREADS)

PRETENDED = bool(os.environ.get("SCGS_PRETENDED_CUDA"))
collect_ignore = [] if PRETENDED else ["pretended_cuda"]

MEMORY_PER_PROCESS = 2.5 * 2**30
"""Bytes that a process of tests and the programs that it starts may need."""
MOST_PROCESSES = 8

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Return how many processes run the tests: one more than cores, since some tests wait for programs; none but this
    one for single files, for a debugger, and where there is a GPU, whose memory they would share."""
    folders = all(Path(argument.partition("::")[0]).is_dir() for argument in config.args)
    gpu = torch.cuda.is_available() and not PRETENDED
    if not folders or config.getoption("usepdb") or gpu:
        return 0
    room = min(memory.free_on_host()) / MEMORY_PER_PROCESS
    return int(max(1, min(environment.available_threads() + 1, MOST_PROCESSES, room)))


def pytest_collection_finish() -> None:
    """Spare the garbage collector the objects of libraries and of thousands of tests."""
    gc.collect()
    gc.freeze()


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    """``cpu`` always, ``cuda`` where there is one."""
    return request.param


@pytest.fixture
def all_threads():
    """Restore the thread count after the test."""
    yield
    environment.configure(THREADS)


@pytest.fixture
def data_root() -> Path:
    """The folder named by SCGS_DATA (with dnerf/, splats/, ...); tests that need it are skipped where it is absent."""
    root = os.environ.get("SCGS_DATA", "")
    if not root or not Path(root).is_dir():
        pytest.skip("SCGS_DATA does not name a folder of data sets")
    return Path(root)


def _reasons(config: pytest.Config) -> list[str]:
    reporter: Any = config.pluginmanager.get_plugin("terminalreporter")
    reports = reporter.stats.get("skipped", []) if reporter is not None else []
    return [str(report.longrepr[2]) for report in reports if isinstance(report.longrepr, tuple)]


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail where a test was skipped for want of something that this machine should have (``SCGS_NEEDS``)."""
    if skipped.needed_here(_reasons(session.config)) and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Say at the end what was not tested, and how to get what that needs."""
    reasons = _reasons(terminalreporter.config)
    for index, line in enumerate(skipped.lines(reasons)):
        if index == 0:
            terminalreporter.section("not tested here")
        terminalreporter.write_line(line)
    for name in skipped.needed_here(reasons):
        terminalreporter.write_line(f"failed: this machine should have {name} ({skipped.VARIABLE})", red=True)
