"""Training runs for tests of faults: an undisturbed reference, and actions before a chosen step."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from helpers.tiny import tiny_config, tiny_dataset, write_dnerf
from scgs_warp.config.presets import TrainConfig
from scgs_warp.errors import UserError
from scgs_warp.storage import checkpoint
from scgs_warp.training import run, stepping
from scgs_warp.training.loop import fit

STEPS = 40
FAULT_STEP = 20
"""Step before which a test causes its fault."""
FRAMES = 6


def config(**changes) -> TrainConfig:
    return tiny_config(STEPS, **changes)


def every_step(**changes) -> TrainConfig:
    """Return a configuration that writes a checkpoint after every step."""
    return config(checkpoint_seconds=0.0, **changes)


def checkpoint_bytes(folder: Path) -> bytes:
    return (folder / checkpoint.FILE).read_bytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> bytes:
    """Checkpoint of an undisturbed run."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    fit(config(), tiny_dataset(FRAMES), output=folder)
    return checkpoint_bytes(folder)


@pytest.fixture
def at_step(monkeypatch) -> Callable[[int, Callable[[], object]], None]:
    """Run an action once, before a given step."""

    def happen(number: int, action: Callable[[], object]) -> None:
        inner, left = stepping.training_step, [action]

        def step(state, frames):
            if state.step == number and left:
                left.pop()()
            return inner(state, frames)

        monkeypatch.setattr(stepping, "training_step", step)

    return happen


def refusal(folder: Path, made: TrainConfig, data=None, **options) -> str:
    """Return the one line with which a run ends."""
    with pytest.raises(UserError) as caught:
        fit(made, data or tiny_dataset(FRAMES), output=folder, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def resume(folder: Path, made: TrainConfig | None = None) -> bytes:
    fit(made or config(), tiny_dataset(FRAMES), output=folder, resume=True)
    return checkpoint_bytes(folder)


def warnings(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("warning: ")]


@pytest.fixture
def images(tmp_path) -> Path:
    return write_dnerf(tmp_path / "data", size=24)


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> tuple[Path, Path]:
    """A data set and a complete run on it."""
    folder = tmp_path_factory.mktemp("done")
    data = write_dnerf(folder / "data", size=24)
    run.train_and_evaluate(config(), data, folder / "run", frames=2)
    return data, folder / "run"
