"""Depth of the surface that Gaussians form in an image, without gradients."""

from __future__ import annotations

import torch
from torch import Tensor

from ..kernels import surface_depth as kernels
from ..runtime.launch import launch
from ..types import Camera, Gaussians, Splats, Tiles


@torch.no_grad()
def surface_depth(gaussians: Gaussians, splats: Splats, tiles: Tiles, camera: Camera, level: float = 0.5) -> Tensor:
    """Return the depth at which the opacity accumulated along each pixel's ray reaches a level.

    Args:
        gaussians: N activated Gaussians.
        splats: projection of the same Gaussians to the camera.
        tiles: result of ``bin_splats(splats)``.
        camera: on the device of the Gaussians.
        level: in (0, 1).

    Returns:
        [H, W] camera z, in the units of the Gaussians; 0 where the ray does not reach the level.

    Raises:
        ValueError: the level, a count or a size is wrong.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level must lie between 0 and 1, got {level}")
    count = len(gaussians.means)
    if len(splats.means2d) != count:
        raise ValueError(f"splats are {len(splats.means2d)}, Gaussians {count}; project the same ones")
    if {(camera.width, camera.height), (splats.width, splats.height)} != {(tiles.width, tiles.height)}:
        raise ValueError(f"camera, splats and tiles must have one size, got tiles of {tiles.width} x {tiles.height}")
    device = gaussians.means.device
    points, whitenings = torch.empty(count, 3, device=device), torch.empty(count, 3, 3, device=device)
    shapes = (gaussians.means, gaussians.quats, gaussians.scales)
    launch(kernels.whiten, count, *_plain(*shapes, camera.viewmat[None]), points, whitenings)
    depth = torch.empty(camera.height, camera.width, device=device)
    flat = _plain(splats.means2d, splats.conics, splats.opacities)
    launch(
        kernels.surface_depth, depth.numel(), *flat, points, whitenings, *_plain(camera.K[None]), tiles.ranges,
        tiles.splats, tiles.width, tiles.columns, splats.sharpness, tiles.tile_size, level, depth, grain=64,
    )  # fmt: skip
    return depth


def _plain(*tensors: Tensor) -> tuple[Tensor, ...]:
    return tuple(tensor.detach().contiguous() for tensor in tensors)
