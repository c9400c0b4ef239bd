"""The network's inputs in one launch: against the definition of the encoding in float64."""

from __future__ import annotations

import pytest
import torch

from scgs_warp.motion.network import encode, rows_of
from scgs_warp.ops.encoding import encode_rows


@pytest.mark.parametrize("frequencies", [(0, 0), (10, 6), (3, 8)])
@pytest.mark.parametrize(("count", "instants"), [(0, 1), (1, 0), (1, 1), (70, 1), (13, 3)])
def test_rows_are_every_position_at_every_time(count, instants, frequencies, device):
    random = torch.Generator().manual_seed(count)
    positions, times = torch.randn(count, 3, generator=random), torch.rand(instants, generator=random)
    found = encode_rows(positions.to(device), times.to(device), *frequencies)
    parts = encode(positions.double(), frequencies[0]), encode(times.double()[:, None], frequencies[1])
    expected = rows_of(*parts)
    assert found.shape == expected.shape and found.device.type == device
    torch.testing.assert_close(found.cpu().double(), expected, rtol=1e-5, atol=2e-6)
