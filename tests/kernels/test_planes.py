"""Features and variation of feature planes against float64: values, gradients, borders, non-finite positions."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from reference import planes as twin
from scgs_warp.ops.planes import EVEN, PAIRS, Smoothness, plane_features, plane_variation
from scgs_warp.runtime import environment

EXTENTS = [[(5, 7, 4, 3)], [(8, 8, 8, 5), (16, 16, 16, 5)], [(2, 3, 2, 2), (3, 2, 4, 7)]]
"""x, y, z, t of every level."""


def planes_of(extents: list[tuple[int, ...]], seed: int, device: str = "cpu") -> list[Tensor]:
    random = torch.Generator().manual_seed(seed)
    shapes = [(level[second], level[first], 32) for level in extents for first, second in PAIRS]
    return [(0.5 + torch.rand(shape, generator=random)).to(device).requires_grad_() for shape in shapes]


def positions_of(count: int, seed: int, device: str = "cpu") -> Tensor:
    """A third of the coordinates outside."""
    random = torch.Generator().manual_seed(seed + 50)
    return (3.0 * torch.rand(count, 3, generator=random) - 1.5).to(device).requires_grad_()


WEIGHTS = [EVEN, Smoothness(0.7, 0.0, 2.0), Smoothness(0.0, 3.0, 0.5)]


def compare(positions: Tensor, time: float, planes: list[Tensor], seed: int, weights: Smoothness = EVEN) -> None:
    """Features, variation and all gradients against the twin."""
    found, smooth = plane_features(positions, time, planes), plane_variation(planes, weights)
    own = positions.detach().cpu().double().requires_grad_()
    own_planes = [plane.detach().cpu().double().requires_grad_() for plane in planes]
    expected, expected_smooth = twin.features(own, time, own_planes), twin.variation(own_planes, *weights)
    torch.testing.assert_close(found.cpu().double(), expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(smooth.cpu().double(), expected_smooth, rtol=1e-5, atol=1e-7)
    v = torch.randn(found.shape, generator=torch.Generator().manual_seed(seed))
    gradients = torch.autograd.grad((found, smooth), (positions, *planes), (v.to(found), torch.tensor(3.0).to(found)))
    truth = torch.autograd.grad(
        (expected, expected_smooth), (own, *own_planes), (v.double(), torch.tensor(3.0).double())
    )
    for got, want in zip(gradients, truth):
        torch.testing.assert_close(got.cpu().double(), want, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("time", [0.0, 0.37, 0.5, 1.0])
@pytest.mark.parametrize("count", [1, 2, 16, 37])
@pytest.mark.parametrize("extents", EXTENTS)
def test_values_and_gradients(extents, count, time, seed, device):
    compare(positions_of(count, seed, device), time, planes_of(extents, seed, device), seed)


@pytest.mark.parametrize("weights", WEIGHTS)
@pytest.mark.parametrize("extents", EXTENTS)
def test_each_term_of_the_smoothness(extents, weights, device):
    planes = planes_of(extents, 11, device)
    with torch.no_grad():
        for plane in planes:
            plane[0, 0] = 1.0  # at rest: no slope there
    compare(positions_of(7, 11, device), 0.3, planes, 11, weights)


@pytest.mark.parametrize("time", [0.0, 0.25, 1.0])
def test_exact_texels(time, device):
    """On a texel its value is met exactly, and the slope is that to the next one."""
    planes = planes_of([(5, 5, 5, 5)], 3, device)
    steps = torch.tensor([-1.0, -0.5, 0.0, 0.5, 1.0])
    positions = torch.cartesian_prod(steps, steps, steps).to(device).requires_grad_()
    compare(positions, time, planes, 3)
    where = torch.tensor([[0.5, -1.0, 1.0]], device=device)
    product = torch.ones(32, device=device)
    texel = (3, 0, 4, round(4 * time))
    for (first, second), plane in zip(PAIRS, planes):
        product = product * plane[texel[second], texel[first]]
    torch.testing.assert_close(plane_features(where, time, planes)[0], product, rtol=1e-6, atol=0.0)


def test_the_time_may_be_a_tensor(device):
    planes, positions = planes_of(EXTENTS[0], 12, device), positions_of(7, 12, device)
    found = plane_features(positions, torch.tensor([0.25], device=device), planes)
    assert torch.equal(found, plane_features(positions, 0.25, planes))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 3e38, -3e38])
def test_positions_that_are_not_finite_read_the_border(bad, device):
    planes = planes_of(EXTENTS[0], 5, device)
    positions = positions_of(20, 5).detach()
    positions[11, 1] = 1.0 if bad > 0 else -1.0
    positions = positions.to(device)
    clean = plane_features(positions, 0.4, planes)
    positions[11, 1] = bad
    positions.requires_grad_()
    found = plane_features(positions, 0.4, planes)
    assert torch.equal(found, clean)
    gradients = torch.autograd.grad(found.sum(), (positions, *planes))
    assert all(bool(g.isfinite().all()) for g in gradients)
    assert float(gradients[0][11, 1]) == 0.0 and bool(gradients[0][11].any())


def test_outside_has_no_gradient(device):
    planes = planes_of(EXTENTS[0], 6, device)
    positions = torch.tensor([[-1.0, 0.1, 1.0], [1.2, -0.3, -7.0]], device=device, requires_grad=True)
    (gradient,) = torch.autograd.grad(plane_features(positions, 0.5, planes).sum(), positions)
    assert (gradient != 0).tolist() == [[False, True, False], [False, True, False]]


def test_nobody_there(device):
    planes, positions = planes_of(EXTENTS[1], 7, device), positions_of(0, 7, device)
    found = plane_features(positions, 0.2, planes)
    assert found.shape == (0, 64)
    gradients = torch.autograd.grad(found.sum(), (positions, *planes))
    assert gradients[0].shape == (0, 3)
    assert all(not bool(g.any()) for g in gradients[1:])


def test_variation_of_plain_planes(device):
    planes = planes_of(EXTENTS[2], 8, device)
    flat = [torch.full_like(plane, 0.7) for plane in planes]
    assert float(plane_variation(flat)) == 0.0
    even = [torch.arange(p.shape[0], device=device).float()[:, None, None].expand_as(p).contiguous() for p in planes]
    steps = sum(1.0 for place in range(len(planes)) if place % 6 < 3)
    assert float(plane_variation(even)) == pytest.approx(steps), "an even change in time is no variation"
    away = [torch.full_like(plane, 0.7) for plane in planes]
    assert float(plane_variation(away, Smoothness(1.0, 1.0, 2.0))) == pytest.approx(0.3 * 2.0 * len(planes) / 2)


def test_same_bits_on_any_number_of_threads():
    planes, positions = planes_of([(64, 64, 64, 25), (128, 128, 128, 25)], 9), positions_of(3001, 9)
    results = []
    before = environment.thread_count()
    try:
        for threads in (1, 2, 3, 2):
            environment.configure(threads)
            found, smooth = plane_features(positions, 0.77, planes), plane_variation(planes)
            v = torch.linspace(-1.0, 2.0, found.numel()).view_as(found)
            gradients = torch.autograd.grad((found, smooth), (positions, *planes), (v, torch.tensor(1e3)))
            results.append([found, smooth, *gradients])
    finally:
        environment.configure(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))


def test_refuses_what_does_not_fit():
    planes, positions = planes_of(EXTENTS[0], 10), positions_of(3, 10)
    with pytest.raises(ValueError, match=r"positions must be \[N, 3\]"):
        plane_features(positions[:, :2], 0.0, planes)
    with pytest.raises(ValueError, match="six a level"):
        plane_features(positions, 0.0, planes[:-1])
    with pytest.raises(ValueError, match=r"planes\[1\]"):
        plane_features(positions, 0.0, [planes[0], planes[0], *planes[2:]])
    with pytest.raises(ValueError, match="sides 2 or more"):
        plane_features(positions, 0.0, planes_of([(4, 4, 1, 3)], 10))
    with pytest.raises(ValueError, match="float32"):
        plane_features(positions.double(), 0.0, planes)
