"""Float64 twins of the two steps of ``edit/solver.py``: loops over nodes and edges, NumPy's dense algebra."""

from __future__ import annotations

import numpy as np

from scgs_warp.edit.graph import ControlGraph


def turn_nodes(graph: ControlGraph, rest, posed, rotations, smooth: float) -> np.ndarray:
    found = []
    for i in range(len(graph)):
        S = np.zeros((3, 3))
        for at in range(graph.begin[i], graph.begin[i + 1]):
            j = graph.neighbors[at]
            S += graph.weights[at] * (np.outer(posed[j] - posed[i], rest[j] - rest[i]) + smooth * rotations[j])
        U, _, Vt = np.linalg.svd(S)
        U[:, 2] *= np.sign(np.linalg.det(U @ Vt))
        found.append(U @ Vt)
    return np.stack(found)


def place_nodes(graph: ControlGraph, rest, posed, rotations, hard, pulls, targets, stretch: float) -> np.ndarray:
    """Minimises, over the nodes not held, sum over edges (i, j) in both directions of
    w / (1 + s) (|p_ij - (R_i e_ij + R_j e_ij) / 2|^2 + s |p_ij - |e_ij| p0_ij / |p0_ij||^2) / 2 + soft terms."""
    count = len(graph)
    L, b = np.diag(pulls).astype(float), pulls[:, None] * targets
    for i in range(count):
        for at in range(graph.begin[i], graph.begin[i + 1]):
            j, w = graph.neighbors[at], graph.weights[at]
            e, p = rest[i] - rest[j], posed[i] - posed[j]
            wanted = 0.5 * (rotations[i] + rotations[j]) @ e + stretch * np.linalg.norm(e) * p / np.linalg.norm(p)
            L[i, i] += w
            L[i, j] -= w
            b[i] += w / (1 + stretch) * wanted
    out, free = posed.copy(), ~hard
    known = L[np.ix_(free, hard)] @ posed[hard]
    out[free] = np.linalg.solve(L[np.ix_(free, free)], b[free] - known)
    return out
