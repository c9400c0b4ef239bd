"""A tiny data set and a run on it, for the tests of the apps."""

from __future__ import annotations

from pathlib import Path

import pytest

from helpers.app_runs import SMALL, run_app
from helpers.tiny import write_dnerf


@pytest.fixture(scope="session")
def dnerf(tmp_path_factory) -> Path:
    """A tiny D-NeRF folder on disk."""
    return write_dnerf(tmp_path_factory.mktemp("data") / "blobs")


@pytest.fixture(scope="session")
def trained(dnerf, tmp_path_factory) -> Path:
    """The folder of a run of 60 steps."""
    output = tmp_path_factory.mktemp("runs") / "run"
    done = run_app("train", "--data", str(dnerf), "--output", str(output), "--steps", "60", *SMALL)
    assert done.returncode == 0, done.stderr
    return output
