"""The centre of projection of a camera."""

from __future__ import annotations

import pytest
import torch

from scgs_warp.types import Camera


@pytest.mark.parametrize("learnt", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_the_centre_of_projection_is_what_the_view_puts_at_the_origin(seed, learnt, device):
    random = torch.Generator().manual_seed(seed)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.linalg.qr(torch.randn(3, 3, generator=random))[0]
    viewmat[:3, 3] = torch.randn(3, generator=random)
    camera = Camera(viewmat.to(device).requires_grad_(learnt), torch.eye(3, device=device), 4, 4)
    position = camera.position
    assert position.shape == (3,) and position.dtype == torch.float32 and position.device.type == device
    assert position.requires_grad == learnt
    there = viewmat[:3, :3].double() @ position.detach().cpu().double() + viewmat[:3, 3].double()
    assert float(there.abs().max()) < 1e-6
