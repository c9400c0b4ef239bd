"""Float64 twins of the two steps of ``edit/solver.py``: loops over nodes and edges, NumPy's dense algebra."""

from __future__ import annotations

import numpy as np

from scgs_warp.edit.graph import ControlGraph


def turn_nodes(graph: ControlGraph, rest, posed, rotations, smooth: float, leaning=None, asked=None) -> np.ndarray:
    """Maximises, node by node, tr(R^T S); ``leaning`` [M] weighs the rotations ``asked`` [M, 3, 3] for."""
    found = []
    for i in range(len(graph)):
        S = np.zeros((3, 3))
        for at in range(graph.begin[i], graph.begin[i + 1]):
            j = graph.neighbors[at]
            S += graph.weights[at] * (np.outer(posed[j] - posed[i], rest[j] - rest[i]) + smooth * rotations[j])
        if leaning is not None and asked is not None:
            S += leaning[i] * asked[i]
        U, _, Vt = np.linalg.svd(S)
        U[:, 2] *= np.sign(np.linalg.det(U @ Vt))
        found.append(U @ Vt)
    return np.stack(found)


def place_nodes(
    graph: ControlGraph,
    rest,
    posed,
    rotations,
    hard,
    pulls,
    targets,
    stretch: float,
    limit: float = 0.0,
    allowed=(1.0, 1.0),
) -> np.ndarray:
    """Minimises, over the nodes not held, sum over edges (i, j) in both directions of
    w / (1 + s + l / 2) (|p_ij - t_ij|^2 + s |p_ij - k(|e_ij|)|^2 + l / 2 |p_ij - (2 k(a) - p0_ij)|^2) / 2 + soft
    terms, where t_ij = (R_i e_ij + R_j e_ij) / 2, k(x) = c x p0_ij / |p0_ij| + (1 - c) t_ij, c is the cosine of the
    angle between p0_ij and t_ij, at least 0, and a the length nearest to |p0_ij| between ``allowed`` times |e_ij|."""
    count = len(graph)
    L, b = np.diag(pulls).astype(float), pulls[:, None] * targets
    for i in range(count):
        for at in range(graph.begin[i], graph.begin[i + 1]):
            j, w = graph.neighbors[at], graph.weights[at]
            e, p = rest[i] - rest[j], posed[i] - posed[j]
            turned = 0.5 * (rotations[i] + rotations[j]) @ e
            along = max(0.0, p @ turned / (np.linalg.norm(p) * np.linalg.norm(turned)))
            old, size = np.linalg.norm(e), np.linalg.norm(p)
            kept, near = (
                along * length * p / size + (1.0 - along) * turned
                for length in (old, min(max(size, allowed[0] * old), allowed[1] * old))
            )
            wanted = turned + stretch * kept + 0.5 * limit * (2.0 * near - p)
            L[i, i] += w
            L[i, j] -= w
            b[i] += w / (1 + stretch + limit / 2) * wanted
    out, free = posed.copy(), ~hard
    known = L[np.ix_(free, hard)] @ posed[hard]
    out[free] = np.linalg.solve(L[np.ix_(free, free)], b[free] - known)
    return out
