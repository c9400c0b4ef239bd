"""Affine colours of frames: what exposure and white balance did to each image of a film.

A frame shows ``M color + t`` of a surface whose colour is ``color`` in the scene, with a matrix M and an offset t of
its own. The mean of all frames' colours is the identity.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from ..storage import checkpoint

PREFIX = "frame_colors."
FEWEST_PIXELS = 16
"""Number of valid pixels below which no colour is fitted to an image."""
RIDGE = 1e-4
"""Weight of the distance to the identity in a fit, relative to one pixel: it decides where an image has one colour
only."""


def apply_color(color: Tensor, image: Tensor) -> Tensor:
    """Apply an affine colour [3, 4] to an image [3, ...]; differentiable in both."""
    flat = image.reshape(3, -1)
    return (color[:, :3] @ flat + color[:, 3:]).view_as(image)


def fitted_color(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> Tensor:
    """Fit the affine colour [3, 4] that maps an image to the truth, both [H, W, 3], in the least-squares sense.

    Args:
        mask: [H, W] bool, True where the truth is valid.
    """
    valid = slice(None) if mask is None else mask.reshape(-1)
    source = image.detach().reshape(-1, 3)[valid].double()
    target = truth.detach().reshape(-1, 3)[valid].double()
    identity = torch.eye(3, 4, dtype=torch.float64, device=image.device)
    if len(source) < FEWEST_PIXELS:
        return identity.float()
    rows = torch.cat([source, torch.ones_like(source[:, :1])], 1)
    normal = rows.T @ rows + RIDGE * torch.eye(4, dtype=torch.float64, device=image.device)
    wanted = rows.T @ target + RIDGE * identity.T
    return torch.linalg.solve(normal, wanted).T.float()


class FrameColors(NamedTuple):
    """Affine colours of training frames."""

    times: Tensor
    """[V] in [0, 1]"""
    colors: Tensor
    """[V, 3, 4]"""

    def at(self, time: float) -> Tensor:
        """Return the colour [3, 4] between the frames before and after ``time``; frames of one time are averaged."""
        moments, where = torch.unique(self.times, return_inverse=True)
        sums = torch.zeros(len(moments), 3, 4).index_add_(0, where, self.colors)
        means = sums / torch.bincount(where, minlength=len(moments))[:, None, None]
        after = int(torch.searchsorted(moments, torch.tensor(float(time)))) if len(moments) > 1 else 0
        after = min(max(after, 1), len(moments) - 1) if len(moments) > 1 else 0
        before = max(after - 1, 0)
        span = float(moments[after] - moments[before])
        share = min(max((time - float(moments[before])) / span, 0.0), 1.0) if span > 0 else 0.0
        return means[before] + share * (means[after] - means[before])

    @staticmethod
    def read(folder: Path) -> FrameColors | None:
        """Read the colours of a run; return None if it learnt none.

        Raises:
            UserError: the checkpoint is missing or damaged.
        """
        tensors, _ = checkpoint.read(folder, (PREFIX,))
        times, offsets = tensors.get(f"{PREFIX}times"), tensors.get(f"{PREFIX}offsets")
        if times is None or offsets is None or times.ndim != 1 or offsets.shape != (len(times), 3, 4) or not len(times):
            return None
        times, offsets = times.float().cpu(), offsets.float().cpu()
        if not bool(torch.isfinite(times).all() and torch.isfinite(offsets).all()):
            return None
        return FrameColors(times, torch.eye(3, 4) + offsets)
