"""Column sums in a fixed order."""

from __future__ import annotations

import pytest
import torch

from scgs_warp.ops.reduction import sum_rows
from scgs_warp.runtime import environment


@pytest.mark.parametrize("rows", [0, 1, 2, 63, 64, 65, 4096, 4097, 100_003])
def test_against_float64(rows, device):
    values = torch.randn(rows, 5, generator=torch.Generator().manual_seed(rows)).to(device)
    expected = values.double().sum(0)
    assert sum_rows(values).shape == (5,)
    # A tree loses digits with the logarithm of the rows, not with their number.
    torch.testing.assert_close(sum_rows(values).double(), expected, rtol=0, atol=1e-6 * (1 + rows**0.5))


def test_same_bits_for_any_thread_count(all_threads):
    values = torch.randn(50_000, 12, generator=torch.Generator().manual_seed(0))
    sums = []
    for threads in (1, 2, 3):
        environment.configure(threads=threads)
        sums.append(sum_rows(values))
    assert torch.equal(sums[0], sums[1]) and torch.equal(sums[0], sums[2])


def test_wrong_shape_is_named():
    with pytest.raises(ValueError, match="values"):
        sum_rows(torch.zeros(3))
