"""Poses sampled once and interpolated: a frame of a finished motion then needs no network."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ..runtime import memory
from ..types import Pose

FIRST = 64
"""Number of intervals of the first attempt."""
MOST = 2048
"""Largest number of intervals. At a kink of a ReLU the error falls linearly with the interval, so many are needed."""
RELATIVE = 3e-3
"""Largest error of the logarithm of a scale or a colour."""
BATCH = 16
"""Number of instants of one evaluation of the network."""
FIELDS = {"translations": 3, "rotations": 4, "shape_rotations": 4, "log_scales": 3, "tints": 3}
TURNS = ("rotations", "shape_rotations")


@dataclass(frozen=True)
class PoseTrack:
    """Poses of M control points at evenly spaced instants from 0 to 1, interpolated linearly between them."""

    rows: Tensor
    """[S + 1, M, W] the fields of a pose side by side."""
    fields: dict[str, slice]
    """Columns of each field that the poses have."""
    error: float
    """Largest error found with intervals twice as long: of a position, or of a turn times ``reach``, in units of the
    positions."""

    @staticmethod
    def of(
        poses_at: Callable[[Tensor], list[Pose]],
        reach: float,
        tolerance: float,
        tell: Callable[[int, int], None] = lambda done, total: None,
    ) -> PoseTrack | None:
        """Sample a motion, more densely until interpolation errs by at most ``tolerance``.

        The error is measured at the middles of all intervals, which then become samples themselves: the track returned
        has half the interval at which the tolerance was met.

        Args:
            poses_at: returns one pose for each time [T].
            reach: distance at which a control point's turn acts, in units of the positions.
            tolerance: in units of the positions; scales and colours have ``RELATIVE``.
            tell: told how many of how many instants are sampled.

        Returns:
            The track, or None if half of ``MOST`` intervals are too few or there is no memory for more.
        """
        fields, first = _columns(poses_at(torch.zeros(1))[0])
        intervals, rows = FIRST, _sampled(poses_at, torch.arange(FIRST + 1) / FIRST, fields)
        rows[0] = first
        while True:
            tell(len(rows), MOST + 1)
            middles = _sampled(poses_at, (torch.arange(intervals) + 0.5) / intervals, fields)
            error, relative = _errors(rows, middles, fields, reach)
            intervals *= 2
            both = rows.new_empty(intervals + 1, *rows.shape[1:])
            both[::2], both[1::2] = rows, middles
            rows = _aligned(both, fields)
            if error <= tolerance and relative <= RELATIVE:
                tell(len(rows), len(rows))
                return PoseTrack(rows, fields, error)
            if intervals >= MOST or not memory.fits(3 * rows.nbytes, rows.device):
                return None

    @property
    def intervals(self) -> int:
        return len(self.rows) - 1

    def at(self, time: float) -> Pose:
        """Return the pose at ``time`` in [0, 1]."""
        place = min(max(time, 0.0), 1.0) * self.intervals
        index = min(int(place), self.intervals - 1)
        row = torch.lerp(self.rows[index], self.rows[index + 1], place - index)
        return Pose(**{name: _field(row, name, columns) for name, columns in self.fields.items()})


def _field(row: Tensor, name: str, columns: slice) -> Tensor:
    value = row[:, columns]  # a turn lies between two that are on the same side, so its norm is not 0
    return value / torch.linalg.vector_norm(value, dim=1, keepdim=True) if name in TURNS else value.contiguous()


def _columns(pose: Pose) -> tuple[dict[str, slice], Tensor]:
    """Return the columns of the fields that a pose has, and its row."""
    fields, at = {}, 0
    for name, width in FIELDS.items():
        if getattr(pose, name) is not None:
            fields[name] = slice(at, at + width)
            at += width
    return fields, _row(pose, fields)


def _row(pose: Pose, fields: dict[str, slice]) -> Tensor:
    return torch.cat([getattr(pose, name) for name in fields], dim=1)


def _sampled(poses_at: Callable[[Tensor], list[Pose]], times: Tensor, fields: dict[str, slice]) -> Tensor:
    rows = [_row(pose, fields) for part in times.split(BATCH) for pose in poses_at(part)]
    return torch.stack(rows)


def _aligned(rows: Tensor, fields: dict[str, slice]) -> Tensor:
    """Give neighbouring quaternions the same sign."""
    for name in TURNS:
        if name in fields:
            turns = rows[..., fields[name]]
            opposite = (turns[1:] * turns[:-1]).sum(-1) < 0.0
            sign = 1.0 - 2.0 * (opposite.cumsum(0) % 2).to(rows.dtype)
            turns[1:] *= sign[..., None]
    return rows


def _errors(rows: Tensor, middles: Tensor, fields: dict[str, slice], reach: float) -> tuple[float, float]:
    """Return the largest errors of interpolation in the middles of the intervals: as a distance, and of logarithms."""
    means = torch.lerp(_aligned(rows, fields)[:-1], rows[1:], 0.5)
    distance = relative = 0.0
    for name, columns in fields.items():
        ours, truth = means[..., columns], middles[..., columns]
        if name in TURNS:
            ours = F.normalize(ours, dim=-1)
            apart = float(torch.minimum((ours - truth).norm(dim=-1), (ours + truth).norm(dim=-1)).max())
            distance = max(distance, reach * 4.0 * math.asin(min(0.5 * apart, 1.0)))
        elif name == "translations":
            distance = max(distance, float((ours - truth).norm(dim=-1).max()))
        else:
            relative = max(relative, float((ours - truth).abs().max()))
    return distance, relative
