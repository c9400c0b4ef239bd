"""Gaussians in glTF: points with the attributes of ``KHR_gaussian_splatting``, static or bound to a moving skeleton."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..gaussians import SH_C0
from ..types import Gaussians
from .gltf import VERTICES, GltfDocument, add_skeleton, influences, linear_colors, upright, xyzw
from .skeleton import Skeleton

EXTENSION = "KHR_gaussian_splatting"
RENDERING = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",  # training images, and so the blended colours, are sRGB
    "sortingMethod": "cameraDistance",
    "projection": "perspective",
}


def write_glb(
    path: Path, gaussians: Gaussians, up: tuple[float, float, float], skeleton: Skeleton | None = None
) -> None:
    """Write activated Gaussians, world units; positions are stored unchanged, under a node that turns ``up`` to +y.
    Sharp Gaussians are approximated (``Gaussians.plain``).

    Args:
        up: unit vector.
        skeleton: motion of the Gaussians, which are then at rest. None: they are static.

    Raises:
        UserError: the file cannot be written, or would be too large.
    """
    document = GltfDocument()
    document.json["extensionsUsed"] = [EXTENSION]
    attributes = _attributes(document, gaussians.plain())
    # The standard ignores the node transform of a skinned mesh; this one is for programs that do not skin points.
    node: dict[str, Any] = {"name": "Gaussians", "rotation": upright(up)}
    if skeleton is not None:
        for index, (joints, weights) in enumerate(influences(skeleton.indices, skeleton.weights)):
            attributes[f"JOINTS_{index}"] = document.accessor(joints, target=VERTICES)
            attributes[f"WEIGHTS_{index}"] = document.accessor(weights, target=VERTICES)
        node["skin"] = add_skeleton(document, skeleton, up)
    primitive = {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: RENDERING}}
    node["mesh"] = document.append("meshes", {"name": "Gaussians", "primitives": [primitive]})
    document.json["scenes"][0]["nodes"].insert(0, document.append("nodes", node))
    document.write(path)


def _attributes(document: GltfDocument, gaussians: Gaussians) -> dict[str, int]:
    def add(values: np.ndarray, **options: Any) -> int:
        return document.accessor(values, target=VERTICES, **options)

    arrays = {name: value.detach().cpu().numpy() for name, value in gaussians.tensors().items()}
    attributes = {
        "POSITION": add(arrays["means"].astype("<f4"), bounds=True),
        "COLOR_0": add(point_colors(arrays["sh_dc"], arrays["opacities"]), normalized=True),
        f"{EXTENSION}:ROTATION": add(xyzw(arrays["quats"])),
        f"{EXTENSION}:SCALE": add(arrays["scales"].astype("<f4")),
        f"{EXTENSION}:OPACITY": add(arrays["opacities"].astype("<f4").clip(0.0, 1.0)),
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": add(arrays["sh_dc"].astype("<f4")),
    }
    rest, column = arrays["sh_rest"].astype("<f4"), 0
    for degree in range(1, round((rest.shape[1] + 1) ** 0.5)):
        for order in range(2 * degree + 1):
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"] = add(rest[:, column])
            column += 1
    return attributes


def point_colors(sh_dc: np.ndarray, opacities: np.ndarray) -> np.ndarray:
    """Return linear RGB and opacity [N, 4] uint16, for programs that show points; Gaussians hold sRGB."""
    return linear_colors(0.5 + SH_C0 * sh_dc.astype(np.float64), opacities)
