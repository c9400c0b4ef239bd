"""Float64 twin of ops/harmonics_rotation.py: least squares over many directions, band by band."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from reference.harmonics import basis
from reference.skinning import matrix


def rotate_harmonics(sh_rest: Tensor, quats: Tensor) -> Tensor:
    seen = normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=1)
    turned = torch.zeros_like(sh_rest)
    degree = round((sh_rest.shape[1] + 1) ** 0.5) - 1
    for i, quat in enumerate(normalize(quats, dim=1)):
        before = seen @ matrix(quat)  # rows R^T d
        for l in range(1, degree + 1):
            own, band = slice(l * l, (l + 1) ** 2), slice(l * l - 1, (l + 1) ** 2 - 1)
            values = basis(before, degree)[:, own] @ sh_rest[i, band]
            turned[i, band] = torch.linalg.lstsq(basis(seen, degree)[:, own], values).solution
    return turned
