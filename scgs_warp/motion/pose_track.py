"""Poses sampled once and interpolated: a frame of a finished motion then needs no network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ..types import Pose

FIRST = 64
"""Number of intervals of the first attempt."""
MOST = 2048
"""Largest number of intervals: a network of ReLUs has corners, whose error falls with the interval alone."""
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
    """Largest error found: of an interpolated position, or of a turn times ``reach``, in units of the positions."""

    @staticmethod
    def of(
        poses_at: Callable[[Tensor], list[Pose]],
        reach: float,
        tolerance: float,
        tell: Callable[[int, int], None] = lambda done, total: None,
    ) -> PoseTrack | None:
        """Sample a motion, more densely until interpolation errs by at most ``tolerance``; None if it never does.

        The error is measured at the middles of all intervals, which then become samples themselves, so that the track
        returned has half the interval at which the tolerance was met.

        Args:
            poses_at: returns one pose for each time [T].
            reach: distance at which a control point's turn acts, in units of the positions.
            tolerance: in units of the positions.
            tell: told how many of how many instants are sampled.
        """
        fields, first = _columns(poses_at(torch.zeros(1))[0])
        intervals, rows = FIRST, _sampled(poses_at, torch.arange(FIRST + 1) / FIRST, fields)
        rows[0] = first
        while True:
            tell(len(rows), MOST + 1)
            middles = _sampled(poses_at, (torch.arange(intervals) + 0.5) / intervals, fields)
            error = _error(rows, middles, fields, reach)
            intervals *= 2
            both = rows.new_empty(intervals + 1, *rows.shape[1:])
            both[::2], both[1::2] = rows, middles
            rows = _aligned(both, fields)
            if error <= tolerance:
                return PoseTrack(rows, fields, error)
            if intervals >= MOST:
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
    value = row[:, columns]
    return F.normalize(value, dim=1) if name in TURNS else value.contiguous()


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


def _error(rows: Tensor, middles: Tensor, fields: dict[str, slice], reach: float) -> float:
    """Return the largest error of interpolation in the middles of the intervals."""
    means = torch.lerp(_aligned(rows, fields)[:-1], rows[1:], 0.5)
    columns = fields["translations"]
    error = (means[..., columns] - middles[..., columns]).norm(dim=-1).max()
    for name in TURNS:
        if name in fields:
            ours, truth = F.normalize(means[..., fields[name]], dim=-1), middles[..., fields[name]]
            apart = torch.minimum((ours - truth).norm(dim=-1), (ours + truth).norm(dim=-1))
            error = torch.maximum(error, reach * 4.0 * torch.asin((0.5 * apart.max()).clamp(max=1.0)))
    return float(error)
