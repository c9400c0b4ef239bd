"""Turned harmonics against their definition in float64, and the laws of a rotation."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import normalize

from reference.harmonics import basis
from reference.harmonics_rotation import rotate_harmonics as twin
from reference.skinning import matrix
from scgs_warp.ops.harmonics_rotation import rotate_harmonics


def inputs(seed: int, n: int, degree: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    rest = torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=generator)
    return rest, torch.randn(n, 4, generator=generator)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize(("seed", "n"), [(0, 1), (1, 333), (2, 0)])
def test_values(seed, n, degree, device):
    rest, quats = inputs(seed, n, degree)
    ours = rotate_harmonics(rest.to(device), quats.to(device))
    assert ours.shape == rest.shape and ours.device.type == device
    torch.testing.assert_close(ours.cpu().double(), twin(rest.double(), quats.double()), rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_the_colour_follows_the_direction(degree):
    """Seen along R d, the turned function shows what the other one showed along d."""
    rest, quats = inputs(3, 40, degree)
    turned = rotate_harmonics(rest, quats).double()
    seen = normalize(torch.randn(40, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64), dim=1)
    R = torch.stack([matrix(q) for q in normalize(quats.double(), dim=1)])
    before = (basis(seen, degree)[:, 1:, None] * rest.double()).sum(1)
    after = (basis((R @ seen[..., None])[..., 0], degree)[:, 1:, None] * turned).sum(1)
    torch.testing.assert_close(after, before, rtol=1e-5, atol=1e-5)
    assert float((turned - rest).abs().max()) > 0.5


def test_the_identity_changes_no_bit(device):
    rest, quats = inputs(4, 64, 3)
    quats[:, 1:] = 0.0
    rest[3, 2, 1] = float("nan")
    out = rotate_harmonics(rest.to(device), quats.to(device)).cpu()
    assert out.view(torch.int32).equal(rest.view(torch.int32))


def test_quaternions_that_make_no_sense_turn_nothing(device):
    rest, quats = inputs(5, 4, 3)
    quats[0], quats[1] = float("nan"), torch.tensor([0.0, float("inf"), 0.0, 0.0])
    quats[2] = 0.0
    out = rotate_harmonics(rest.to(device), quats.to(device)).cpu()
    assert out[:3].equal(rest[:3])
    with pytest.raises(ValueError, match="sh_rest"):
        rotate_harmonics(rest[:, :4], quats)
    with pytest.raises(ValueError, match="quats"):
        rotate_harmonics(rest, quats[:2])


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**31), st.sampled_from([1, 2, 3]))
def test_rotations_compose_and_keep_the_energy_of_each_band(seed, degree):
    rest, quats = inputs(seed, 8, degree)
    other = torch.randn(8, 4, generator=torch.Generator().manual_seed(seed + 1))
    a, b = normalize(quats, dim=1), normalize(other, dim=1)
    product = torch.cat(
        [
            b[:, :1] * a[:, :1] - (b[:, 1:] * a[:, 1:]).sum(1, keepdim=True),
            b[:, :1] * a[:, 1:] + a[:, :1] * b[:, 1:] + torch.linalg.cross(b[:, 1:], a[:, 1:]),
        ],
        dim=1,
    )
    twice = rotate_harmonics(rotate_harmonics(rest, quats), other)
    torch.testing.assert_close(twice, rotate_harmonics(rest, product), rtol=1e-4, atol=1e-4)
    for l in range(1, degree + 1):
        band = slice(l * l - 1, (l + 1) ** 2 - 1)
        torch.testing.assert_close(twice[:, band].norm(dim=1), rest[:, band].norm(dim=1), rtol=1e-4, atol=1e-4)
