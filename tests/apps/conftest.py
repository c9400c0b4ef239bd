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
    return train(dnerf, tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture(scope="session")
def other_seed(dnerf, tmp_path_factory) -> Path:
    """The folder of such a run with another seed."""
    return train(dnerf, tmp_path_factory.mktemp("runs") / "seed-1", "--seed", "1")


def train(data: Path, output: Path, *more: str) -> Path:
    done = run_app("train", "--data", str(data), "--output", str(output), "--steps", "60", *SMALL, *more)
    assert done.returncode == 0, done.stderr
    return output
