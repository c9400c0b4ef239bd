"""Recall: if a view shows no Gaussian, the Gaussians are drawn back to where the cameras look.

Nothing else would move them, because a Gaussian that is not drawn has no gradient. Large steps of the motion, at the
start or after an opacity reset, can carry all Gaussians behind the camera.

On a GPU, the host learns the result of a step only when it starts the second step after it, and it must wait for each
step that may draw back Gaussians. Such steps therefore form a :class:`RecallPeriod`, the same on every device.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..geometry.normalisation import COMMON_RADIUS

RECALL = 0.2
"""Weight of the distance by which Gaussians are drawn back: about as strong as the image loss draws all of them
together."""
KNOWN_AFTER, LASTS = 2, 50
"""Number of steps from a step whose view shows nothing to the first step that may draw back, and to the first step
that no longer may."""
LEAST_DIFFERENCE = 1e-4
"""Difference from the truth above which an empty picture should show something."""


class RecallPeriod(NamedTuple):
    """Steps that may draw back: from ``begin`` to ``end``, which is excluded."""

    begin: int = 0
    end: int = 0

    def holds(self, step: int) -> bool:
        return self.begin <= step < self.end

    def after_nothing_shown(self, step: int) -> RecallPeriod:
        """Return the period once the view of ``step`` has shown nothing."""
        first = step + KNOWN_AFTER
        return RecallPeriod(self.begin if first <= self.end else first, step + LASTS)


def shows_too_little(shown: float, l1: float) -> bool:
    """Return whether a picture shows nothing, although it should.

    Args:
        shown: largest alpha of the picture.
        l1: difference between the picture and the truth.
    """
    return shown == 0.0 and l1 > LEAST_DIFFERENCE


def recall(means: Tensor) -> Tensor:
    """Return ``RECALL`` times the mean distance of [N, 3] normalised means to the region that all cameras see."""
    far = means.detach().norm(dim=1)
    chosen = far.isfinite() & (far > COMMON_RADIUS)  # what is not chosen gets a gradient of 0, also if not finite
    distances = torch.where(chosen[:, None], means, 0.0).norm(dim=1) - COMMON_RADIUS * chosen
    return RECALL * distances.sum() / len(means)
