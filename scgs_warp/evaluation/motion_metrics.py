"""Metrics of motion for data with known true motion: end-point error and jitter of surface tracks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..errors import UserError
from ..storage.numpy_files import read_npy

FILE = "ground_truth.npz"
OPAQUE = 0.5
"""Opacity above which a Gaussian can carry a surface point."""
LEAST_LENGTH, MOST_LENGTH = 1e-15, 1e15
"""Bounds of a height or a coordinate, so that its square fits in float32."""
CHUNK = 128
"""Number of surface points processed at once; their distances to all Gaussians are in memory."""


@dataclass(frozen=True)
class GroundTruth:
    """Tracks of surface points, world units."""

    points: Tensor
    """[T, P, 3]"""
    times: Tensor
    """[T] in [0, 1], increasing."""
    visible: Tensor
    """[V, P] bool, True if the point is visible in the training view."""
    height: float
    """Height of the figure; errors are given in percent of it."""


class MotionScore(NamedTuple):
    """Scores in percent of the figure's height; NaN if there is no Gaussian or no visible point."""

    epe: float
    """Mean distance between the predicted and the true point, over times and visible points."""
    jitter: float
    """Mean norm of the second difference in time of (predicted track - true track). NaN with fewer than 3 times."""


def load_ground_truth(folder: str | Path) -> GroundTruth | None:
    """Read ``ground_truth.npz`` of a data set; None where the file is missing.

    Raises:
        UserError: the file is damaged, or a field is missing or misshapen.
    """
    path = Path(folder) / FILE
    if not path.is_file():
        return None
    points, times, height = (read_npy(path, name) for name in ("points", "times", "height"))
    visible = read_npy(path, "visible", "flags")
    if points.ndim != 3 or points.shape[2] != 3 or len(points) < 1 or times.shape != points.shape[:1]:
        raise UserError(f"{path}: points {points.shape} and times {times.shape} must be [T, P, 3] and [T]")
    if visible.ndim != 2 or visible.shape[1] != points.shape[1] or visible.dtype != bool:
        raise UserError(f"{path}: visible {visible.shape} must be [V, P] of booleans with P = {points.shape[1]}")
    if height.shape != () or not LEAST_LENGTH < float(height) < MOST_LENGTH or not (np.abs(points) < MOST_LENGTH).all():
        raise UserError(f"{path}: height must be one positive number and points finite; make the file again")
    if not ((times >= 0) & (times <= 1)).all() or (np.diff(times) <= 0).any():
        raise UserError(f"{path}: times must increase within [0, 1]; make the file again")
    return GroundTruth(
        torch.from_numpy(points).float(), torch.from_numpy(times).float(), torch.from_numpy(visible), float(height)
    )


def score_motion(
    truth: GroundTruth, positions_at: Callable[[float], Tensor], opacities: Tensor | None = None
) -> MotionScore:
    """Score the motion of a set of Gaussians by end-point error and jitter.

    A surface point is carried by the opaque Gaussian nearest to it at the first time: its predicted track is
    ``point(t0) + gaussian(t) - gaussian(t0)``, so that at t0 the error is 0 and only motion is judged. A point counts,
    at all times, if at least one training view sees it; other points cannot be reconstructed. If no Gaussian is opaque,
    all Gaussians are candidates.

    Args:
        positions_at: function from a time in [0, 1] to Gaussian centres [N, 3], world units, always in the same order.
        opacities: [N]; None: all Gaussians are opaque.
    """
    counted = truth.visible.any(dim=0)
    points = truth.points[:, counted].double()
    start = positions_at(float(truth.times[0])).detach().cpu().double()
    candidates = torch.arange(len(start))
    if opacities is not None:
        if opacities.shape != start.shape[:1]:
            raise ValueError(f"opacities must be [{len(start)}], got {list(opacities.shape)}")
        opaque = (opacities.detach().cpu() > OPAQUE).nonzero().squeeze(1)
        candidates = opaque if len(opaque) else candidates
    if not len(candidates) or not points.shape[1]:
        return MotionScore(float("nan"), float("nan"))
    carrier = candidates[_nearest(points[0], start[candidates])]
    tracks = []
    for time in truth.times.tolist():
        moved = positions_at(time).detach().cpu().double()
        if moved.shape != start.shape:
            raise ValueError(f"positions_at({time:g}) must be {list(start.shape)}, got {list(moved.shape)}")
        tracks.append(points[0] + moved[carrier] - start[carrier])
    return score_tracks(torch.stack(tracks), points, truth.height)


def score_tracks(predicted: Tensor, true: Tensor, height: float) -> MotionScore:
    """Score tracks [T, P, 3] in world units."""
    error = predicted.double() - true.double()
    bend = error[2:] - 2.0 * error[1:-1] + error[:-2]
    percent = 100.0 / height
    return MotionScore(float(error.norm(dim=2).mean()) * percent, float(bend.norm(dim=2).mean()) * percent)


def _nearest(points: Tensor, centres: Tensor) -> Tensor:
    """Return the index [P] of the centre nearest to each point; of equally near centres, the first."""
    indices = [
        torch.cdist(chunk, centres, compute_mode="donot_use_mm_for_euclid_dist").argmin(dim=1)
        for chunk in points.split(CHUNK)
    ]
    return torch.cat(indices)
