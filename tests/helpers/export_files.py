"""Exported files, read back for comparison."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.scenes import look_at
from scgs_warp.rendering.render import render
from scgs_warp.types import Camera, Gaussians


def gltf_arrays(path: Path) -> tuple[dict[str, np.ndarray], dict]:
    """Attributes of the only primitive, by pygltflib, and the node that shows it."""
    pygltflib = pytest.importorskip("pygltflib", reason="the package pygltflib is not installed")
    gltf = pygltflib.GLTF2().load(str(path))
    blob, found = gltf.binary_blob(), {}
    types = {5126: "<f4", 5121: "u1", 5123: "<u2"}
    for name, index in vars(gltf.meshes[0].primitives[0].attributes).items():
        if index is None:
            continue
        accessor = gltf.accessors[index]
        view = gltf.bufferViews[accessor.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
        values = np.frombuffer(blob, types[accessor.componentType], accessor.count * width, start)
        found[name] = values.reshape(-1, width).astype(np.float64)
    node = next(node for node in gltf.nodes if node.mesh is not None)
    return found, {"node": node, "gltf": gltf}


def picture(gaussians: Gaussians) -> torch.Tensor:
    eye = torch.tensor([0.5, -3.0, 0.8], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    K = torch.tensor([[80.0, 0, 32], [0, 80, 32], [0, 0, 1]])
    camera = Camera(look_at(eye, torch.zeros(3, dtype=torch.float64), up).float(), K, 64, 64)
    return render(gaussians, camera, torch.zeros(3)).rgb
