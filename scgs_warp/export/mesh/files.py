"""Mesh files: .obj, .stl and .ply by trimesh; .glb by the project's writer, since trimesh writes neither skins nor
animations."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from ...gaussians import SH_C0
from ...storage.files import write_atomically
from ..glb import point_colors
from ..gltf import INDICES, VERTICES, GltfDocument, add_skeleton, influences, upright
from ..skeleton import Skeleton
from .colors import vertex_normals
from .surface import Surface

UNLIT = "KHR_materials_unlit"
"""Extension for materials whose colours include the light, as those of photographs do."""


def write_mesh(
    path: Path,
    surface: Surface,
    colors: np.ndarray,
    up: tuple[float, float, float],
    *,
    closed: bool = True,
    skeleton: Skeleton | None = None,
    frame: int = 0,
) -> None:
    """Write a mesh in world units, in the format of the suffix: .obj, .stl, .ply or .glb.

    Args:
        colors: [V, 3] sRGB in [0, 1]; .stl has none.
        up: unit vector that becomes +y in a .glb.
        closed: whether the back of every triangle is inside.
        skeleton: motion of the vertices, for a .glb. None: the mesh is static.
        frame: frame of the skeleton that the vertices show.

    Raises:
        UserError: the file cannot be written, or would be too large.
    """
    if path.suffix.lower() == ".glb":
        _document(surface, colors, up, closed, skeleton, frame).write(path)
        return
    import trimesh

    shades = np.column_stack([np.rint(255.0 * colors), np.full(len(colors), 255)]).astype(np.uint8)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, vertex_colors=shades, process=False)
    kind = path.suffix.lower()[1:]
    options: dict[str, Any] = {"digits": _decimals(surface.vertices)} if kind == "obj" else {}
    content: Any = mesh.export(file_type=kind, **options)
    write_atomically(path, content.encode() if isinstance(content, str) else content)


def _decimals(vertices: np.ndarray) -> int:
    """Return the number of decimals that hold coordinates of this size to nine digits, and colours to four."""
    largest = float(np.abs(vertices).max(initial=0.0))
    return max(9 - math.ceil(math.log10(largest)), 4) if largest > 0 else 9


def _document(
    surface: Surface,
    colors: np.ndarray,
    up: tuple[float, float, float],
    closed: bool,
    skeleton: Skeleton | None,
    frame: int,
) -> GltfDocument:
    document = GltfDocument()
    document.json["extensionsUsed"] = [UNLIT]
    vertices = surface.vertices.astype("<f4")
    normals = vertex_normals(vertices.astype(np.float64), surface.faces).astype("<f4")
    linear = point_colors((colors - 0.5) / SH_C0, np.ones(len(colors)))
    attributes = {
        "POSITION": document.accessor(vertices, target=VERTICES, bounds=True),
        "NORMAL": document.accessor(normals, target=VERTICES),
        "COLOR_0": document.accessor(linear, target=VERTICES, normalized=True),
    }
    node: dict[str, Any] = {"name": "surface"}
    if skeleton is None:
        node["rotation"] = upright(up)
    else:  # a skinned mesh is placed by its joints alone
        for index, (joints, weights) in enumerate(influences(skeleton.indices, skeleton.weights)):
            attributes[f"JOINTS_{index}"] = document.accessor(joints, target=VERTICES)
            attributes[f"WEIGHTS_{index}"] = document.accessor(weights, target=VERTICES)
        node["skin"] = add_skeleton(document, skeleton, up, frame)
    material = {
        "name": "surface",
        "doubleSided": not closed,
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
        "extensions": {UNLIT: {}},
    }
    primitive = {
        "attributes": attributes,
        "indices": document.accessor(surface.faces.reshape(-1).astype("<u4"), target=INDICES),
        "material": document.append("materials", material),
    }
    node["mesh"] = document.append("meshes", {"name": "surface", "primitives": [primitive]})
    document.json["scenes"][0]["nodes"].insert(0, document.append("nodes", node))
    return document
