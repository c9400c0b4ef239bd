"""Fixtures: devices that are present, thread counts, data sets at hand; and the list of what was skipped."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

import scgs_warp  # noqa: F401  (sets the environment before torch is imported)
from helpers import skipped

import torch  # isort: skip

from scgs_warp.runtime import environment

environment.configure()

collect_ignore = [] if os.environ.get("SCGS_PRETENDED_CUDA") else ["pretended_cuda"]

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    """``cpu`` always, ``cuda`` where there is one."""
    return request.param


@pytest.fixture
def all_threads():
    """Restore the thread count after the test."""
    yield
    environment.configure()


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
