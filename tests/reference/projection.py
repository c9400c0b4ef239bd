"""EWA projection in plain torch, differentiable: matrices as the papers write them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from reference.covariance import covariance


class Projected(NamedTuple):
    """What ``scgs_warp.types.Splats`` holds."""

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor
    radii: Tensor


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    antialiased: bool = False,
    sharpness: float = 0.0,
) -> Projected:
    """All in the inputs' dtype. Culled rows are zero and get no gradient."""
    zero = torch.zeros((), dtype=means.dtype, device=means.device)
    finite = means.isfinite().all(1) & quats.isfinite().all(1) & scales.isfinite().all(1) & opacities.isfinite()
    known = finite & (quats.norm(dim=1) > 0)
    # Rows that cannot be computed are replaced before the arithmetic, so that no NaN reaches a gradient.
    means, scales = (torch.where(known[:, None], x, zero) for x in (means, scales))
    quats = torch.where(known[:, None], quats, torch.ones_like(quats))
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    depths = points[:, 2]
    ahead = known & (depths > 0) & (depths >= near_plane) & (depths <= far_plane)
    points = torch.where(ahead[:, None], points, torch.ones_like(points))
    x, y, z = points.unbind(1)

    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.3 * 0.5 * width / fx, 0.3 * 0.5 * height / fy
    u = torch.clamp(x / z, min=-cx / fx - margin_x, max=(width - cx) / fx + margin_x)
    v = torch.clamp(y / z, min=-cy / fy - margin_y, max=(height - cy) / fy + margin_y)
    empty = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, empty, -fx * u / z, empty, fy / z, -fy * v / z], dim=1).view(-1, 2, 3)
    transform = jacobian @ viewmat[:3, :3]
    raw = transform @ covariance(quats, scales) @ transform.transpose(1, 2)
    blurred = raw + eps2d * torch.eye(2, dtype=means.dtype, device=means.device)
    determinant = blurred[:, 0, 0] * blurred[:, 1, 1] - blurred[:, 0, 1] ** 2
    solid = ahead & (determinant > 0) & blurred.isfinite().all(2).all(1)
    safe = torch.where(solid, determinant, 1.0)

    if antialiased:
        ratio = (raw[:, 0, 0] * raw[:, 1, 1] - raw[:, 0, 1] ** 2) / safe
        factor = torch.where(solid & (ratio > 0), torch.where(ratio > 0, ratio, 1.0).sqrt(), zero)
        opacities = opacities * factor
    opaque = solid & (opacities * 255.0 >= 1.0)
    depth = torch.log(torch.where(opaque, opacities * 255.0, 1.0))
    if sharpness > 0:  # the positive root of u + s u^2 = depth
        depth = ((1 + 4 * sharpness * depth).sqrt() - 1) / (2 * sharpness)
    q = 2.0 * depth
    variances = torch.where(opaque[:, None], torch.stack([blurred[:, 0, 0], blurred[:, 1, 1]], dim=1), zero)
    radii = torch.ceil((q[:, None] * variances).detach().sqrt()).clamp_max(1e9)
    centre = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=1)
    size = torch.tensor([width, height], dtype=means.dtype, device=means.device)
    inside = ((centre + radii > 0) & (centre - radii < size) & (radii > 0)).all(1) & (radii > radius_clip).any(1)
    visible = opaque & inside

    conics = torch.stack([blurred[:, 1, 1], -blurred[:, 0, 1], blurred[:, 0, 0]], dim=1) / safe[:, None]
    return Projected(
        torch.where(visible[:, None], centre, zero),
        torch.where(visible[:, None], conics, zero),
        torch.where(visible, depths, zero),
        torch.where(visible, opacities, zero),
        torch.where(visible[:, None], radii, zero).int(),
    )


def camera_position(viewmat: Tensor) -> Tensor:
    """[3] world."""
    return -viewmat[:3, :3].T @ viewmat[:3, 3]


def rows_error(ours: Tensor, theirs: Tensor, floor: float = 1e-6) -> Tensor:
    """[N] relative L2 error of each row; rows smaller than ``floor`` of the whole tensor's norm count as that large."""
    ours, theirs = ours.double().reshape(len(ours), -1), theirs.double().reshape(len(theirs), -1)
    least = max(floor * theirs.norm().item(), 1e-30)
    return (ours - theirs).norm(dim=1) / theirs.norm(dim=1).clamp_min(least)
