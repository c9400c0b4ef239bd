"""As-rigid-as-possible regulariser on trajectories (paper Eq. 9-10)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..config.presets import LossConfig
from ..ops.arap import arap_energy, reverse_edges, trajectory_graph
from ..ops.neighbors import NodeLists
from ..optim import log_linear


class Graph(NamedTuple):
    """Neighbours over the whole time, with their weights: motion should be rigid between neighbouring control
    points."""

    neighbors: Tensor
    """[M, J] int32, padded with -1."""
    weights: Tensor
    """[M, J], rows sum to 1."""
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
    positions_at: Callable[[Tensor], Tensor], loss: LossConfig, before: Graph | None = None
) -> Graph | None:
    """Find neighbours by trajectory from ``positions_at(times [T]) -> [T, M, 3]`` at N_t times.

    Args:
        before: the graph to replace.

    Returns:
        None if M < 2.
    """
    with torch.no_grad():
        trajectories = positions_at(torch.linspace(0.0, 1.0, loss.arap_times))
        count = min(loss.arap_neighbors, trajectories.shape[1] - 1)
        if count < 1:
            return None
        graph = Graph.of(*trajectory_graph(trajectories.contiguous(), count))
        return graph if before is None else before.replaced_by(graph)


def rigidity(instants: list[Tensor], graph: Graph) -> Tensor:
    """Return the ARAP energy between the last two of ``instants`` (positions [M, 3] each), summed over control points.

    The sum is computed as a product with ones, which adds in a fixed order.
    """
    first, second = instants[-2:]
    energy = arap_energy(first, second, graph.neighbors, graph.weights, reverse=graph.reverse)
    return energy @ torch.ones_like(energy)
