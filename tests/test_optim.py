"""Adam: its state is saved and loaded whole."""

from __future__ import annotations

import torch

from helpers.gaussian_rows import RATES, make
from scgs_warp.gaussians import GaussianParameters
from scgs_warp.optim import Adam


def test_optimizer_round_trip(device):
    gaussians, optimizer = make(3, device)
    saved = {name: value.clone() for name, value in optimizer.tensors("a").items()}
    fresh = Adam(dict(gaussians.named_parameters()), RATES)
    fresh.load_tensors("a", saved)
    again = fresh.tensors("a")
    assert len(saved) == 3 * len(GaussianParameters.NAMES)
    assert again.keys() == saved.keys() and all(torch.equal(again[k], saved[k]) for k in saved)
