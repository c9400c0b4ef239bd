"""Colours that follow the turn of their surface: against plain torch in float64, and the laws they obey."""

from __future__ import annotations

import functools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.gradients import value_and_gradients
from reference.shading import shade as shade_reference
from reference.shading import tint as tint_reference
from scgs_warp.ops import shading as ops
from scgs_warp.runtime import environment


def form_of(request, device, op):
    if request.param == "cpu" and device != "cpu":
        pytest.skip("SIMD is for the CPU")
    return functools.partial(op, form=request.param)


@pytest.fixture(params=["plain", "cpu"])
def shade(request, device):
    return form_of(request, device, ops.shade)


@pytest.fixture(params=["plain", "cpu"])
def tint(request, device):
    return form_of(request, device, ops.tint)


def draw(seed, n, device="cpu", spread=0.8):
    g = torch.Generator().manual_seed(seed)
    values = torch.randn(n, 3, generator=g), spread * torch.randn(n, 10, generator=g)
    turns = torch.randn(n, 4, generator=g), torch.randn(n, 4, generator=g)
    return [x.to(device) for x in (*values, *turns)]


@pytest.mark.parametrize("n", [0, 1, 2, 16, 257])
@pytest.mark.parametrize("seed", range(3))
def test_values_and_gradients(seed, n, device, shade):
    inputs = draw(seed, n, device)
    weights = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed))
    ours, ours_grad = value_and_gradients(shade, inputs, weights, learnt=2)
    twin, twin_grad = value_and_gradients(shade_reference, [x.double() for x in inputs], weights, learnt=2)
    assert ours.shape == (n, 3) and ours.device.type == device
    torch.testing.assert_close(ours.double(), twin, rtol=1e-5, atol=2e-5)
    for a, b in zip(ours_grad, twin_grad, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=1e-4, atol=1e-5)
    if n == 257:  # the limits are reached, on both sides, or the test says nothing of them
        gain = (0.5 + 0.28209479 * ours) / (0.5 + 0.28209479 * inputs[0])
        assert (gain < 1e-4).any() and (gain > 3.999).any()


def test_nothing_changes_at_rest_whatever_the_norm(device, shade):
    sh_dc, shading, quats, _ = draw(5, 50, device)
    torch.testing.assert_close(shade(sh_dc, shading, quats, -3.0 * quats), sh_dc, rtol=1e-5, atol=1e-5)


def test_a_lambertian_surface_under_one_lamp(device, shade):
    """G = e n^T / (c + e.n) is exactly a surface with normal n in ambient light c and a distant lamp e."""
    normal, lamp, ambient = torch.tensor([0.0, 0.6, 0.8]), torch.tensor([0.3, 0.0, 0.5]), 0.7
    angle = 0.9
    quat = torch.tensor([[math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0]])
    turned = torch.tensor(
        [0.0, 0.6 * math.cos(angle) - 0.8 * math.sin(angle), 0.6 * math.sin(angle) + 0.8 * math.cos(angle)]
    )
    before, after = ambient + lamp @ normal, ambient + lamp @ turned
    matrix = torch.nn.functional.pad((torch.outer(lamp, normal) / before).reshape(1, 9), (0, 1))
    rest = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    albedo = torch.tensor([[0.2, 0.5, 0.1]])
    sh_dc = (albedo * before - 0.5) / 0.28209479177387814
    found = shade(*(x.to(device) for x in (sh_dc, matrix, rest, quat))).cpu() * 0.28209479177387814 + 0.5
    torch.testing.assert_close(found, albedo * after, rtol=1e-5, atol=1e-6)


@settings(deadline=None, max_examples=25)
@given(st.lists(st.integers(-9, 9), min_size=4, max_size=4), st.lists(st.integers(-30, 30), min_size=9, max_size=9))
def test_a_common_turn_of_both_changes_nothing_but_the_frame(values, matrix):
    """Turning rest and pose by q alike gives R' = q R q*, so G' = Q G Q^T shades the same."""
    from reference.quaternion import multiply, normalise, to_matrix

    q = normalise(torch.tensor([values]).double())
    sh_dc, _, quats, quats_t = (x.double() for x in draw(3, 1))
    G = torch.tensor(matrix).double().view(1, 3, 3) / 40
    Q = to_matrix(q)
    moved = (Q @ G @ Q.transpose(1, 2)).reshape(1, 9)
    bend = torch.full((1, 1), 0.1)
    still, moved = (torch.cat([x.reshape(1, 9).float(), bend], 1) for x in (G, moved))
    plain = ops.shade(sh_dc.float(), still, quats.float(), quats_t.float())
    both = ops.shade(sh_dc.float(), moved, multiply(q, quats).float(), multiply(q, quats_t).float())
    torch.testing.assert_close(both, plain, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 3e38])
def test_what_is_not_finite_shades_nothing_and_passes_no_gradient_to_the_matrix(bad, device, shade):
    sh_dc, shading, quats, quats_t = draw(2, 4, device)
    shading[0, 3] = bad
    quats_t[1, 2] = bad
    quats[2, 0] = bad
    shading.requires_grad_()
    out = shade(sh_dc, shading, quats, quats_t)
    assert torch.isfinite(out).all()
    out.sum().backward()
    assert torch.isfinite(shading.grad).all()


@pytest.mark.parametrize("bend", [1e10, -1e10, 3e38])
def test_a_gain_beyond_float32_is_one_and_learns_nothing(bend, device, shade):
    """x and x^2 are finite; only their product with b is not."""
    sh_dc, shading, quats, quats_t = draw(4, 3, device, spread=0.05)
    shading[1, :9] = 1e15
    shading[1, 9] = bend
    sh_dc, shading = sh_dc.requires_grad_(), shading.requires_grad_()
    out = shade(sh_dc, shading, quats, quats_t)
    torch.testing.assert_close(out[1], sh_dc[1], rtol=1e-6, atol=1e-6)
    out.sum().backward()
    assert not shading.grad[1].any() and shading.grad[0].any() and shading.grad[2].any()
    assert (sh_dc.grad[1] == 1).all()


@pytest.mark.parametrize("which", range(4))
def test_wrong_shapes_are_named(which):
    inputs = draw(0, 3)
    inputs[which] = inputs[which][:, :-1]
    with pytest.raises(ValueError, match=("sh_dc", "shading", "quats", "quats_t")[which]):
        ops.shade(*inputs)


@pytest.mark.parametrize("n", [0, 1, 2, 16, 257])
def test_tints_and_their_gradients(n, device, tint):
    g = torch.Generator().manual_seed(n)
    inputs = [torch.randn(n, 3, generator=g).to(device), (2.0 * torch.randn(n, 3, generator=g)).to(device)]
    weights = torch.randn(n, 3, generator=g)
    ours, ours_grad = value_and_gradients(tint, inputs, weights)
    twin, twin_grad = value_and_gradients(tint_reference, [x.double() for x in inputs], weights)
    assert ours.shape == (n, 3) and ours.device.type == device
    torch.testing.assert_close(ours.double(), twin, rtol=1e-5, atol=1e-5)
    for a, b in zip(ours_grad, twin_grad, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=1e-4, atol=1e-5)
    if n == 257:  # both limits are reached, where a tint learns nothing
        outside = (inputs[1] < -3) | (inputs[1] > 1)
        assert (inputs[1] < -3).any() and (inputs[1] > 1).any()
        assert not ours_grad[1][outside].any() and ours_grad[1][~outside].all()


def test_a_tint_of_zero_and_a_non_finite_one_change_nothing(device, tint):
    sh_dc = torch.randn(4, 3, generator=torch.Generator().manual_seed(1)).to(device)
    tints = torch.tensor([0.0, math.nan, math.inf, -math.inf])[:, None].repeat(1, 3).to(device).requires_grad_()
    out = tint(sh_dc, tints)
    torch.testing.assert_close(out, sh_dc, rtol=1e-6, atol=1e-6)
    out.sum().backward()
    assert torch.isfinite(tints.grad).all() and not tints.grad[1:].any()


def test_a_tint_at_a_limit_learns_nothing(device, tint):
    tints = torch.tensor([-3.0, -2.999, 0.999, 1.0])[:, None].repeat(1, 3).to(device).requires_grad_()
    tint(torch.ones(4, 3, device=device), tints).sum().backward()
    assert tints.grad.bool().all(dim=1).tolist() == [False, True, True, False] and not tints.grad[[0, 3]].any()


@pytest.mark.parametrize("which", range(2))
def test_wrong_shapes_of_tints_are_named(which):
    inputs = [torch.zeros(3, 3), torch.zeros(3, 3)]
    inputs[which] = inputs[which][:, :-1]
    with pytest.raises(ValueError, match=("sh_dc", "tints")[which]):
        ops.tint(*inputs)


def test_forms_agree_on_what_to_leave_out():
    """Extreme and non-finite values, one kind in each row: the SIMD form limits the gains and gradients that the
    portable form does, and no others."""
    sh_dc, shading, quats, quats_t = draw(3, 60)
    tints = torch.randn(60, 3, generator=torch.Generator().manual_seed(4))
    extremes = (math.nan, math.inf, -math.inf, 3e38, -3e38, 1e30, 0.0)
    for row, value in enumerate(extremes):
        for offset, tensor in enumerate((sh_dc, shading, quats, quats_t, tints)):
            tensor[5 * row + offset, 2] = value
    shading[36, 9], shading[37, 9] = math.inf, 3e38
    weights = torch.randn(60, 3, generator=torch.Generator().manual_seed(3))
    weights[40], weights[41, 1] = 3e38, math.nan
    for op, inputs in ((ops.shade, [sh_dc, shading, quats, quats_t]), (ops.tint, [sh_dc, tints])):
        (plain, plain_grad), (lanes, lanes_grad) = (
            value_and_gradients(functools.partial(op, form=form), inputs, weights, learnt=2)
            for form in ("plain", "cpu")
        )
        torch.testing.assert_close(lanes, plain, rtol=1e-5, atol=2e-5, equal_nan=True)
        for a, b in zip(lanes_grad, plain_grad, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-4, atol=2e-5, equal_nan=True)


def test_the_cpu_takes_the_simd_form():
    sh_dc, shading, quats, quats_t = draw(6, 50)
    for op, inputs in ((ops.shade, (sh_dc, shading, quats, quats_t)), (ops.tint, (sh_dc, sh_dc))):
        torch.testing.assert_close(op(*inputs), op(*inputs, form="cpu"), rtol=0, atol=0)
        assert not torch.equal(op(*inputs), op(*inputs, form="plain")), "the forms round differently"


def test_same_bits_for_any_thread_count(all_threads):
    inputs, weights = draw(4, 5000), torch.randn(5000, 3, generator=torch.Generator().manual_seed(0))
    results = []
    for threads in (1, 2, 3):
        environment.configure(threads=threads)
        shaded, of_shade = value_and_gradients(ops.shade, inputs, weights, learnt=2)
        tinted, of_tint = value_and_gradients(ops.tint, [inputs[0], inputs[1][:, :3]], weights)
        results.append([shaded, *of_shade, tinted, *of_tint])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other))
