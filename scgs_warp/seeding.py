"""Random generators that depend on a seed and keys alone."""

from __future__ import annotations

import numpy as np
import torch


class Purpose:
    """First keys of the generators of a run. The number of keys counts, too: a purpose with a step draws other numbers
    than the same one without."""

    NETWORK = 11
    PLANES = 12
    ARAP_TIMES = 21
    ARAP_TIMES_OF_SPHERES = 22
    RANDOM_POINTS = 31
    DATA_POINTS = 32
    CLONED_SPHERES = 32
    """With a step, unlike the points of the data."""
    SPLIT_SPHERES = 33
    GAUSSIANS_OF_SPHERES = 34
    BACKGROUND_POINTS = 35
    MOVING_POINTS = 36
    FRAME_ORDER = 41
    BACKGROUND = 42
    TIME_NOISE = 43
    TURNS = 44
    SILHOUETTE_PIXELS = 45
    FLOW_FRAME = 46
    BODY_TURN = 47
    SPLIT_GAUSSIANS = 51
    RESTING_POINTS = 51
    """Without a step, unlike the halves of split Gaussians."""
    VISIBILITY_VIEWS = 52
    CLOUDS = 52
    """Without a step, unlike the views of visibility pruning."""
    CLOUD_POINTS = 53


def generator(seed: int, *keys: int, device: torch.device | str = "cpu") -> torch.Generator:
    """Return a random generator that depends on (seed, keys) alone, so that a resumed run needs no saved state."""
    state = np.random.SeedSequence([seed, len(keys), *keys]).generate_state(1, np.uint64)[0]
    return torch.Generator(device=device).manual_seed(int(state) & (2**63 - 1))
