"""Rotation of spherical harmonics coefficients, so that colours turn with their surface. No gradient."""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

from ..kernels import harmonics_rotation as kernels
from ..runtime.launch import launch

SIZES = (0, 3, 8, 15)
"""Numbers of coefficients above degree 0, for degrees 0 to 3."""


def _basis(degree: int, d: np.ndarray) -> np.ndarray:
    """Evaluate one band at unit directions [V, 3] as [V, 2 l + 1]; signs of 3D-GS (``kernels/harmonics.py``)."""
    x, y, z = d.T
    xx, yy, zz = x * x, y * y, z * z
    pi = math.pi
    if degree == 1:
        return math.sqrt(3 / (4 * pi)) * np.stack([-y, z, -x], 1)
    if degree == 2:
        a, b = math.sqrt(15 / (4 * pi)), math.sqrt(5 / (16 * pi))
        return np.stack([a * x * y, -a * y * z, b * (3 * zz - 1), -a * x * z, 0.5 * a * (xx - yy)], 1)
    a, b, c, e = (math.sqrt(n / pi) for n in (35 / 32, 105 / 4, 21 / 32, 7 / 16))
    return np.stack(
        [
            a * y * (yy - 3 * xx),
            b * x * y * z,
            c * y * (1 - 5 * zz),
            e * z * (5 * zz - 3),
            c * x * (1 - 5 * zz),
            0.5 * b * z * (xx - yy),
            a * x * (3 * yy - xx),
        ],
        1,
    )


@functools.cache
def _tables() -> tuple[Tensor, Tensor]:
    """Return directions [15, 3] and the inverses [83] of the matrices of the bands' values in these directions.

    A seeded search finds directions whose matrices are well conditioned, so that inverting them loses no accuracy.
    """
    random = np.random.default_rng(1)
    directions, inverses = [], []
    for degree in (1, 2, 3):
        tried = random.normal(size=(200, 2 * degree + 1, 3))
        tried /= np.linalg.norm(tried, axis=-1, keepdims=True)
        values = np.stack([_basis(degree, d) for d in tried])
        best = int(np.linalg.cond(values).argmin())
        directions.append(tried[best])
        inverses.append(np.linalg.inv(values[best]).reshape(-1))
    return torch.from_numpy(np.concatenate(directions)).float(), torch.from_numpy(np.concatenate(inverses)).float()


def rotate_harmonics(sh_rest: Tensor, quats: Tensor) -> Tensor:
    """Rotate spherical harmonics by R: the result has along R d the colour that the input has along d.

    Args:
        sh_rest: [N, R, 3] coefficients of degree 1 and higher; R is 0, 3, 8 or 15.
        quats: [N, 4] wxyz, any norm. Under the identity (x, y and z are 0) the result is bit-identical to the input.

    Returns:
        [N, R, 3]; degree 0 needs no rotation. No gradient.

    Raises:
        ValueError: a shape is wrong.
    """
    if sh_rest.ndim != 3 or sh_rest.shape[2] != 3 or sh_rest.shape[1] not in SIZES:
        raise ValueError(f"sh_rest must be [N, R, 3] with R in {SIZES}, got {tuple(sh_rest.shape)}")
    if tuple(quats.shape) != (sh_rest.shape[0], 4):
        raise ValueError(f"quats must be [{sh_rest.shape[0]}, 4], got {tuple(quats.shape)}")
    rest = sh_rest.shape[1]
    if not rest:
        return sh_rest.detach()
    source = sh_rest.detach().contiguous()
    turned = torch.empty_like(source)
    directions, inverses = (table.to(source.device) for table in _tables())
    launch(
        kernels.rotate_harmonics,
        source.shape[0],
        source.view(-1, 3),
        rest,
        quats.detach().contiguous(),
        directions,
        inverses,
        turned.view(-1, 3),
        grain=256,
    )
    return turned
