"""Feature planes over (x, y, z, t), in torch on any device: sampled features and a smoothness term (4D-GS)."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..runtime.device_copies import sent

PAIRS = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))
"""Axes of the six planes of a level; 3 is time."""

CHANNELS = 32


class Smoothness(NamedTuple):
    """Weights of the smoothness terms. Each term is a mean over its texels, summed over the planes."""

    space: float = 1.0
    """Squared first differences along x, y and z, in all planes: total variation."""
    time: float = 1.0
    """Squared second differences along t, so that features may change, but evenly."""
    rest: float = 0.0
    """Absolute distances of the time planes from 1, the value for a scene at rest."""


EVEN = Smoothness()


def plane_features(positions: Tensor, time: float | Tensor, planes: list[Tensor]) -> Tensor:
    """Multiply six bilinear samples for each Gaussian and level, and concatenate the levels.

    Args:
        positions: [N, 3]. The planes span [-1, 1], with the first and last texels at the ends. On the border and beyond
            it, samples are the border's and pass no gradient to the position. A NaN coordinate counts as -1.
        time: a number, or a tensor [1] on the positions' device (no gradient; the host does not read it); clamped to
            [0, 1] (NaN: 0), which the time planes span.
        planes: six per level, in the order of :data:`PAIRS`: [second axis, first axis, 32], float32, at least two
            texels per side. The planes of a level that share an axis have the same extent along it.

    Returns:
        [N, 32 levels]. Gradients reach the positions and all planes. torch sums the gradients of the planes
        sequentially on a CPU, and atomically on CUDA.

    Raises:
        ValueError: a shape, dtype or device does not fit.
    """
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(f"positions must be [N, 3], got {tuple(positions.shape)}")
    _validate(planes)
    if positions.dtype != torch.float32 or positions.device != planes[0].device:
        raise ValueError("positions and planes must be float32 on one device")
    inside = positions.nan_to_num(nan=-1.0)
    instant = time if isinstance(time, Tensor) else sent(torch.tensor([time]), positions.device)
    t = 2.0 * instant.detach().nan_to_num(nan=0.0).clamp(0.0, 1.0) - 1.0
    axes = [*inside.unbind(1), t.expand(len(inside))]
    levels = []
    for level in range(0, len(planes), len(PAIRS)):
        product = None
        for (first, second), plane in zip(PAIRS, planes[level : level + len(PAIRS)]):
            grid = torch.stack([axes[first], axes[second]], dim=1)[None, None]
            image = plane.permute(2, 0, 1)[None]
            sample = F.grid_sample(image, grid, align_corners=True, padding_mode="border")[0, :, 0]
            product = sample if product is None else product * sample
        levels.append(product)
    return torch.cat(levels).T.contiguous()


def plane_variation(planes: list[Tensor], weights: Smoothness = EVEN) -> Tensor:
    """Measure how uneven the planes are, a scalar: the terms of :class:`Smoothness` times their ``weights``.

    Args:
        planes: as for :func:`plane_features`.

    Raises:
        ValueError: a shape, dtype or device does not fit.
    """
    _validate(planes)
    terms = []
    for index, plane in enumerate(planes):
        has_time = index % len(PAIRS) >= 3
        down = plane.diff(dim=0, n=2 if has_time else 1)
        parts = [(weights.space, plane.diff(dim=1).square())]
        parts.append((weights.time if has_time else weights.space, down.square()))
        if has_time:
            parts.append((weights.rest, (plane - 1.0).abs()))
        # Summing rows first makes the order of the sums independent of the number of threads.
        terms += [weight * part.mean(-1).mean(-1).mean() for weight, part in parts if part.numel()]
    return torch.stack(terms).sum()


def _validate(planes: list[Tensor]) -> None:
    if not planes or len(planes) % len(PAIRS):
        raise ValueError(f"planes must be six a level, got {len(planes)}")
    for index, plane in enumerate(planes):
        first, second = PAIRS[index % len(PAIRS)]
        level = index - index % len(PAIRS)
        # A level's extents are taken from its planes: x and t from (x, t), y from (y, t), and z from (z, t).
        extents = [planes[level + 3 + axis].shape[1:2] for axis in range(3)] + [planes[level + 3].shape[:1]]
        expected = (*extents[second], *extents[first], CHANNELS)
        if tuple(plane.shape) != expected or min(expected) < 2:
            raise ValueError(f"planes[{index}] must be {list(expected)}, sides 2 or more, got {list(plane.shape)}")
    if any(plane.dtype != torch.float32 or plane.device != planes[0].device for plane in planes):
        raise ValueError("planes must be float32 on one device")
