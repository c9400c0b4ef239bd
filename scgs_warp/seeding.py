"""Random generators that depend on a seed and keys alone."""

from __future__ import annotations

import numpy as np
import torch


def generator(seed: int, *keys: int, device: torch.device | str = "cpu") -> torch.Generator:
    """Return a random generator that depends on (seed, keys) alone, so that a resumed run needs no saved state."""
    state = np.random.SeedSequence([seed, len(keys), *keys]).generate_state(1, np.uint64)[0]
    return torch.Generator(device=device).manual_seed(int(state) & (2**63 - 1))
