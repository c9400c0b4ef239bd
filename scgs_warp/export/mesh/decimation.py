"""Fewer triangles for the same shape, by collapsing edges in the order of quadric error (Garland and Heckbert 1997).

Edges that are far enough from each other are collapsed together, so that each round is a handful of array operations.
An edge is left alone if its collapse would change the topology (its ends must share exactly the corners of its
triangles) or turn a triangle over: a closed surface stays closed, and every edge keeps its two triangles.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse import csr_matrix

from .cleaning import compact
from .surface import Surface

BORDER_WEIGHT = 10.0
"""Weight of the planes that hold open borders in place."""
SPREAD = 1e-3
"""Weight of the distance from an edge's middle, which places the new vertex where the shape does not."""
TRIED_SHARE = 0.4
"""Share of the edges, the cheapest ones, that a round may collapse."""
LEAST_COSINE = 0.2
"""Cosine of the largest turn of a triangle."""
LEAST_SHAPE = 0.05
"""Smallest ratio of a new triangle's area to that of an equilateral one with the same perimeter's square."""
ROUNDS = 200


def decimate(surface: Surface, most: int, advance: Callable[[int], None] | None = None) -> Surface:
    """Reduce a surface to at most ``most`` faces, or as near to it as topology allows.

    Args:
        advance: called with the number of faces after each round.
    """
    vertices, faces = surface.vertices.copy(), surface.faces.astype(np.int64)
    if len(faces) <= most:
        return surface
    scale = float(np.linalg.norm(np.ptp(vertices, axis=0))) or 1.0
    origin = vertices.mean(axis=0)
    vertices = (vertices - origin) / scale
    quadrics = _quadrics(vertices, faces)
    banned = np.zeros(0, np.int64)
    for _ in range(ROUNDS):
        if len(faces) <= most:
            break
        edges, on_border = _edges(faces)
        keys = edges[:, 0] * len(vertices) + edges[:, 1]
        places, costs = _best_places(vertices, quadrics, edges)
        costs[np.isin(keys, banned)] = np.inf
        chosen = _far_apart(edges, costs, len(vertices))
        good = _allowed(vertices, faces, edges, on_border, places, chosen)
        banned = np.concatenate([banned, keys[chosen[~good]]])
        chosen = chosen[good]
        chosen = chosen[np.argsort(costs[chosen], kind="stable")][: (len(faces) - most + 1) // 2]
        if not len(chosen):
            if not np.isfinite(costs).any() or good.size == 0:
                break
            continue
        kept, gone = edges[chosen].T
        vertices[kept] = places[chosen]
        quadrics[kept] += quadrics[gone]
        target = np.arange(len(vertices))
        target[gone] = kept
        faces = target[faces]
        a, b, c = faces.T
        faces = faces[(a != b) & (b != c) & (c != a)]
        if advance is not None:
            advance(len(faces))
    return compact(Surface(vertices * scale + origin, faces.astype(np.int32)))


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return edges [E, 2], smaller end first, and [E] bool, True for edges with one face."""
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, counts = np.unique(ends, axis=0, return_counts=True)
    return edges, counts == 1


def _quadrics(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the sum of squared distances to the planes around each vertex, as a matrix [V, 4, 4]."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    double_area = np.linalg.norm(normals, axis=1, keepdims=True)
    normals /= np.maximum(double_area, 1e-30)
    planes = np.column_stack([normals, -np.einsum("ij,ij->i", normals, a)])
    outer = double_area[:, :, None] * planes[:, :, None] * planes[:, None]
    corners = (faces.ravel(), np.repeat(np.arange(len(faces)), 3))
    around = csr_matrix((np.ones(faces.size), corners), shape=(len(vertices), len(faces)))
    total = (around @ outer.reshape(-1, 16)).reshape(-1, 4, 4)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, inverse, counts = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    open_edges = np.flatnonzero(counts[inverse.ravel()] == 1)
    if len(open_edges):
        first, second = edges[open_edges].T
        along = vertices[second] - vertices[first]
        across = np.cross(along, np.tile(normals, (3, 1))[open_edges])
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
        planes = np.column_stack([across, -np.einsum("ij,ij->i", across, vertices[first])])
        weight = BORDER_WEIGHT * np.einsum("ij,ij->i", along, along)
        outer = weight[:, None, None] * planes[:, :, None] * planes[:, None]
        np.add.at(total, first, outer)
        np.add.at(total, second, outer)
    return total


def _best_places(vertices: np.ndarray, quadrics: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where each edge's vertex is best placed [E, 3], and the cost of it [E]."""
    both = quadrics[edges[:, 0]] + quadrics[edges[:, 1]]
    first, second = vertices[edges[:, 0]], vertices[edges[:, 1]]
    middle = (first + second) / 2.0
    spread = SPREAD * np.trace(both[:, :3, :3], axis1=1, axis2=2) + 1e-20
    matrix = both[:, :3, :3] + spread[:, None, None] * np.eye(3)
    wanted = spread[:, None] * middle - both[:, :3, 3]
    places = np.linalg.solve(matrix, wanted[..., None])[..., 0]
    length = np.linalg.norm(second - first, axis=1, keepdims=True)
    far = np.linalg.norm(places - middle, axis=1, keepdims=True) > 2.0 * length
    places = np.where(far, middle, places)
    whole = np.column_stack([places, np.ones(len(places))])
    error = np.einsum("ei,eij,ej->e", whole, both, whole)
    return places, np.maximum(error, 0.0) + 1e-3 * spread * length[:, 0] ** 2


def _far_apart(edges: np.ndarray, costs: np.ndarray, count: int) -> np.ndarray:
    """Return edges [C] that are each the cheapest of all that reach a neighbour of their ends, among the cheapest."""
    order = np.argsort(costs, kind="stable")
    rank = np.empty(len(costs), np.int64)
    rank[order] = np.arange(len(costs))
    least = np.full(count, len(costs))
    for _ in range(2):
        spread = rank if (least == len(costs)).all() else least[edges].min(axis=1)
        wider = least.copy()
        np.minimum.at(wider, edges[:, 0], spread)
        np.minimum.at(wider, edges[:, 1], spread)
        least = wider
    mine = (least[edges] == rank[:, None]).all(axis=1)
    tried = (rank < max(TRIED_SHARE * len(costs), 1)) & np.isfinite(costs)
    return np.flatnonzero(mine & tried)


def _allowed(
    vertices: np.ndarray,
    faces: np.ndarray,
    edges: np.ndarray,
    on_border: np.ndarray,
    places: np.ndarray,
    chosen: np.ndarray,
) -> np.ndarray:
    """Return [C] bool: edges whose collapse keeps the topology and turns no triangle over."""
    count = len(vertices)
    border = np.zeros(count, bool)
    border[edges[on_border]] = True
    ones = np.ones(2 * len(edges), np.int32)
    pairs = np.concatenate([edges, edges[:, ::-1]])
    adjacent = csr_matrix((ones, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    kept, gone = edges[chosen].T
    shared = np.asarray(adjacent[kept].multiply(adjacent[gone]).sum(axis=1)).ravel()
    good = shared == np.where(on_border[chosen], 1, 2)
    good &= on_border[chosen] | ~(border[kept] & border[gone])
    owner = np.full(count, -1)
    owner[kept] = owner[gone] = np.arange(len(chosen))
    owners = owner[faces]
    touched = np.flatnonzero((owners >= 0).sum(axis=1) == 1)  # faces with both ends vanish
    corner = owners[touched].argmax(axis=1)
    edge = owners[touched, corner]
    before = vertices[faces[touched]]
    after = before.copy()
    after[np.arange(len(touched)), corner] = places[chosen[edge]]
    was, now = (np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]) for t in (before, after))
    area_was, area_now = np.linalg.norm(was, axis=1), np.linalg.norm(now, axis=1)
    turned = np.einsum("ij,ij->i", was, now) < LEAST_COSINE * area_was * area_now
    sides = sum(((after[:, i] - after[:, i - 1]) ** 2).sum(axis=1) for i in range(3))
    thin = 2.0 * np.sqrt(3.0) * area_now < LEAST_SHAPE * sides
    good[edge[turned | thin]] = False
    vanishing = (owners >= 0).sum(axis=1) == 2
    third = faces[vanishing][owners[vanishing] < 0]
    few = (np.bincount(faces.ravel(), minlength=count)[third] <= 3) & ~border[third]  # what is left would fold up
    good[owners[vanishing].max(axis=1)[few]] = False
    return good
