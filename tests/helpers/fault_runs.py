"""Runs for tests of faults: what they should come to, and something that happens on the way. Fixtures are named in the
modules that use them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from helpers.tiny import tiny_config, tiny_dataset, write_dnerf
from scgs_warp.config.presets import TrainConfig
from scgs_warp.errors import UserError
from scgs_warp.storage import checkpoint
from scgs_warp.training import loop, run
from scgs_warp.training.loop import fit

STEPS = 40
HERE = 20
"""The step at which something goes wrong."""
FRAMES = 6


def config(**changes) -> TrainConfig:
    return tiny_config(STEPS, **changes)


def often(**changes) -> TrainConfig:
    """With a checkpoint after every step."""
    return config(checkpoint_seconds=0.0, **changes)


def bits(folder: Path) -> bytes:
    return (folder / checkpoint.FILE).read_bytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> bytes:
    """The checkpoint of a run that nothing has happened to."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    fit(config(), tiny_dataset(FRAMES), output=folder)
    return bits(folder)


@pytest.fixture
def at_step(monkeypatch) -> Callable[[int, Callable[[], object]], None]:
    """Lets something happen before a step, once."""

    def happen(number: int, action: Callable[[], object]) -> None:
        inner, left = loop.training_step, [action]

        def step(state, frames):
            if state.step == number and left:
                left.pop()()
            return inner(state, frames)

        monkeypatch.setattr(loop, "training_step", step)

    return happen


def refused(folder: Path, made: TrainConfig, data=None, **options) -> str:
    """The one line that a run ends with."""
    with pytest.raises(UserError) as caught:
        fit(made, data or tiny_dataset(FRAMES), output=folder, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def go_on(folder: Path, made: TrainConfig | None = None) -> bytes:
    fit(made or config(), tiny_dataset(FRAMES), output=folder, resume=True)
    return bits(folder)


def warnings(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith("warning: ")]


@pytest.fixture
def images(tmp_path) -> Path:
    return write_dnerf(tmp_path / "data", size=24)


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> tuple[Path, Path]:
    """A data set, and a run on it that is complete."""
    folder = tmp_path_factory.mktemp("done")
    data = write_dnerf(folder / "data", size=24)
    run.train_and_evaluate(config(), data, folder / "run", frames=2)
    return data, folder / "run"
