"""Begin a run, and act on it between its steps."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.config.presets import TrainConfig
from scgs_warp.data.dataset import Dataset
from scgs_warp.runtime import environment
from scgs_warp.storage import checkpoint
from scgs_warp.training.frames import Frames
from scgs_warp.training.loop import fit
from scgs_warp.training.recorded_step import RecordedSteps
from scgs_warp.training.state import TrainState
from scgs_warp.training.stepping import PlainSteps

PRETENDED = bool(os.environ.get("SCGS_PRETENDED_CUDA"))
"""Whether the GPU is the pretended one, which adds in one order."""


def begin(device: str, steps: int = 60, data: Dataset | None = None, **changes: Any) -> tuple[TrainState, Frames]:
    """Make the state of a tiny run at step 0, and its frames."""
    data = tiny_dataset(6) if data is None else data
    state = TrainState.begin(tiny_config(steps, **changes), data, device)
    return state, Frames(data, state.normalisation, state.config, device)


def before_each_step(monkeypatch: pytest.MonkeyPatch, act: Callable[[TrainState], None]) -> None:
    """Call ``act`` before each step of ``fit``, when all steps before it are known."""
    for kind in (PlainSteps, RecordedSteps):

        def acting(self, take=kind.take):
            results = self.settle()
            act(self._state)
            return [*results, *take(self)]

        monkeypatch.setattr(kind, "take", acting)


class Crash(Exception):
    pass


def check_same_bits(
    config: TrainConfig, data: Dataset, folder: Path, device: str, monkeypatch: pytest.MonkeyPatch, step: int
) -> Path:
    """Assert that a run gives the same bits on two, one and three threads, and if it crashes before a step and is
    resumed. Return its checkpoint."""
    results = {}
    for name, threads in (("two", 2), ("one", 1), ("three", 3)):
        environment.configure(threads)
        fit(config, data, output=folder / name, device=device)
        results[name] = (folder / name / "checkpoint.safetensors").read_bytes()
    assert results["one"] == results["two"] == results["three"]

    def crash(state: TrainState) -> None:
        if state.step == step:
            raise Crash

    saving = dataclasses.replace(config, checkpoint_seconds=0.0)
    with monkeypatch.context() as patched:
        before_each_step(patched, crash)
        with pytest.raises(Crash):
            fit(saving, data, output=folder / "crashed", device=device)
    fit(saving, data, output=folder / "crashed", device=device, resume=True)
    assert (folder / "crashed" / "checkpoint.safetensors").read_bytes() == results["two"]
    return folder / "two" / "checkpoint.safetensors"


def check_resumed(
    config: TrainConfig, data: Dataset, folder: Path, device: str, monkeypatch: pytest.MonkeyPatch, step: int
) -> dict[str, Tensor]:
    """Assert that a run that is saved and stopped before a step, and resumed, gives the same tensors as a whole one.
    Return them."""
    whole, parts = folder / "whole", folder / "parts"
    fit(config, data, output=whole, device=device)

    def interrupt(state: TrainState) -> None:
        if state.step == step:
            state.save(parts)
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        before_each_step(patch, interrupt)
        fit(config, data, output=parts, device=device)
    fit(config, data, output=parts, device=device, resume=True)
    tensors, resumed = (checkpoint.read(run)[0] for run in (whole, parts))
    assert tensors.keys() == resumed.keys() and all(torch.equal(tensors[name], resumed[name]) for name in tensors)
    return tensors
