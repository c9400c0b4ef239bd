"""A moving scene as plain arrays: Gaussians at rest, skinning weights, and trajectories of control points.

``docs/formats.md`` has a player of a few lines.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from ..storage.files import write_atomically
from ..types import Gaussians
from .skeleton import Skeleton

FORMAT = "scgs-warp motion"
VERSION = 1


def write_npz(
    path: Path,
    rest: Gaussians,
    skeleton: Skeleton,
    *,
    shading: np.ndarray | None = None,
    correctives: np.ndarray | None = None,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> None:
    """Write a moving scene, world units, float32, compressed; the same scene gives the same bytes.
    Sharp Gaussians are approximated (``Gaussians.plain``).

    Args:
        rest: activated Gaussians before any motion.
        skeleton: motion of the same Gaussians.
        shading: [N, 10] coefficients of the brightness that follows the surface's rotation; None: no shading.
        correctives: [N, 27] coefficients of the displacement that follows the surface's rotation, world units; None: no
            correctives.
        up: unit vector.

    Raises:
        UserError: the file cannot be written.
    """
    rest = rest.plain()
    quats = rest.quats.detach().cpu().double().numpy()
    arrays: dict[str, np.ndarray] = {
        "means": rest.means.detach().cpu().numpy(),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": rest.scales.detach().cpu().numpy(),
        "opacities": rest.opacities.detach().cpu().numpy(),
        "sh_dc": rest.sh_dc.detach().cpu().numpy(),
        "sh_rest": rest.sh_rest.detach().cpu().numpy(),
        "weights": skeleton.weights,
        "nodes": skeleton.rest,
        "times": skeleton.times,
        "seconds": skeleton.seconds,
        "node_positions": skeleton.positions,
        "node_rotations": skeleton.rotations,
        "up": np.array(up),
    }
    if shading is not None and shading.shape[1]:
        arrays["shading"] = shading
    if correctives is not None and correctives.shape[1]:
        arrays["correctives"] = correctives
    if skeleton.shape_rotations is not None:
        arrays["node_shape_rotations"] = skeleton.shape_rotations
    if skeleton.own_rotations is not None and {"shading", "correctives"} & arrays.keys():
        arrays["node_own_rotations"] = skeleton.own_rotations
    if skeleton.share is not None:
        arrays["share"] = skeleton.share
    if skeleton.log_scales is not None:
        arrays["node_log_scales"] = skeleton.log_scales
    if skeleton.tints is not None:
        arrays["node_tints"] = skeleton.tints
    arrays = {name: np.asarray(value, "<f4") for name, value in arrays.items()}
    arrays["indices"] = skeleton.indices.astype("<i4")
    content = io.BytesIO()
    np.savez_compressed(content, format=np.array(FORMAT), version=np.array(VERSION), **arrays)  # pyright: ignore
    write_atomically(path, content.getvalue())
