"""One seed, one checkpoint: however often, on however many threads, in however many pieces (docs/trust.md)."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from helpers.steps import before_each_step
from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.config.presets import TrainConfig
from scgs_warp.runtime import environment
from scgs_warp.training.loop import fit
from scgs_warp.training.state import TrainState

MODELS = {
    # large enough for torch to share work among threads, which it does from 32,768 numbers on
    "control-points": {"init_points": 14000, "densify": {"grad_threshold": 1e-5}},
    "control-points, stage 1 by gradient": {
        "init_random": "cube",
        "pretrain": {"densify_by": "gradient", "densify_every": 1, "grad_threshold": 1e-6, "max_ratio": 3.0},
        "densify": {"opacity_reset_every": 2},
    },
    "control-points, in chunks": {},
    "per-gaussian": {},
    "hexplane": {},
    "static": {},
}
STOPS = (0, 3, 8, 21, 40)
"""Stage 1 ends at step 5, and Gaussians are added at 15, 25, 35."""


class Crash(Exception):
    pass


def trained(config: TrainConfig, folder: Path, threads: int, device: str, resume: bool = False) -> bytes:
    environment.configure(threads)
    fit(config, tiny_dataset(6), output=folder, device=device, resume=resume)
    return (folder / "checkpoint.safetensors").read_bytes()


@pytest.mark.parametrize("model", MODELS)
def test_the_same_bits(model, tmp_path, device, all_threads, monkeypatch):
    if device == "cuda" and model == "hexplane":
        pytest.skip("torch's grid_sample adds in any order on CUDA: no promise there")
    motion = {"model": model.partition(",")[0], "chunks": 5 if "chunks" in model else 1}  # frames lie on borders
    config = tiny_config(STOPS[-1], motion=motion, **MODELS[model])
    whole = trained(config, tmp_path / "whole", 2, device)
    assert trained(config, tmp_path / "again", 2, device) == whole, "two runs differ"
    for threads in (1, 3):
        assert trained(config, tmp_path / f"{threads}", threads, device) == whole, f"{threads} threads differ from 2"
    assert trained(tiny_config(STOPS[-1], seed=1), tmp_path / "other", 2, device) != whole

    config = replace(config, checkpoint_seconds=0.0)
    for index, (begin, end) in enumerate(pairwise(STOPS)):

        def crash(state, end=end):
            if state.step == end:
                raise Crash

        threads = 1 + index % 3
        if end < STOPS[-1]:
            with monkeypatch.context() as patch, pytest.raises(Crash):
                before_each_step(patch, crash)
                trained(config, tmp_path / "pieces", threads, device, resume=begin > 0)
        else:
            assert trained(config, tmp_path / "pieces", threads, device, resume=True) == whole, "resumed runs differ"


RIVALS = [("hexplane", False), ("per-gaussian", False), ("per-gaussian", True)]
"""Model, and whether its network learns in bfloat16."""


@pytest.mark.parametrize("model, bfloat16", RIVALS)
def test_rivals_past_their_coarse_steps(model, bfloat16, tmp_path, all_threads, monkeypatch):
    data, config = (
        tiny_dataset(6),
        tiny_config(30, motion={"model": model, "bfloat16": bfloat16}, coarse=6, checkpoint_seconds=0.0),
    )
    results = []
    for threads in (1, 2):
        environment.configure(threads)
        fit(config, data, output=tmp_path / f"{threads}")
        results.append((tmp_path / f"{threads}/checkpoint.safetensors").read_bytes())
    assert results[0] == results[1], "one thread and two differ"
    save = TrainState.save

    def save_and_stop(state: TrainState, folder) -> None:
        save(state, folder)
        if state.step == 17:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(TrainState, "save", save_and_stop)
        with pytest.raises(KeyboardInterrupt):
            fit(config, data, output=tmp_path / "cut")
    fit(config, data, output=tmp_path / "cut", resume=True)
    assert (tmp_path / "cut/checkpoint.safetensors").read_bytes() == results[0]
