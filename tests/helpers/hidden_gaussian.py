"""A training state with one Gaussian that no camera sees, for tests of visibility pruning."""

from __future__ import annotations

import torch

from helpers.tiny import tiny_config, tiny_dataset
from scgs_warp.training.frames import Frames
from scgs_warp.training.state import TrainState


def state_with_hidden_gaussian(**densify) -> tuple[TrainState, Frames]:
    """Start the main stage with the last Gaussian hidden inside the others."""
    data = tiny_dataset(6)
    schedule = {"until": 40, "opacity_reset_every": 20, "every": 1_000, "faint_share": 0.0, **densify}
    config = tiny_config(60, motion={"model": "static"}, densify=schedule)
    state = TrainState.begin(config, data, "cpu")
    with torch.no_grad():
        state.gaussians.opacity_logits.fill_(9.0)
        state.gaussians.log_scales.fill_(-1.0)
        state.gaussians.log_scales[-1] = -6.0
        state.gaussians.means[-1] = state.gaussians.means[:-1].mean(0)
    return state, Frames(data, state.normalisation, config, "cpu")
