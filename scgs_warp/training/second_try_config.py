"""When stage 1 is tried a second time, and with which settings."""

from __future__ import annotations

import dataclasses

from ..config.presets import TrainConfig
from ..data.dataset import Dataset

STIFFER = 10.0
"""Weight of ARAP in a second try at stage 1, relative to the first."""
LEAST_VISITS = 20
"""Number of steps of stage 1 per frame below which a second try hardly follows the motion from frame to frame."""


def may_be_tried_again(config: TrainConfig, data: Dataset, thin: bool) -> bool:
    """Decide whether a second try may help: for a cut-out subject that is not thin, without progressive pre-training,
    with enough steps for each frame. In thin subjects, neighbours of a sphere are often those of another limb."""
    pretrain = config.pretrain
    enough = config.pretrain_steps >= LEAST_VISITS * len(data) and pretrain.arap_weight > 0.0
    return enough and bool(data.with_alpha) and not thin and not pretrain.progressive


def second_config(config: TrainConfig) -> TrainConfig:
    """Return the configuration of the second try."""
    weight = STIFFER * config.pretrain.arap_weight
    changed = {"progressive": True, "progressive_by": "frame", "arap_by": "moment", "arap_weight": weight}
    return dataclasses.replace(config, pretrain=dataclasses.replace(config.pretrain, **changed))
