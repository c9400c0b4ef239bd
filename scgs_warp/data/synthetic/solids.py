"""Closed triangle meshes of simple solids. Faces are counter-clockwise from outside."""

from __future__ import annotations

import numpy as np

Vector = tuple[float, float, float]


def _cube(divisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Tessellate the surface of [-1, 1]^3 with welded seams: return vertices [P, 3] and outward faces [F, 3]."""
    ticks = np.tan(np.linspace(-1, 1, divisions + 1) * np.pi / 4)  # Even angles avoid crowding at the corners.
    u, v = np.meshgrid(ticks, ticks, indexing="ij")
    corner = np.arange(divisions)[:, None] * (divisions + 1) + np.arange(divisions)
    a, b, c, d = corner, corner + divisions + 1, corner + divisions + 2, corner + 1
    quads = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    vertices, faces = [], []
    for axis in range(3):
        for sign in (1.0, -1.0):
            side = np.empty((u.size, 3))
            side[:, axis] = sign
            side[:, (axis + 1) % 3], side[:, (axis + 2) % 3] = u.ravel(), v.ravel()
            faces.append((quads if sign > 0 else quads[:, ::-1]) + len(vertices) * u.size)
            vertices.append(side)
    points = np.concatenate(vertices)
    _, index, inverse = np.unique(np.round(points, 9), axis=0, return_index=True, return_inverse=True)
    return points[index], inverse.reshape(-1)[np.concatenate(faces)]


def rounded_box(half: Vector, radius: float, divisions: int = 10, taper: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Make a box with rounded edges: the points at distance ``radius`` from an inner box. A capsule and a ball are
    limiting cases.

    Returns:
        vertices [P, 3] and faces [F, 3], counter-clockwise from outside.
    """
    cube, faces = _cube(divisions)
    extent = np.asarray(half, np.float64)
    core = np.maximum(extent - radius, 0.0)
    # A third of the grid lines goes to the flat centre, two thirds at even angles to the rounded edges.
    share = np.arctan(np.abs(cube)) * (4.0 / np.pi)
    edge = core + (extent - core) * np.tan(np.clip(1.5 * share - 0.5, 0.0, 1.0) * np.pi / 4)
    beyond = np.where(share < 1.0 / 3.0, 3.0 * share * core, edge)
    points = np.where(core > 0, np.sign(cube) * beyond, cube * extent)
    inner = np.clip(points, -core, core)
    away = points - inner
    vertices = inner + away / np.linalg.norm(away, axis=1, keepdims=True) * radius
    vertices[:, :2] *= 1.0 + taper * vertices[:, 2:] / (2.0 * extent[2])
    return vertices, faces


def torus(radius: float, tube: float, divisions: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Make a torus about z: return vertices [P, 3] and faces [F, 3]."""
    rings, sides = 2 * divisions, divisions
    around, across = np.meshgrid(
        np.arange(rings) * 2 * np.pi / rings, np.arange(sides) * 2 * np.pi / sides, indexing="ij"
    )
    distance = radius + tube * np.cos(across)
    vertices = np.stack([distance * np.cos(around), distance * np.sin(around), tube * np.sin(across)], -1)
    i, j = np.meshgrid(np.arange(rings), np.arange(sides), indexing="ij")
    a, b = i * sides + j, (i + 1) % rings * sides + j
    c, d = (i + 1) % rings * sides + (j + 1) % sides, i * sides + (j + 1) % sides
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return vertices.reshape(-1, 3), faces


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute unit vertex normals [P, 3], weighted by area."""
    corners = vertices[faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for column in range(3):
        np.add.at(normals, faces[:, column], crosses)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def capsule(length: float, radius: float, step: float, sides: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Make a rod along z with round ends: the points at distance ``radius`` from an axis of ``length`` around the
    origin.

    The mean width of the polygonal cross section is 2 ``radius``.

    Args:
        step: largest distance between rings along the axis.

    Returns:
        vertices [P, 3] and faces [F, 3].
    """
    outer = radius * np.pi / (sides * np.sin(np.pi / sides))
    straight = np.linspace(-length / 2, length / 2, max(2, int(np.ceil(length / step)) + 1))
    cap = np.radians([30.0, 60.0])
    heights = np.concatenate([-length / 2 - outer * np.sin(cap[::-1]), straight, length / 2 + outer * np.sin(cap)])
    radii = outer * np.concatenate([np.cos(cap[::-1]), np.ones(len(straight)), np.cos(cap)])
    around = np.arange(sides) * 2 * np.pi / sides
    rings = np.stack(np.broadcast_arrays(
        radii[:, None] * np.cos(around), radii[:, None] * np.sin(around), heights[:, None]), -1)  # fmt: skip
    poles = np.array([[0.0, 0.0, -length / 2 - outer], [0.0, 0.0, length / 2 + outer]])
    i, j = np.meshgrid(np.arange(len(heights) - 1) * sides, np.arange(sides), indexing="ij")
    k = (j + 1) % sides
    quads = [np.stack([i + j, i + k, i + sides + k], -1), np.stack([i + j, i + sides + k, i + sides + j], -1)]
    bottom, top, last = rings.size // 3, rings.size // 3 + 1, (len(heights) - 1) * sides
    j = np.arange(sides)
    k = (j + 1) % sides
    ends = [
        np.stack([np.full(sides, bottom), k, j], -1),
        np.stack([np.full(sides, top), last + j, last + k], -1),
    ]
    faces = np.concatenate([*(quad.reshape(-1, 3) for quad in quads), *ends])
    return np.concatenate([rings.reshape(-1, 3), poles]), faces


def slab(half: Vector, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Make a box with sharp edges, of which each side is a grid with cells of at most ``step``.

    Sides share no vertices, so that vertex normals are those of the sides.

    Returns:
        vertices [P, 3] and faces [F, 3].
    """
    vertices, faces, count = [], [], 0
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        cells = [max(1, int(np.ceil(2 * half[k] / step))) for k in (u, v)]
        grid = np.meshgrid(*(np.linspace(-half[k], half[k], n + 1) for k, n in zip((u, v), cells)), indexing="ij")
        corner = np.arange(cells[0])[:, None] * (cells[1] + 1) + np.arange(cells[1])
        a, b, c, d = corner, corner + cells[1] + 1, corner + cells[1] + 2, corner + 1
        quads = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
        for sign in (1.0, -1.0):
            side = np.empty((grid[0].size, 3))
            side[:, axis] = sign * half[axis]
            side[:, u], side[:, v] = grid[0].ravel(), grid[1].ravel()
            faces.append((quads if sign > 0 else quads[:, ::-1]) + count)
            vertices.append(side)
            count += len(side)
    return np.concatenate(vertices), np.concatenate(faces)


def disc(radius: float, half_height: float, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Make a flat cylinder about z with a grid of cells of at most ``step``: return vertices [P, 3] and faces
    [F, 3]."""
    vertices, faces = slab((1.0, 1.0, half_height / radius), step / radius)
    x, y = vertices[:, 0].copy(), vertices[:, 1].copy()
    vertices[:, 0], vertices[:, 1] = x * np.sqrt(1.0 - 0.5 * y * y), y * np.sqrt(1.0 - 0.5 * x * x)
    return vertices * radius, faces


def lathe(profile: np.ndarray, sides: int) -> tuple[np.ndarray, np.ndarray]:
    """Turn a closed profile about z.

    Args:
        profile: [n, 2] radii (> 0) and heights of its corners, counter-clockwise with the radius to the right and the
            height up; the last corner joins the first.

    Returns:
        vertices [P, 3] and faces [F, 3].
    """
    around = np.arange(sides) * 2 * np.pi / sides
    radii, heights = profile[:, :1], np.broadcast_to(profile[:, 1:], (len(profile), sides))
    vertices = np.stack([radii * np.cos(around), radii * np.sin(around), heights], -1)
    i, j = np.meshgrid(np.arange(len(profile)), np.arange(sides), indexing="ij")
    up, on = (i + 1) % len(profile) * sides, (j + 1) % sides
    a, b, c, d = i * sides + j, i * sides + on, up + on, up + j
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return vertices.reshape(-1, 3), faces
