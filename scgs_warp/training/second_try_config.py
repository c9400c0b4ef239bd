"""When stage 1 is tried a second time, and with which settings."""

from __future__ import annotations

import dataclasses

from ..config.presets import TrainConfig
from ..data.dataset import Dataset
from .body_turn import turns_round
from .scene_distance import place
from .silhouettes import is_one_piece

STIFFER = 10.0
"""Weight of ARAP in a second try at stage 1, relative to the first."""
LEAST_VISITS = 20
"""Number of steps of stage 1 per frame below which a second try hardly follows the motion from frame to frame."""


LEAST_STEPS = 500
"""Number of steps of stage 1 below which it is not tried a second time for a subject that turns as a whole."""
HELD = 0.1
"""Share of the steps of a second try in which a motion found from silhouettes stays as it is."""


def may_be_tried_again(config: TrainConfig, data: Dataset, thin: bool) -> bool:
    """Decide whether a second try may help: for a cut-out subject that is not thin, without progressive pre-training,
    with enough steps for each frame, or if the subject turns as a whole. In thin subjects, neighbours of a sphere are
    often those of another limb."""
    pretrain = config.pretrain
    if not data.with_alpha or thin or pretrain.progressive or pretrain.arap_weight == 0.0:
        return False
    if config.pretrain_steps >= LEAST_VISITS * len(data):
        return True
    turns = pretrain.body_turn and config.pretrain_steps >= LEAST_STEPS and is_one_piece(data)
    return turns and turns_round(data, place(data).normalisation)


def second_config(config: TrainConfig, *, turning: bool) -> TrainConfig:
    """Return the configuration of the second try.

    Args:
        turning: the spheres begin with a turn of the whole subject; otherwise they follow frame by frame.
    """
    pretrain = config.pretrain
    how = {"warm_up": 0} if turning else {"progressive": True, "progressive_by": "frame"}
    weight = STIFFER * pretrain.arap_weight
    changed = dataclasses.replace(pretrain, arap_by="moment", arap_weight=weight, **how)
    return dataclasses.replace(config, pretrain=changed)
