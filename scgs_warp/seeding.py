"""Random generators that depend on a seed and keys alone."""

from __future__ import annotations

import numpy as np
import torch


def generator(seed: int, *keys: int, device: torch.device | str = "cpu") -> torch.Generator:
    """A random generator that depends on (seed, keys) alone: nothing has to be saved for a run to be resumed."""
    state = np.random.SeedSequence([seed, len(keys), *keys]).generate_state(1, np.uint64)[0]
    return torch.Generator(device=device).manual_seed(int(state) & (2**63 - 1))
