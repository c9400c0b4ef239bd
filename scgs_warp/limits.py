"""Which configurations can run: ranges of the settings, and how they bound each other."""

from __future__ import annotations

import math
from typing import Any

from .config import TrainConfig
from .errors import UserError

AT_LEAST_ONE = (
    "init_points batch evaluate_every data.downscale "
    "motion.layers motion.width motion.time_frequencies motion.position_frequencies "
    "pretrain.densify_every pretrain.progressive_every pretrain.start_ratio pretrain.max_ratio "
    "optim.means_until optim.network_until "
    "densify.every densify.opacity_reset_every densify.sh_every densify.nodes_every "
    "loss.arap_every loss.arap_times loss.arap_refresh"
).split()
NOT_NEGATIVE = (
    "data.cache_mib seed freeze coarse half_size checkpoint_seconds "
    "pretrain.steps pretrain.warm_up pretrain.clone_share pretrain.arap_weight "
    "densify.start densify.until densify.grad_threshold densify.min_opacity loss.ssim loss.arap loss.arap_end "
    "optim.cameras optim.shading optim.settle motion.time_noise motion.hyper_dim motion.hyper_dim_filled "
    "loss.hexplane_tv loss.hexplane_smooth loss.hexplane_rest"
).split()


def check(config: TrainConfig) -> TrainConfig:
    """Refuse combinations that cannot run.

    Raises:
        UserError: naming the field and the remedy.
    """
    motion = config.motion
    for names, lowest in ((AT_LEAST_ONE, 1), (NOT_NEGATIVE, 0)):
        for name in names:
            value = _field(config, name)
            if not lowest <= value < math.inf:  # NaN fails, too
                raise UserError(f"{name} is {value}; it must be at least {lowest}")
    if config.main_steps < 1:
        raise UserError(
            f"steps {config.steps} leave nothing after {config.pretrain_steps} pre-training steps; raise --steps"
        )
    if not 0 <= config.sh_degree <= 3:
        raise UserError(f"sh_degree is {config.sh_degree}; choose 0 to 3")
    if not 1 <= motion.neighbors <= 16:
        raise UserError(f"motion.neighbors is {motion.neighbors}; choose 1 to 16")
    if not 1 <= config.loss.arap_neighbors <= 15:
        raise UserError(f"loss.arap_neighbors is {config.loss.arap_neighbors}; choose 1 to 15")
    if not 1 <= motion.skip < motion.layers:
        raise UserError(f"motion.skip is {motion.skip}; choose 1 to {motion.layers - 1}, below motion.layers")
    if motion.plane_times != 0 and not 2 <= motion.plane_times <= 4096:
        raise UserError(f"motion.plane_times is {motion.plane_times}; choose 2 to 4096, or 0 for half of the times")
    if motion.nodes < motion.neighbors + 1:
        raise UserError(f"--nodes {motion.nodes}: needs at least {motion.neighbors + 1}")
    if config.optim.settle > 1:
        raise UserError(f"optim.settle is {config.optim.settle}; it is a share of the run, choose 0 to 1")
    if config.densify.max_gaussians < 100:
        raise UserError(f"--max-gaussians {config.densify.max_gaussians}: needs at least 100")
    return config


def _field(config: Any, name: str) -> Any:
    for part in name.split("."):
        config = getattr(config, part)
    return config
