"""The end of a training whose scene shows nothing in any view."""

from __future__ import annotations

from pathlib import Path

import torch

from ..data.dataset import Dataset, spread
from ..errors import UserError
from ..scene.scene import Scene
from .recall import LEAST_DIFFERENCE
from .state import TrainState

VIEWS = 20
"""Largest number of views in which something is sought."""


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
