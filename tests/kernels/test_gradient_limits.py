"""Limits of gradients: what is kept, and what counts as beyond them."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from scgs_warp.kernels import gradient_limits
from scgs_warp.kernels.types import GRADIENT_MAX
from scgs_warp.runtime.launch import launch

LARGEST = float(GRADIENT_MAX)


@wp.kernel(enable_backward=False)
def limit(first: int, values_in: wp.array[wp.vec4], kept_out: wp.array[wp.vec4], beyond_out: wp.array2d[int]):
    i = first + wp.tid()
    v = values_in[i]
    kept_out[i] = gradient_limits.passed(v)
    beyond_out[i, 0] = gradient_limits.beyond(v)
    beyond_out[i, 1] = gradient_limits.beyond(wp.vec3(v[0], v[1], v[2]))


def test_components_beyond_the_limit_are_dropped_and_counted():
    """Against NumPy, with every component beyond the limit by itself, in both directions, and NaN."""
    values = np.tile(np.array([1.0, -2.0, 0.0, LARGEST], np.float32), (13, 1))
    for row in range(12):
        values[row, row % 4] = (2.0 * LARGEST, -np.inf, np.nan)[row // 4]
    with np.errstate(invalid="ignore"):
        inside = np.abs(values) <= np.float32(LARGEST)
    kept, counts = torch.full((13, 4), 7.0), torch.zeros((13, 2), dtype=torch.int32)
    launch(limit, 13, torch.from_numpy(values), kept, counts)
    np.testing.assert_array_equal(kept.numpy(), np.where(inside, values, 0.0))
    np.testing.assert_array_equal(counts[:, 0].numpy(), (~inside).sum(1))
    np.testing.assert_array_equal(counts[:, 1].numpy(), (~inside[:, :3]).sum(1))
