"""Quaternion functions, which serve several kernels, against plain torch in float64."""

from __future__ import annotations

import pytest
import torch

import helpers.quaternion_kernels as kernels
from reference import quaternion as quaternion_reference
from scgs_warp.runtime.launch import launch


def run_quaternion_kernels(a, b, x, v_quat, v_vec, device):
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
