"""Signs in the spheres of stage 1 that limbs have exchanged their tracks."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch

from ..config.presets import TrainConfig
from ..data.dataset import Dataset
from ..gaussians import GaussianParameters
from ..motion.spheres import Spheres
from ..runtime.search_tree import search_tree

STIFFER = 10.0
"""Weight of ARAP in a second try at stage 1, relative to the first."""
LEAST_VISITS = 20
"""Number of steps of stage 1 per frame below which limbs are exchanged before the second try can hold them."""
TORN = 0.01
"""Share of torn edges from which stage 1 is tried again."""
INSTANTS = 17
APART = (4, 8)
"""Numbers of instants between two that are compared: a quarter and a half of the time."""
NEIGHBORS = 8
TEAR = 4.0
"""Growth of an edge, in distances between nearest spheres, from which it is torn."""


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


def is_torn(gaussians: GaussianParameters, spheres: Spheres, config: TrainConfig) -> bool:
    """Decide whether stage 1 should be tried again."""
    if config.pretrain.arap_by != "auto":
        return False
    with torch.no_grad():
        means = gaussians.means[gaussians.opacities() >= config.pretrain.solid_opacity]
        tracks = means + spheres.translations(means, torch.linspace(0.0, 1.0, INSTANTS))
    return torn_share(tracks.cpu().double().numpy()) >= TORN


def torn_share(tracks: np.ndarray) -> float:
    """Return the share of torn edges between spheres that are neighbours at one instant, over all pairs of instants
    that are compared.

    Args:
        tracks: [T, N, 3] positions.

    Returns:
        0 if there is no edge, or if a position is not finite.
    """
    count = min(NEIGHBORS, tracks.shape[1] - 1)
    if count < 1 or not np.isfinite(tracks).all():
        return 0.0
    shares = []
    for first, start in enumerate(tracks):
        lengths, ends = map(np.asarray, search_tree(start).query(start, k=count + 1))
        lengths, ends = lengths[:, 1:], ends[:, 1:]
        tear = TEAR * max(float(np.median(lengths[:, 0])), 1e-12)
        for second in (first + step for apart in APART for step in (-apart, apart)):
            if 0 <= second < len(tracks):
                now = np.linalg.norm(tracks[second][ends] - tracks[second][:, None], axis=2)
                shares.append((now - lengths > tear).mean())
    return float(np.mean(shares)) if shares else 0.0
