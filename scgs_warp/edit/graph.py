"""Graph of control points that an edit bends."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from ..errors import UserError
from ..ops.arap import trajectory_graph
from .rotations import rotate

NEIGHBORS = 7
"""Number of neighbours that each control point requests. Requests in both directions count, so that a control point has
about nine neighbours."""
MAX_EDGE_RATIO = 3.0
"""Length, relative to the median edge, beyond which an edge is dropped."""
MIN_COMPONENT_SIZE = 4
"""Number of control points below which an isolated component counts as strays, which follow the nearest larger
component."""
SAMPLE_COUNT = 16
"""Number of instants at which trajectories are compared."""


@dataclass(frozen=True)
class ControlGraph:
    """Symmetric graph in compressed rows; every edge is in the rows of both of its ends."""

    begin: np.ndarray
    """[M + 1] int32 row offsets into the two arrays below."""
    neighbors: np.ndarray
    """[E] int32, ascending in each row."""
    weights: np.ndarray
    """[E] float64 > 0, the same in both directions."""
    component: np.ndarray
    """[M] int32 label of the connected component of each control point."""
    edge_length: float
    """Median over the edges (root mean square over time), normalised units; 1 without edges."""
    stray: np.ndarray
    """[M] int32 leader of each control point in a tiny component: itself if no larger component is near. -1 for all
    other control points."""

    def __len__(self) -> int:
        return len(self.begin) - 1

    @property
    def edges(self) -> np.ndarray:
        """[E / 2, 2] each edge once, first end < second end."""
        first = np.repeat(np.arange(len(self)), np.diff(self.begin))
        keep = first < self.neighbors
        return np.stack([first[keep], self.neighbors[keep]], axis=1)

    @property
    def matrix(self) -> csr_matrix:
        """[M, M] weights."""
        return csr_matrix((self.weights, self.neighbors, self.begin), shape=(len(self), len(self)))

    def ring(self, nodes: Iterable[int], count: int = 1) -> tuple[int, ...]:
        """Return the nodes and all nodes at most ``count`` edges away from them, ascending."""
        inside = np.zeros(len(self), bool)
        inside[list(nodes)] = True
        matrix = self.matrix
        for _ in range(max(0, count)):
            grown = inside | (matrix @ inside > 0)
            if (grown == inside).all():
                break
            inside = grown
        return tuple(np.flatnonzero(inside).tolist())

    @property
    def led(self) -> np.ndarray:
        """[S] strays that follow another control point."""
        return np.flatnonzero((self.stray >= 0) & (self.stray != np.arange(len(self))))

    def with_strays(self, nodes: Iterable[int]) -> tuple[int, ...]:
        """Return the nodes and the strays that follow them, ascending."""
        inside = np.zeros(len(self), bool)
        inside[list(nodes)] = True
        led = self.led
        inside[led[inside[self.stray[led]]]] = True
        return tuple(np.flatnonzero(inside).tolist())

    def beyond(self, nodes: Iterable[int], rings: int) -> tuple[int, ...]:
        """Return all nodes more than ``rings`` edges away, ascending; a stray counts as being at its leader."""
        near = set(self.with_strays(self.ring(nodes, rings)))
        return tuple(node for node in range(len(self)) if node not in near)

    def follow(
        self, rest: np.ndarray, positions: np.ndarray, turns: np.ndarray, stay: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Move strays rigidly with their leaders. Strays in ``stay`` [M] bool, and strays whose leader has not moved,
        stay bit-identical.

        Returns:
            Positions [M, 3] and turns [M, 4] of all nodes.
        """
        led = self.led[~stay[self.led]]
        leaders = self.stray[led]
        moved = (positions[leaders] != rest[leaders]).any(1) | turns[leaders, 1:].any(1)
        led, leaders = led[moved], leaders[moved]
        if not len(led):
            return positions, turns
        positions, turns = positions.copy(), turns.copy()
        turns[led] = turns[leaders]
        positions[led] = rotate(turns[leaders], rest[led] - rest[leaders]) + positions[leaders]
        return positions, turns


def build_graph(trajectories: Tensor, neighbors: int = NEIGHBORS, shared: np.ndarray | None = None) -> ControlGraph:
    """Connect neighbours by mean squared distance over time (SC-GS, Eq. 10), so that parts which touch once and move
    apart stay separate. Edges are made symmetric by union, and overlong ones dropped.

    Weights are 1: on an unstructured graph the length of an edge reflects how densely control points happen to lie,
    not how stiff the body is.

    Args:
        trajectories: [T, M, 3] control points at T times (one is enough for a static scene).
        neighbors: number of neighbours that each control point requests, 1 .. 15.
        shared: [N, K] control points of which each row shares a Gaussian. Neighbours are then connected only if they
            share a Gaussian (Martinetz & Schulten 1994) directly or through one more control point, so that gaps stay
            open and control points that move no Gaussian connect nothing.
    """
    nodes = trajectories.shape[1]
    nearest, _ = trajectory_graph(trajectories.float().cpu().contiguous(), neighbors)
    columns = nearest.numpy().astype(np.int64)
    rows = np.repeat(np.arange(nodes), columns.shape[1])
    columns = columns.reshape(-1)
    rows, columns = rows[columns >= 0], columns[columns >= 0]
    pairs = np.unique(np.stack([np.minimum(rows, columns), np.maximum(rows, columns)], 1), axis=0)
    if shared is not None:
        near = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(nodes, nodes)).tocsr()
        pairs = np.stack(near.multiply(_near(shared, nodes)).nonzero(), axis=1)
    tracks = trajectories.detach().cpu().double().numpy()
    offsets = tracks[:, pairs[:, 0]] - tracks[:, pairs[:, 1]]
    lengths = np.sqrt((offsets**2).sum(-1).mean(0))
    median = float(np.median(lengths)) if len(lengths) else 1.0
    pairs = pairs[lengths <= MAX_EDGE_RATIO * median]
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    matrix = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(nodes, nodes)).tocsr()
    matrix.sort_indices()
    component = connected_components(matrix, directed=False)[1].astype(np.int32)
    begin, columns = matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32)
    stray = _strays(tracks, component, MAX_EDGE_RATIO * median)
    return ControlGraph(begin, columns, matrix.data.astype(np.float64), component, median or 1.0, stray)


def _near(shared: np.ndarray, nodes: int) -> csr_matrix:
    """Return [M, M] bool: pairs of control points that share a Gaussian, or that both share one with a third control
    point."""
    rows, columns = (shared[:, pick].reshape(-1) for pick in np.triu_indices(shared.shape[1], 1))
    ones = np.ones(2 * len(rows), bool)
    ends = np.concatenate([rows, columns]), np.concatenate([columns, rows])
    direct = csr_matrix((ones, ends), shape=(nodes, nodes), dtype=bool)
    return csr_matrix(direct + direct @ direct)


def _strays(tracks: np.ndarray, component: np.ndarray, reach: float) -> np.ndarray:
    """Choose leaders for the members of tiny components: the nearest member of a larger one within a few edges."""
    stray = np.full(len(component), -1, np.int32)
    small = np.bincount(component, minlength=1)[component] < MIN_COMPONENT_SIZE
    if not small.any() or small.all():
        return stray
    held = np.flatnonzero(~small)
    for node in np.flatnonzero(small):
        distances = ((tracks[:, held] - tracks[:, node : node + 1]) ** 2).sum(-1).mean(0)
        nearest = int(distances.argmin())
        stray[node] = held[nearest] if distances[nearest] <= (4.0 * reach) ** 2 else node
    return stray


def sample_times(moves: bool) -> Tensor:
    """Return the instants at which ``build_graph`` compares trajectories."""
    return torch.linspace(0.0, 1.0, SAMPLE_COUNT) if moves else torch.zeros(1)


def chosen_nodes(nodes: Iterable[Any], count: int) -> tuple[int, ...]:
    """Return the chosen of ``count`` control points, ascending.

    Args:
        nodes: whole numbers, or a boolean for every control point.

    Raises:
        UserError: one is no whole number or does not exist, or the booleans are not as many as the control points.
    """
    given: Any = nodes.tolist() if isinstance(nodes, np.ndarray | Tensor) else nodes
    if not isinstance(given, Iterable):
        raise UserError(
            f"control points {given!r}: give a list of whole numbers, or one boolean for each control point"
        )
    given = [node.item() if isinstance(node, np.generic | Tensor) else node for node in given]
    if given and all(isinstance(node, bool) for node in given):
        if len(given) != count:
            raise UserError(f"a mask of {len(given)} control points: there are {count}; give one boolean for each")
        return tuple(index for index, chosen in enumerate(given) if chosen)
    for node in given:
        if isinstance(node, bool) or not isinstance(node, int):
            raise UserError(f"control point {node!r}: give whole numbers, or one boolean for each control point")
        if not 0 <= node < count:
            raise UserError(f"control point {node}: there are {count}, from 0 on")
    return tuple(sorted(set(given)))
