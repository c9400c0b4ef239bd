"""The control graph as an animated glTF mesh, with an octahedron for each control point and a bar for each edge."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..visualization.overlay import position_colors
from .gltf import INDICES, VERTICES, GltfDocument, add_skeleton, linear_colors
from .skeleton import Skeleton

POINT, EDGE = 0.12, 0.02
"""Radii of octahedra and bars, relative to the median edge length."""
GREY = 0.35
CORNERS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float64)
FACES = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
SIDES = np.array([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]])
"""Triangles of a bar with six corners: 0 to 2 lie at its first end, 3 to 5 at its second."""


def write_graph(path: Path, skeleton: Skeleton, edges: np.ndarray, up: tuple[float, float, float]) -> None:
    """Write control points as an animated skeleton and a mesh bound to it, which any glTF viewer plays.

    Args:
        edges: [E, 2] connected control points.
        up: unit vector that becomes +y in the file.

    Raises:
        UserError: the file cannot be written, or would be too large.
    """
    rest = skeleton.rest
    spans = rest[edges[:, 1]] - rest[edges[:, 0]]
    unit = float(np.median(np.linalg.norm(spans, axis=1))) if len(edges) else 0.05 * float(np.ptp(rest, axis=0).max())
    unit = unit or 1.0
    balls = (rest[:, None] + POINT * unit * CORNERS).reshape(-1, 3)
    bars = _bars(rest, edges, spans, EDGE * unit)
    count = len(rest)
    faces = (FACES + 6 * np.arange(count)[:, None, None]).reshape(-1, 3)
    sides = (SIDES + 6 * (count + np.arange(len(edges)))[:, None, None]).reshape(-1, 3)
    joints = np.concatenate([np.repeat(np.arange(count), 6), np.repeat(edges.reshape(-1), 3)])
    colors = position_colors(rest).astype(np.float64) / 255.0
    colors = np.concatenate([np.repeat(colors, 6, axis=0), np.full((len(bars), 3), GREY)])
    document = GltfDocument()
    bound = np.zeros((len(joints), 4), "<u2")
    bound[:, 0] = joints
    weights = np.zeros((len(joints), 4), "<f4")
    weights[:, 0] = 1.0
    vertices = np.concatenate([balls, bars]).astype("<f4")
    normals = np.concatenate([np.tile(CORNERS, (count, 1)), _away(bars)]).astype("<f4")
    attributes = {
        "POSITION": document.accessor(vertices, target=VERTICES, bounds=True),
        "NORMAL": document.accessor(normals, target=VERTICES),
        "COLOR_0": document.accessor(linear_colors(colors), target=VERTICES, normalized=True),
        "JOINTS_0": document.accessor(bound, target=VERTICES),
        "WEIGHTS_0": document.accessor(weights, target=VERTICES),
    }
    triangles = np.concatenate([faces, sides]).reshape(-1).astype("<u4")
    material = {"name": "graph", "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}}
    primitive = {
        "attributes": attributes,
        "indices": document.accessor(triangles, target=INDICES),
        "material": document.append("materials", material),
    }
    mesh = document.append("meshes", {"name": "control graph", "primitives": [primitive]})
    skin = add_skeleton(document, skeleton, up)
    node = {"name": "control graph", "mesh": mesh, "skin": skin}
    document.json["scenes"][0]["nodes"].insert(0, document.append("nodes", node))
    document.write(path)


def _bars(rest: np.ndarray, edges: np.ndarray, spans: np.ndarray, radius: float) -> np.ndarray:
    """Return the bars' corners [6 E, 3]: for each edge, a triangle across it at either end."""
    lengths = np.linalg.norm(spans, axis=1, keepdims=True)
    along = np.where(lengths > 0, spans / np.where(lengths > 0, lengths, 1.0), (0.0, 0.0, 1.0))
    helper = np.eye(3)[np.abs(along).argmin(axis=1)]  # the axis most perpendicular to the edge
    across = np.cross(along, helper)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    third = np.cross(along, across)
    angles = 2 * np.pi * np.arange(3) / 3
    ring = np.cos(angles)[None, :, None] * across[:, None] + np.sin(angles)[None, :, None] * third[:, None]
    return (rest[edges][:, :, None] + radius * ring[:, None]).reshape(-1, 3)


def _away(bars: np.ndarray) -> np.ndarray:
    """Return unit normals [6 E, 3] that point away from each bar's axis."""
    ends = bars.reshape(-1, 3, 3)
    out = ends - ends.mean(axis=1, keepdims=True)
    return (out / np.linalg.norm(out, axis=2, keepdims=True)).reshape(-1, 3)
