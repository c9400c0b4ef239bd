"""Scenes of which the views show nothing: drawn back while they train, recognised when nothing is left."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from ..data.dataset import Dataset, spread
from ..errors import UserError
from ..geometry.normalisation import COMMON_RADIUS
from ..scene.scene import Scene
from .state import TrainState

RECALL = 0.2
"""Weight of the distance by which Gaussians that a view does not show are drawn back: about as strong as the image loss
draws all of them together."""
RECALLED = 50
"""Number of steps on a GPU, after one whose view shows nothing, for which the host waits to see whether it must draw
back Gaussians."""
LEAST_DIFFERENCE = 1e-4
"""Difference from the truth above which an empty picture should show something."""
VIEWS = 20
"""Largest number of views in which something is sought."""


def recall(means: Tensor, alpha: Tensor, l1: Tensor) -> Tensor | None:
    """Draw back Gaussians of which a view shows none, although it should.

    Nothing else would: what is not drawn has no gradient. Large steps of the motion, at the start or after an opacity
    reset, can carry all of them behind the camera.

    Args:
        means: [N, 3] normalised.
        alpha: [H, W] of the picture.
        l1: scalar, difference between the picture and the truth.

    Returns:
        ``RECALL`` times the mean distance to the region that all cameras see; None where the view shows something.
    """
    if alpha.detach().any() or not should_show(float(l1.detach())):
        return None
    far = means.detach().norm(dim=1)
    chosen = far.isfinite() & (far > COMMON_RADIUS)  # what is not chosen gets a gradient of 0, also if not finite
    distances = torch.where(chosen[:, None], means, 0.0).norm(dim=1) - COMMON_RADIUS * chosen
    return RECALL * distances.sum() / len(means)


def should_show(l1: float) -> bool:
    """Return whether an empty picture that differs by ``l1`` from the truth should show something."""
    return l1 > LEAST_DIFFERENCE


def refuse_empty(state: TrainState, data: Dataset, folder: Path) -> None:
    """Refuse to go on, or to evaluate, when nothing is left of the scene. The checkpoint must be saved.

    Raises:
        UserError: no view shows anything.
    """
    if shows_nothing(state.scene(), data):
        raise UserError(
            f"{folder}: nothing is left of the scene at step {state.step:,}: no training view shows any of its "
            f"{len(state.gaussians):,} Gaussians; the checkpoint is kept; check cameras and focal lengths, or train "
            "again with another --output and another --seed or more --steps"
        )


@torch.no_grad()
def shows_nothing(scene: Scene, data: Dataset) -> bool:
    """Return whether none of up to ``VIEWS`` training views shows anything of the scene, though their images do."""
    sought, training = False, scene.motion.training
    scene.motion.eval()
    try:
        for index in spread(len(data), VIEWS):
            entry = data.entries[index]
            if bool(scene.render(entry.camera, entry.time).alpha.any()):
                return False
            sought = sought or has_content(data, index)
    finally:
        scene.motion.train(training)
    return sought


def has_content(data: Dataset, index: int) -> bool:
    """Return whether an image differs from the background; False if it is no longer readable."""
    try:
        frame = data[index]
    except UserError:
        return False
    differs = (frame.image - data.background_color).abs().amax(2) > LEAST_DIFFERENCE
    return bool((differs if frame.mask is None else differs & frame.mask).any())
