"""Axes of positions in a ``.spz``: an extension of the format may name others than x right, y up, z back."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ..ops.harmonics_rotation import rotate_harmonics

NAMES = ("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF", "LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU")
"""Directions of x, y and z (left, right, down, up, back, front) by the number of the extension, from 1 on."""
STANDARD = "RUB"
DIRECTIONS = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
"""In the frame of a ``.ply``: x right, y down, z forward."""


def turn_axes(values: dict[str, np.ndarray], name: str) -> None:
    """Correct ``means`` [N, 3], ``quats`` [N, 4] wxyz and ``sh_rest`` [N, K - 1, 3] that were read as if the file had
    standard axes, in place. All are in the frame of a ``.ply``.

    Args:
        name: the axes that the file has, one of ``NAMES``.
    """
    axes, standard = (np.array([DIRECTIONS[letter] for letter in word], float).T for word in (name, STANDARD))
    matrix = axes @ standard.T
    mirrored = np.linalg.det(matrix) < 0
    turn = -matrix if mirrored else matrix  # a Gaussian is its own reflection through its centre
    x, y, z, w = Rotation.from_matrix(turn).as_quat()
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    values["means"] = (values["means"] @ matrix.T).astype(np.float32)
    values["quats"] = (values["quats"] @ left.T).astype(np.float32)
    rest = values["sh_rest"]
    if not rest.size:
        return
    quats = torch.tensor([w, x, y, z], dtype=torch.float32).expand(len(rest), 4).contiguous()
    rest = rotate_harmonics(torch.from_numpy(np.ascontiguousarray(rest, np.float32)), quats).numpy()
    if mirrored:  # Harmonics of odd degrees change sign with the direction.
        rest[:, :3] *= -1.0
        rest[:, 8:] *= -1.0
    values["sh_rest"] = rest
