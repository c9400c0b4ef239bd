"""Quaternion functions and covariances against plain torch in float64."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.scenes import random_gaussians
from reference import quaternion as quaternion_reference
from reference.covariance import covariance as covariance_reference
from scgs_warp.ops.covariance import covariance


def gradients(function, inputs, weights):
    leaves = [x.detach().clone().requires_grad_() for x in inputs]
    output = function(*leaves)
    (output * weights.to(output)).sum().backward()
    return output.detach(), [leaf.grad for leaf in leaves]


@pytest.mark.parametrize("n", [0, 1, 2, 257])
@pytest.mark.parametrize("seed", range(3))
def test_values_and_gradients(seed, n, device):
    g = random_gaussians(seed, n, device)
    weights = torch.randn(n, 3, 3, generator=torch.Generator().manual_seed(seed))  # not symmetric
    ours, ours_grad = gradients(covariance, (g.quats, g.scales), weights)
    twin, twin_grad = gradients(covariance_reference, (g.quats.double(), g.scales.double()), weights)
    assert ours.shape == (n, 3, 3) and ours.device.type == device
    torch.testing.assert_close(ours.double(), twin, rtol=1e-5, atol=1e-8)
    for a, b in zip(ours_grad, twin_grad):
        torch.testing.assert_close(a.double(), b, rtol=1e-4, atol=2e-7)


def test_is_symmetric_with_the_scales_as_eigenvalues(device):
    g = random_gaussians(7, 100, device)
    result = covariance(g.quats, g.scales)
    assert torch.equal(result, result.transpose(1, 2))
    eigenvalues = torch.linalg.eigvalsh(result.double()).sqrt()
    torch.testing.assert_close(eigenvalues, g.scales.double().sort(dim=1).values, rtol=1e-3, atol=1e-4)


def test_zero_quaternion_is_the_identity(device):
    quats = torch.zeros(1, 4, device=device, requires_grad=True)
    scales = torch.tensor([[1.0, 2.0, 3.0]], device=device)
    result = covariance(quats, scales)
    assert torch.equal(result[0], torch.diag(torch.tensor([1.0, 4.0, 9.0], device=device)))
    result.sum().backward()
    assert torch.equal(quats.grad, torch.zeros_like(quats))


@settings(deadline=None, max_examples=25)
@given(st.tuples(*[st.integers(-9, 9)] * 4).filter(any), st.integers(1, 10000))
def test_norm_and_sign_of_the_quaternion_do_not_matter(values, factor):
    # Integers: hypothesis refuses to draw floats in a process that flushes denormals to zero.
    quat, factor = torch.tensor([values]).float(), factor / 100
    scales = torch.tensor([[0.1, 0.2, 0.3]])
    torch.testing.assert_close(covariance(quat, scales), covariance(-factor * quat, scales), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize(
    ("quats", "scales", "name"),
    [((3, 3), (3, 3), "quats"), ((3, 4), (2, 3), "scales"), ((4,), (1, 3), "quats"), ((3, 4), (3,), "scales")],
)
def test_wrong_shapes_are_named(quats, scales, name):
    with pytest.raises(ValueError, match=name):
        covariance(torch.zeros(quats), torch.zeros(scales))


# The quaternion functions serve several kernels: each is tested once, here, through kernels of its own.
def run_quaternion_kernels(a, b, x, v_quat, v_vec, device):
    import helpers.quaternion_kernels as kernels
    from scgs_warp.runtime.launch import launch

    n = len(a)
    outputs = [torch.empty(n, 4, device=device) for _ in range(5)] + [
        torch.empty(n, 3, device=device) for _ in range(2)
    ]
    launch(kernels.products, n, *(t.to(device) for t in (a, b, x, v_quat, v_vec)), *outputs)
    return [o.cpu().double() for o in outputs]


@pytest.mark.parametrize("seed", range(2))
def test_product_rotation_and_normalisation(seed, device):
    generator = torch.Generator().manual_seed(seed)
    a, b, v_quat = (torch.randn(50, 4, generator=generator) for _ in range(3))
    x, v_vec = (torch.randn(50, 3, generator=generator) for _ in range(2))
    product, v_a, v_b, unit, v_raw, rotated, v_x = run_quaternion_kernels(a, b, x, v_quat, v_vec, device)

    leaves = [t.double().requires_grad_() for t in (a, b, x)]
    twin_product = quaternion_reference.multiply(leaves[0], leaves[1])
    twin_v_a, twin_v_b = torch.autograd.grad(twin_product, leaves[:2], v_quat.double())
    twin_unit = quaternion_reference.normalise(leaves[0])
    twin_rotated = quaternion_reference.rotate(twin_unit, leaves[2])
    # v_raw: the gradient of both the unit quaternion (weight v_quat) and the rotated vector (weight v_vec).
    twin_v_raw, twin_v_x = torch.autograd.grad(
        (twin_unit, twin_rotated), (leaves[0], leaves[2]), (v_quat.double(), v_vec.double())
    )
    pairs = [
        (product, twin_product),
        (v_a, twin_v_a),
        (v_b, twin_v_b),
        (unit, twin_unit),
        (rotated, twin_rotated),
        (v_x, twin_v_x),
        (v_raw, twin_v_raw),
    ]
    for ours, twin in pairs:
        torch.testing.assert_close(ours, twin.detach(), rtol=1e-4, atol=1e-5)
