"""As-rigid-as-possible regulariser on trajectories (paper Eq. 9-10)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..config.presets import LossConfig
from ..ops.arap import arap_energy, local_rotations, reverse_edges, trajectory_graph
from ..ops.neighbors import NodeLists
from ..optim import log_linear

STRETCHED = 2.0
"""Change of an edge's length, in spacings of the control points, at which the edge counts a quarter."""


class Graph(NamedTuple):
    """Neighbours with their weights: motion should be rigid between neighbouring control points."""

    neighbors: Tensor
    """[M, J] int32, padded with -1."""
    weights: Tensor
    """[M, J], rows sum to at most 1."""
    reverse: NodeLists
    """Edges that end at each control point."""

    @staticmethod
    def of(neighbors: Tensor, weights: Tensor) -> Graph:
        return Graph(neighbors, weights, reverse_edges(neighbors))

    def replaced_by(self, other: Graph) -> Graph:
        """Return the other graph, in this one's tensors if they have the same shapes: recorded steps read these."""
        pairs = [*zip(self[:2], other[:2]), *zip(self.reverse, other.reverse)]
        if any(old.shape != new.shape for old, new in pairs):
            return other
        for old, new in pairs:
            old.copy_(new)
        return self


def arap_weight(step: int, loss: LossConfig) -> float:
    """Return the weight at this main step: exponential decay over ``arap_until`` steps, then 0. Only every
    ``arap_every``-th step includes the term, with its weight multiplied by ``arap_every``."""
    if loss.arap <= 0.0 or step >= loss.arap_until or step % loss.arap_every:
        return 0.0
    return log_linear(loss.arap, loss.arap_end, step, loss.arap_until) * loss.arap_every


def arap_times(loss: LossConfig, random: torch.Generator) -> list[float]:
    """Draw the instants at which the network is evaluated in addition to the step's own."""
    return torch.rand(1 if loss.arap_pair == "frame" else 2, generator=random).tolist()


def build_graph(
    positions_at: Callable[[Tensor], Tensor], loss: LossConfig, before: Graph | None = None, slack: float = 0.0
) -> Graph | None:
    """Find neighbours by trajectory from ``positions_at(times [T]) -> [T, M, 3]`` at N_t times.

    Args:
        before: the graph to replace.
        slack: edges that the motion bends count less (:func:`spared`); 0: all count fully.

    Returns:
        None if M < 2.
    """
    with torch.no_grad():
        trajectories = positions_at(torch.linspace(0.0, 1.0, loss.arap_times)).contiguous()
        count = min(loss.arap_neighbors, trajectories.shape[1] - 1)
        if count < 1:
            return None
        neighbors, weights = trajectory_graph(trajectories, count)
        if slack > 0.0:
            weights = spared(trajectories, neighbors, weights, slack)
        graph = Graph.of(neighbors, weights)
        return graph if before is None else before.replaced_by(graph)


def spared(instants: Tensor, neighbors: Tensor, weights: Tensor, slack: float) -> Tensor:
    """Return smaller weights for edges that the motion bends or stretches.

    ARAP asks one rotation to explain all edges of a control point, also across a joint or between bodies that part.
    Each weight is therefore multiplied by (1 + (r / slack)^2)^-2 (Geman and McClure), where r is the edge's residual in
    spacings of the control points, root mean square over pairs of instants. The best rotations are found twice: with
    the given weights, and with the reduced ones.

    Args:
        instants: [T, M, 3] control points at T times.
        neighbors: [M, J] int32, -1 for a missing neighbour.
        weights: [M, J] >= 0.
        slack: residual in spacings at which an edge counts a quarter, > 0.

    Returns:
        [M, J]; 0 where a residual is not finite.
    """
    ends = neighbors.long().clamp(min=0)
    edges = (instants[:, ends] - instants[:, :, None]).contiguous()
    unit = edges[:, :, 0].norm(dim=2).nanmedian().clamp(min=1e-12)
    count = len(instants)
    pairs = [
        (first, (first + apart) % count)
        for apart in sorted({1, count // 4, count // 2} - {0})
        for first in range(count)
    ]
    share = torch.ones_like(weights)
    for _ in range(2):
        squares = torch.zeros_like(weights)
        for first, second in pairs:
            turns = local_rotations(instants[first], instants[second], neighbors, weights * share)
            turned = (turns[:, None] * edges[first][:, :, None]).sum(dim=3)
            squares += (edges[second] - turned).square().sum(dim=2)
        share = (1.0 + squares / (len(pairs) * (slack * unit).square())).pow(-2)
        share = share.where(share.isfinite(), 0.0)
    return weights * share


def graph_is_old(graph: Graph | None, step: int, loss: LossConfig) -> bool:
    """Return True in the first step with the term after each ``arap_refresh`` steps, or if there is no graph yet."""
    return graph is None or step % loss.arap_refresh < loss.arap_every


def graph_state(graph: Graph | None) -> dict[str, Tensor]:
    """Return what a checkpoint holds of a graph."""
    return {} if graph is None else {"graph.neighbors": graph.neighbors, "graph.weights": graph.weights}


def graph_of_state(tensors: dict[str, Tensor], present: Graph | None) -> Graph | None:
    """Return the graph of a checkpoint, or the present one if the checkpoint holds none."""
    if "graph.neighbors" not in tensors:
        return present
    return Graph.of(tensors["graph.neighbors"], tensors["graph.weights"])


def momentary_graph(instants: Tensor, loss: LossConfig, before: Graph | None = None) -> Graph | None:
    """Find neighbours by place at the first of two ``instants`` [2, M, 3].

    Where two limbs have exchanged their tracks, neighbours at one moment are far apart at another. Neighbours over the
    whole time leave such pairs out, and therefore never correct the exchange. Weights fall with the change of an edge's
    length (Geman and McClure), because bodies that only touch may part.

    Args:
        before: the graph to replace.

    Returns:
        None if M < 2.
    """
    with torch.no_grad():
        first, second = instants
        count = min(loss.arap_neighbors, len(first) - 1)
        if count < 1:
            return None
        neighbors, weights = trajectory_graph(first[None], count)
        ends = neighbors.long().clamp(min=0)
        lengths = (first[ends] - first[:, None]).norm(dim=2)
        change = (second[ends] - second[:, None]).norm(dim=2) - lengths
        spacing = lengths[:, 0].median().clamp(min=1e-12)
        share = (1.0 + (change / (STRETCHED * spacing)).square()).pow(-2)
        graph = Graph.of(neighbors, (weights * share).where(share.isfinite(), 0.0))
        return graph if before is None else before.replaced_by(graph)


def rigidity(instants: list[Tensor], graph: Graph) -> Tensor:
    """Return the ARAP energy between the last two of ``instants`` (positions [M, 3] each), summed over control points.

    The sum is computed as a product with ones, which adds in a fixed order.
    """
    first, second = instants[-2:]
    energy = arap_energy(first, second, graph.neighbors, graph.weights, reverse=graph.reverse)
    return energy @ torch.ones_like(energy)


def tearing(instants: Tensor, neighbors: int) -> float:
    """Return by how much a motion tears a body apart, 0 (rigid) to 1.

    It is the mean of x^2 / (x^2 + ``STRETCHED``^2) over the edges between neighbours of each instant and over all
    instants, where x is the change of an edge's length from the one to the other, in spacings of the points.

    Args:
        instants: [T, M, 3] places of the points; points that are not always finite do not count.
        neighbors: number of neighbours of each point.
    """
    instants, torn = instants[:, instants.isfinite().all(2).all(0)], []
    count = min(neighbors, instants.shape[1] - 1)
    if count < 1:
        return 0.0
    for first in instants:
        ends = trajectory_graph(first[None].contiguous(), count)[0].long()
        known = ends >= 0
        lengths = (instants[:, ends.clamp(min=0)] - instants[:, :, None]).norm(dim=3)
        away = (first[ends.clamp(min=0)] - first[:, None]).norm(dim=2)
        change = (lengths - away) / away[:, 0].median().clamp(min=1e-12)
        share = change.square() / (change.square() + STRETCHED**2)
        torn.append(share[:, known].double().mean())
    return float(torch.stack(torn).mean())
