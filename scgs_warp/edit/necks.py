"""Parts of a shape that never moved: pieces of its graph between narrow necks.

A piece is ordered along its length by the Fiedler vector of its graph (the slowest vibration). Cut at a place of that
order, a number of edges fall; a neck is a place where far fewer fall than somewhere on either side of it. The clearest
neck of all pieces is cut first.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import eigsh

NECK = 0.6
"""Number of edges across a neck, relative to the most on the narrower side of it, above which it is none."""
MIN_SHARE = 0.02
"""Share of the nodes that both sides of a neck have at least."""
MIN_NODES = 4
SHIFT = 1e-3
"""Shift of the Laplacian, relative to a node's mean degree, which makes it invertible."""
TIE = 1e-6
"""Difference of the Fiedler vector, relative to its largest entry, below which nodes count as equally far: rounding
does not decide their order."""


class Neck(NamedTuple):
    """Best cut of one piece."""

    ratio: float
    """Edges across it, relative to the most on the narrower side; infinite if the piece is too small to be cut."""
    side: np.ndarray
    """Nodes on one side."""


def find_necks(edges: np.ndarray, nodes: int, count: int | None = None) -> np.ndarray:
    """Label the nodes of a graph by piece, [N], numbered by decreasing size.

    Args:
        edges: [E, 2]
        count: number of pieces; None: as many as have necks between them. There are at least as many as components.
    """
    ends = np.concatenate([edges, edges[:, ::-1]])
    graph = csr_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(nodes, nodes))
    labels = connected_components(graph, directed=False)[1].astype(np.int64)
    least = max(MIN_NODES, int(MIN_SHARE * nodes))
    necks = [_neck(graph, np.flatnonzero(labels == label), least) for label in range(int(labels.max()) + 1)]
    while count is None or len(necks) < count:
        best = min(range(len(necks)), key=lambda row: (necks[row].ratio, row))
        if not necks[best].ratio < (NECK if count is None else np.inf):
            break
        labels[necks[best].side] = len(necks)
        necks.append(_neck(graph, np.flatnonzero(labels == len(necks)), least))
        necks[best] = _neck(graph, np.flatnonzero(labels == best), least)
    rank = np.empty(len(necks), np.int64)
    rank[np.argsort(-np.bincount(labels), kind="stable")] = np.arange(len(necks))
    return rank[labels]


def _neck(graph: csr_matrix, nodes: np.ndarray, least: int) -> Neck:
    """Find the clearest neck of a piece."""
    if len(nodes) < 2 * least:
        return Neck(np.inf, nodes[:0])
    inside = graph[nodes][:, nodes]
    order = np.argsort(_fiedler(inside), kind="stable")
    place = np.empty(len(nodes), np.int64)
    place[order] = np.arange(len(nodes))
    first, second = inside.nonzero()
    low, high = np.minimum(place[first], place[second]), np.maximum(place[first], place[second])
    opened, closed = (np.bincount(x, minlength=len(nodes)) / 2.0 for x in (low, high))
    across = np.cumsum(opened - closed)[:-1]  # edges between the first k + 1 nodes and the others
    widest = np.minimum(np.maximum.accumulate(across), np.maximum.accumulate(across[::-1])[::-1])
    ratio = across / np.maximum(widest, 1.0)
    ratio[: least - 1] = np.inf
    ratio[len(ratio) - least + 1 :] = np.inf
    cut = int(ratio.argmin())
    return Neck(float(ratio[cut]), nodes[order[: cut + 1]])


def _fiedler(graph: csr_matrix) -> np.ndarray:
    """Return the Fiedler vector of a connected graph, [N], up to its sign and small differences."""
    degree = np.asarray(graph.sum(1)).reshape(-1)
    count = len(degree)
    laplacian = diags(degree) - graph
    start = np.cos(np.arange(count) * 2.399963)  # any fixed vector, so that each call does the same
    shift = -SHIFT * max(float(degree.mean()), 1e-12)
    if count < 32:
        vectors = np.linalg.eigh(laplacian.toarray())[1]
    else:
        solved: Any = eigsh(laplacian.tocsc(), k=2, sigma=shift, which="LM", v0=start)
        vectors = solved[1]
        vectors = vectors[:, np.argsort(np.abs(vectors.sum(0)))[::-1]]  # the constant one first
    vector = vectors[:, 1]
    vector = np.round(vector / (TIE * np.abs(vector).max()))
    return vector if vector[np.abs(vector).argmax()] > 0 else -vector
