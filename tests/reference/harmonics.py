"""Real spherical harmonics from their definition (associated Legendre polynomials), in plain torch, differentiable."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def legendre(l: int, m: int, z: Tensor) -> Tensor:
    """The associated Legendre polynomial P_l^m(z) divided by (1 - z^2)^(m / 2), with the Condon-Shortley sign."""
    start = torch.full_like(z, float((-1) ** m * math.prod(range(1, 2 * m, 2))))
    if l == m:
        return start
    previous, current = start, (2 * m + 1) * z * start
    for degree in range(m + 2, l + 1):
        previous, current = current, ((2 * degree - 1) * z * current - (degree + m - 1) * previous) / (degree - m)
    return current


def basis(directions: Tensor, degree: int) -> Tensor:
    """[N, (degree + 1)^2] at unit directions; Re and Im of (x + iy)^m carry the azimuth."""
    x, y, z = directions.unbind(-1)
    columns = []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            k = abs(m)
            norm = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - k) / math.factorial(l + k))
            real, imaginary = torch.ones_like(x), torch.zeros_like(x)
            for _ in range(k):
                real, imaginary = real * x - imaginary * y, real * y + imaginary * x
            azimuth = imaginary if m < 0 else real
            columns.append(norm * (math.sqrt(2.0) if m else 1.0) * azimuth * legendre(l, k, z))
    return torch.stack(columns, dim=-1)


def spherical_harmonics(sh_dc: Tensor, sh_rest: Tensor, means: Tensor, camera: Tensor, degree: int) -> Tensor:
    """[N, 3] max(harmonics + 0.5, 0)."""
    offsets = means - camera
    distance = offsets.norm(dim=-1, keepdim=True)
    directions = torch.where(distance > 0, offsets / torch.where(distance > 0, distance, 1.0), 0.0)
    coefficients = torch.cat([sh_dc[:, None], sh_rest], dim=1)[:, : (degree + 1) ** 2]
    return ((basis(directions, degree)[..., None] * coefficients).sum(1) + 0.5).clamp_min(0.0)
