"""Feature planes over (x, y, z, t): what Gaussians read from them, what keeps them smooth (4D-GS; seed Table S2)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ..kernels.cpu import planes as kernels
from ..kernels.cpu import planes_variation as variation_kernels
from ..runtime.launch import launch

PAIRS = ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3))
"""Axes of the six planes of a level; 3 is time."""

CHANNELS = kernels.CHANNELS


class Smoothness(NamedTuple):
    """Weights of what keeps planes smooth. Each term is a mean over its texels, summed over the planes."""

    space: float = 1.0
    """Squared first differences along x, y and z, in all planes: total variation."""
    time: float = 1.0
    """Squared second differences along t: features may change, but evenly."""
    rest: float = 0.0
    """Absolute distances of the time planes from 1, where nothing moves."""


EVEN = Smoothness()


class _Table:
    """Where the kernels find the planes, their lines at one time, and their gradients."""

    def __init__(self, planes: list[Tensor]) -> None:
        rows, line = [], 0
        for place, plane in enumerate(planes):
            timely = place % len(PAIRS) >= 3
            rows.append([plane.data_ptr(), plane.shape[1], plane.shape[0], line if timely else -1, 0])
            line += plane.shape[1] * CHANNELS if timely else 0
        self.planes, self.levels, self.lines = planes, len(planes) // len(PAIRS), line
        self.tallest = max(plane.shape[0] for plane in planes)
        self.table = torch.tensor(rows, dtype=torch.int64)

    def at_time(self, time: float) -> Tensor:
        lines = torch.empty(self.lines)
        launch(kernels.interpolate_times, 3 * self.levels, time, self.table, lines, grain=1)
        return lines

    def features(self, positions: Tensor, lines: Tensor) -> Tensor:
        count = positions.shape[0]
        features = torch.empty(count, CHANNELS * self.levels)
        blocks = -(-count // kernels.LANES)
        launch(kernels.plane_features, blocks, self.table, positions, lines, features, grain=16)
        return features

    def variation(self, weights: Smoothness) -> Tensor:
        sums = torch.zeros(len(self.planes) * self.tallest)
        launch(variation_kernels.plane_variation, len(sums), self.tallest, *weights, self.table, sums, grain=64)
        return sums @ torch.ones_like(sums)

    def gradients(self, v_variation: float, weights: Smoothness) -> list[Tensor]:
        """Room for the planes' gradients, which the table names from now on: that of the variation is there."""
        flat = torch.empty(sum(plane.numel() for plane in self.planes))
        found = [part.view_as(p) for part, p in zip(flat.split([p.numel() for p in self.planes]), self.planes)]
        self.table[:, 4] = torch.tensor([gradient.data_ptr() for gradient in found])
        tasks = len(self.planes) * self.tallest
        kernel = variation_kernels.plane_variation_adjoint
        launch(kernel, tasks, self.tallest, v_variation, *weights, self.table, grain=64)
        return found

    def add_gradients(self, positions: Tensor, time: float, lines: Tensor, v_features: Tensor) -> Tensor:
        """That of the features to the planes' room; returns that of the positions."""
        tasks = self.levels * kernels.HALVES
        shares = torch.empty(tasks, *positions.shape)
        v_lines = torch.zeros_like(lines)
        launch(
            kernels.plane_features_adjoint,
            tasks, time, self.table, positions, lines, v_features, v_lines, shares,
            grain=1,
        )  # fmt: skip
        v_positions = shares[0]
        for share in shares[1:]:
            v_positions += share
        return v_positions


class _Planes(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, positions, time: float, weights: Smoothness | None, *planes):
        ctx.set_materialize_grads(False)
        table = _Table(list(planes))
        lines = table.at_time(time)
        ctx.time, ctx.weights = time, weights or Smoothness()
        ctx.save_for_backward(positions, lines, *planes)
        return table.features(positions, lines), table.variation(weights) if weights else None

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients):  # type: ignore[override]
        v_features, v_variation = gradients
        positions, lines, *planes = ctx.saved_tensors
        table = _Table(planes)
        v_planes = table.gradients(0.0 if v_variation is None else float(v_variation), ctx.weights)
        v_positions = None
        if v_features is not None:
            v_positions = table.add_gradients(positions, ctx.time, lines, v_features.contiguous())
        return v_positions, None, None, *v_planes


def plane_features(positions: Tensor, time: float | Tensor, planes: list[Tensor]) -> Tensor:
    """The product of six bilinear samples for each Gaussian and level; levels side by side.

    Args:
        positions: [N, 3]; the planes span [-1, 1], first and last texels at the ends. Outside, the border's value
            counts and has no gradient to the position, nor has it on the border itself. A coordinate that is not a
            number counts as -1.
        time: clamped to [0, 1] (not a number: 0), or such a tensor [1] on the positions' device (no gradient; on CUDA
            the host does not read it); the time planes span that.
        planes: six a level, in the order of :data:`PAIRS`: [second axis, first axis, 32], float32, two texels a side
            at least. The planes of a level have the same extent along the same axis.

    Returns:
        [N, 32 levels]. Gradients go to the positions and to all planes; on a CPU their sums are taken in a fixed
        order.

    Raises:
        ValueError: a shape, dtype or device does not fit.
    """
    return _run(positions, time, planes, None)[0]


def plane_features_and_variation(
    positions: Tensor, time: float | Tensor, planes: list[Tensor], weights: Smoothness = EVEN
) -> tuple[Tensor, Tensor]:
    """:func:`plane_features` and :func:`plane_variation` in one: their gradients share one pass over the planes."""
    features, variation = _run(positions, time, planes, weights)
    return features, variation


def plane_variation(planes: list[Tensor], weights: Smoothness = EVEN) -> Tensor:
    """How uneven the planes are, a scalar: the terms of :class:`Smoothness` times their ``weights``. Planes as for
    :func:`plane_features`."""
    nowhere = planes[0].new_empty(0, 3) if planes else torch.empty(0, 3)
    return _run(nowhere, 0.0, planes, weights)[1]


def _run(
    positions: Tensor, time: float | Tensor, planes: list[Tensor], weights: Smoothness | None
) -> tuple[Tensor, Any]:
    _validate(positions, planes)
    if positions.device.type != "cpu":
        return _features_in_torch(positions, time, planes), _variation_in_torch(planes, weights) if weights else None
    contiguous = [plane.contiguous() for plane in planes]
    return _Planes.apply(positions.contiguous(), float(time), weights, *contiguous)  # type: ignore[return-value]


def _features_in_torch(positions: Tensor, time: float | Tensor, planes: list[Tensor]) -> Tensor:
    """On CUDA; torch's kernel adds the planes' gradients atomically."""
    kept = positions.nan_to_num(nan=-1.0)  # no gradient there, as on a CPU
    if isinstance(time, Tensor):
        time = time.nan_to_num(nan=0.0).clamp(0.0, 1.0)
    else:
        time = time if 0.0 <= time <= 1.0 else float(time > 1.0)
    when = 2.0 * time - 1.0
    last = when.detach().expand(len(kept)) if isinstance(when, Tensor) else kept.new_full((len(kept),), when)
    axes = [*kept.unbind(1), last]
    found = []
    for level in range(0, len(planes), len(PAIRS)):
        product = None
        for (first, second), plane in zip(PAIRS, planes[level : level + len(PAIRS)]):
            grid = torch.stack([axes[first], axes[second]], dim=1)[None, None]
            image = plane.permute(2, 0, 1)[None]
            sample = F.grid_sample(image, grid, align_corners=True, padding_mode="border")[0, :, 0]
            product = sample if product is None else product * sample
        found.append(product)
    return torch.cat(found).T


def _variation_in_torch(planes: list[Tensor], weights: Smoothness) -> Tensor:
    terms = []
    for place, plane in enumerate(planes):
        timely = place % len(PAIRS) >= 3
        down = plane.diff(dim=0, n=2 if timely else 1)
        parts = [(weights.space, plane.diff(dim=1).square())]
        parts.append((weights.time if timely else weights.space, down.square()))
        if timely:
            parts.append((weights.rest, (plane - 1.0).abs()))
        # Row by row first: the order of the sums does not depend on the number of threads.
        terms += [weight * part.mean(-1).mean(-1).mean() for weight, part in parts if part.numel()]
    return torch.stack(terms).sum()


def _validate(positions: Tensor, planes: list[Tensor]) -> None:
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(f"positions must be [N, 3], got {tuple(positions.shape)}")
    if not planes or len(planes) % len(PAIRS):
        raise ValueError(f"planes must be six a level, got {len(planes)}")
    for place, plane in enumerate(planes):
        first, second = PAIRS[place % len(PAIRS)]
        own = place - place % len(PAIRS)
        # Extents of a level: x and t from plane (x, t), y and z from (y, t) and (z, t).
        extents = [planes[own + 3 + axis].shape[1:2] for axis in range(3)] + [planes[own + 3].shape[:1]]
        expected = (*extents[second], *extents[first], CHANNELS)
        if tuple(plane.shape) != expected or min(expected) < 2:
            raise ValueError(f"planes[{place}] must be {list(expected)}, sides 2 or more, got {list(plane.shape)}")
    if any(t.dtype != torch.float32 or t.device != positions.device for t in (positions, *planes)):
        raise ValueError("positions and planes must be float32 on one device")
