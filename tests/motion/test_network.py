"""The deformation network: its encoding, its start at rest, its gradients in bfloat16."""

from __future__ import annotations

import dataclasses
import math

import torch

from scgs_warp.config.presets import preset
from scgs_warp.motion.control_points import make_network
from scgs_warp.motion.network import encode
from scgs_warp.motion.per_gaussian import PER_GAUSSIAN_HEADS
from scgs_warp.runtime import environment


def test_encoding_of_known_values():
    encoded = encode(torch.tensor([[0.5, -1.0]]), 2)
    angles = [0.5, -1.0, 1.0, -2.0]
    expected = [0.5, -1.0, *map(math.sin, angles), *map(math.cos, angles)]
    torch.testing.assert_close(encoded, torch.tensor([expected]))
    assert torch.equal(encode(torch.ones(3, 1), 0), torch.ones(3, 1))


def test_the_scene_starts_at_rest_and_layers_agree_with_the_fused_kernel():
    network = make_network(preset("cpu").motion, PER_GAUSSIAN_HEADS, 0).train()
    positions, times = torch.rand(20, 3, generator=torch.Generator().manual_seed(0)), torch.tensor([0.0, 0.7])
    out = network(positions, times)
    assert {name: tuple(value.shape) for name, value in out.items()} == {
        name: (2, 20, width) for name, width in PER_GAUSSIAN_HEADS.items()
    }
    assert max(float(value.detach().abs().max()) for value in out.values()) < 1e-2
    layered = network(positions.clone().requires_grad_(), times)  # gradients of positions need torch's layers
    for name, value in out.items():
        torch.testing.assert_close(value, layered[name], rtol=1e-4, atol=1e-6)


def test_gradients_of_the_network_in_bfloat16(all_threads):
    """At the size of a scene: there oneDNN cuts sums over the rows by the number of threads, where the CPU has AMX."""
    config = dataclasses.replace(preset("quick").motion, model="per-gaussian", bfloat16=True)
    random = torch.Generator().manual_seed(3)
    network = make_network(config, PER_GAUSSIAN_HEADS, 0).train()
    positions, times = torch.randn(9_999, 3, generator=random), torch.tensor([0.3])
    torch.nn.init.normal_(network.head.weight, std=0.1, generator=random)
    weights = torch.randn(10, generator=random)

    def gradients(threads: int) -> list[torch.Tensor]:
        environment.configure(threads)
        network.zero_grad()
        out = torch.cat(list(network(positions, times).values()), dim=-1)
        (out * weights).mean().backward()
        return [parameter.grad.clone() for parameter in network.parameters() if parameter.grad is not None]

    one, two = gradients(1), gradients(2)
    assert len(one) == len(list(network.parameters()))
    assert all(torch.equal(a, b) for a, b in zip(one, two))
    network.low_precision = False
    exact = gradients(1)
    for a, b in zip(one, exact):
        assert b.norm() > 0.0 and (a - b).norm() < 0.05 * b.norm(), float((a - b).norm() / b.norm())
