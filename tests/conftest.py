"""Fixtures: devices that are present, thread counts, data sets at hand."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import scgs_warp  # noqa: F401  (sets the environment before torch is imported)

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
