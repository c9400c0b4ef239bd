"""Sums over the pairs of every control point by segments, against sums in float64, whatever the lists look like."""

from __future__ import annotations

import pytest
import torch

from scgs_warp.kernels.cuda.node_sums import SEGMENT
from scgs_warp.ops.neighbors import node_lists
from scgs_warp.ops.node_sums import rbf_node_sums, skin_node_sums


def indices_of(case: str, count: int, nodes: int, generator: torch.Generator) -> torch.Tensor:
    """[count, 4] neighbours: spread evenly, nearly all on one node, or on nodes that have one or none."""
    drawn = torch.randint(0, nodes, (count, 4), generator=generator)
    if case == "one node":
        drawn = torch.where(torch.rand(count, 4, generator=generator) < 0.95, nodes // 2, drawn)
    if case == "sparse":
        drawn = drawn // 7 * 7
    return drawn.int()


CASES = [("even", 500, 20), ("one node", 300, 40), ("sparse", 50, 200), ("even", SEGMENT // 4, 1), ("even", 1, 3)]


@pytest.mark.parametrize("dimensions", (3, 8, 11))
@pytest.mark.parametrize("case", CASES, ids=str)
def test_rbf_sums(device: str, case: tuple[str, int, int], dimensions: int):
    name, count, nodes = case
    generator = torch.Generator().manual_seed(count + dimensions)
    indices = indices_of(name, count, nodes, generator)
    points, centres = torch.randn(count, dimensions, generator=generator), torch.randn(nodes, dimensions)
    v = torch.randn(count, 4, generator=generator) * (torch.rand(count, 4, generator=generator) < 0.8)
    arms = (points[:, None] - centres[indices.long()]).double()
    terms = torch.cat([v[..., None], v[..., None] * arms.square().sum(-1, True), v[..., None] * arms], -1).double()
    expected = torch.zeros(nodes, 2 + dimensions, dtype=torch.float64)
    expected.index_add_(0, indices.flatten().long(), terms.flatten(0, 1))
    moved = [x.to(device) for x in (points, centres, indices, v)]
    runs = [rbf_node_sums(*node_lists(moved[2], nodes), *moved) for _ in range(2)]
    assert torch.equal(*runs)
    torch.testing.assert_close(runs[0].cpu().double(), expected, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("scaled", (0, 1))
@pytest.mark.parametrize("case", CASES, ids=str)
def test_skinning_sums(device: str, case: tuple[str, int, int], scaled: int):
    name, count, nodes = case
    generator = torch.Generator().manual_seed(count + scaled)
    indices = indices_of(name, count, nodes, generator)
    at = indices.long()

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    means, centres, shapes = draw(count, 3), draw(nodes, 3), draw(nodes, 4)
    weights, v_means, v_blends, v_scales = draw(count, 4), draw(count, 3), draw(count, 4), draw(count, 3)
    if count > 10:
        means[3, 1] = float("nan")
        v_blends[[3, 7]] = float("nan")  # as skin_adjoint marks those who pass nothing on
    w, v = weights.double(), weights[..., None].double() * v_means[:, None]
    units = torch.nn.functional.normalize(shapes.double(), dim=1)[at]
    sign = torch.where((units * units[:, :1]).sum(-1) < 0, -1.0, 1.0)
    outer = (v[..., :, None] * (means[:, None] - centres[at])[..., None, :]).flatten(-2)
    parts = [outer, v, (sign * w)[..., None] * v_blends[:, None]]
    terms = torch.cat(parts + ([w[..., None] * v_scales[:, None]] if scaled else []), -1)
    usable = v_blends.isfinite().all(1)[:, None, None]
    terms = torch.where(usable, terms, 0.0).flatten(0, 1)
    expected = torch.zeros(nodes, terms.shape[1], dtype=torch.float64).index_add_(0, at.flatten(), terms)
    pairs = [means, centres, shapes, indices, weights, v_means, v_blends, v_scales]
    moved = tuple(x.to(device) for x in pairs)
    sums = skin_node_sums(*node_lists(moved[3], nodes), (*moved, scaled), scaled)
    torch.testing.assert_close(sums.cpu().double(), expected, rtol=1e-4, atol=1e-3)
