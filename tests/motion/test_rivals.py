"""The other motion models in training: first at rest, then in motion, to the same bits on any number of threads."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.config.presets import TrainConfig, preset, with_steps
from scgs_warp.motion.control_points import make_network
from scgs_warp.motion.per_gaussian import PER_GAUSSIAN_HEADS
from scgs_warp.runtime import environment
from scgs_warp.training.density_control import control_density
from scgs_warp.training.frames import Frames
from scgs_warp.training.loop import fit
from scgs_warp.training.state import TrainState
from scgs_warp.training.step import training_step

RIVALS = [("hexplane", False), ("per-gaussian", False), ("per-gaussian", True)]
"""Model, and whether its network learns in bfloat16."""


def config_of(model: str, bfloat16: bool = False, steps: int = 30, **changes) -> TrainConfig:
    return tiny_config(steps, motion={"model": model, "bfloat16": bfloat16}, coarse=6, **changes)


@pytest.mark.parametrize("model, bfloat16", RIVALS)
def test_same_bits_whatever_the_threads_and_when_resumed(model, bfloat16, tmp_path, all_threads, monkeypatch):
    data, config = tiny_dataset(6), config_of(model, bfloat16, checkpoint_seconds=0.0)
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


def test_gradients_of_the_network_in_bfloat16(all_threads):
    """At the size of a scene: there oneDNN cuts sums over the rows by the number of threads, where the CPU has AMX."""
    config = dataclasses.replace(preset("quick").motion, model="per-gaussian", bfloat16=True)
    random = torch.Generator().manual_seed(3)
    network = make_network(config, PER_GAUSSIAN_HEADS, 0).train()
    positions, times = torch.randn(9_999, 3, generator=random), torch.tensor([0.3])
    torch.nn.init.normal_(network.head.weight, std=0.1, generator=random)
    weights = torch.randn(10, generator=random)

    def gradients(threads: int) -> list[torch.Tensor]:
        environment.configure(threads)
        network.zero_grad()
        out = torch.cat(list(network(positions, times).values()), dim=-1)
        (out * weights).mean().backward()
        return [parameter.grad.clone() for parameter in network.parameters() if parameter.grad is not None]

    one, two = gradients(1), gradients(2)
    assert len(one) == len(list(network.parameters()))
    assert all(torch.equal(a, b) for a, b in zip(one, two))
    network.low_precision = False
    exact = gradients(1)
    for a, b in zip(one, exact):
        assert b.norm() > 0.0 and (a - b).norm() < 0.05 * b.norm(), float((a - b).norm() / b.norm())


@pytest.mark.parametrize("model", ["hexplane", "per-gaussian"])
def test_the_motion_rests_through_the_coarse_steps(model):
    data, config = tiny_dataset(6), config_of(model)
    state = TrainState.begin(config, data, "cpu")
    frames = Frames(data, state.normalisation, config, "cpu")
    before = [parameter.detach().clone() for parameter in state.motion.parameters()]
    for step in range(config.coarse + 2):
        training_step(state, frames)
        control_density(state, (48, 48))
        state.step += 1
        same = [torch.equal(old, new) for old, new in zip(before, state.motion.parameters())]
        assert all(same) if step < config.coarse else not all(same), step


def test_presets_begin_at_rest_for_as_long_as_the_published_ones():
    """3,000 of 40,000 steps (Deformable-3D-GS) to 3,000 of 23,000 (4D-GS)."""
    for config in (preset("paper"), preset("cpu"), preset("quick"), with_steps(preset("cpu"), 900)):
        assert 0.07 <= config.coarse / config.steps <= 0.13
        assert config.rest_steps == config.freeze
