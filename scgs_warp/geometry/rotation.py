"""Rotations outside the kernels: quaternions (wxyz) in torch, and matrices of cameras in files."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""[4, 4] from axes of a camera in OpenGL (x right, y up, z backward) to OpenCV (x right, y down, z forward), and
back."""
RIGID_TOLERANCE = 1e-3
"""Largest magnitude of an entry of ``R^T R - I`` that counts as rounding."""


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Rotate ``vectors`` [N, 3] by ``quats`` [N, 4], which need not be unit."""
    unit = torch.nn.functional.normalize(quats, dim=-1)
    w, axis = unit[..., :1], unit[..., 1:]
    twice = 2.0 * torch.linalg.cross(axis, vectors)
    return vectors + w * twice + torch.linalg.cross(axis, twice)


def is_rotation(matrix: np.ndarray) -> bool:
    """Return whether a matrix [3, 3] rotates without scaling, shearing or mirroring, up to rounding."""
    if not np.abs(matrix).max() < 2.0:  # also refuses NaN and values whose squares would overflow
        return False
    return float(np.abs(matrix.T @ matrix - np.eye(3)).max()) <= RIGID_TOLERANCE and float(np.linalg.det(matrix)) > 0
