"""Which configurations can run: ranges of the settings, and how they bound each other."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import Any

from ..errors import UserError
from .presets import TrainConfig

AT_LEAST_ONE = (
    "init_points batch evaluate_every data.downscale "
    "motion.layers motion.width motion.time_frequencies motion.position_frequencies "
    "pretrain.densify_every pretrain.progressive_every pretrain.start_ratio pretrain.max_ratio "
    "optim.means_until optim.network_until "
    "densify.every densify.rounds densify.opacity_reset_every densify.sh_every densify.nodes_every "
    "loss.arap_every loss.arap_times loss.arap_refresh"
).split()
NOT_NEGATIVE = (
    "data.cache_mib seed freeze coarse half_size checkpoint_seconds "
    "pretrain.steps pretrain.warm_up pretrain.clone_share pretrain.arap_weight "
    "densify.start densify.until densify.grad_threshold densify.min_opacity densify.min_contribution "
    "loss.ssim loss.arap loss.arap_end optim.cameras optim.shading optim.settle motion.time_noise "
    "motion.hyper_dim motion.hyper_dim_filled loss.hexplane_tv loss.hexplane_smooth loss.hexplane_rest"
).split()
AT_MOST = {
    "steps": 100_000_000,
    "init_points": 10_000_000,
    "data.downscale": 1_000,
    "motion.nodes": 1_000_000,
    "motion.layers": 64,
    "motion.width": 2_048,
    "motion.time_frequencies": 32,
    "motion.position_frequencies": 32,
    "motion.hyper_dim": 64,
    "motion.hyper_dim_filled": 64,
    "motion.time_noise": 1e6,
    "pretrain.start_ratio": 1e4,
    "pretrain.max_ratio": 1e4,
    "pretrain.clone_share": 1,
    "loss.arap_times": 10_000,
    "densify.max_gaussians": 100_000_000,
}
"""Of what takes memory; a configuration may come from anywhere."""
LARGEST = 1e9
"""Of any number."""


def check(config: TrainConfig) -> TrainConfig:
    """Refuse combinations that cannot run.

    Raises:
        UserError: naming the field and the remedy.
    """
    motion = config.motion
    check_sizes(config)
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


def check_sizes(config: TrainConfig, place: str = "") -> None:
    """Refuse numbers that no run has, before they are made into arrays: of a file's configuration, too.

    Args:
        place: what the message begins with.

    Raises:
        UserError: naming the field and the remedy.
    """
    for name, value in _numbers(config):
        most = AT_MOST.get(name, LARGEST)
        if not -LARGEST <= value <= most:  # NaN fails, too
            shown = str(value) if isinstance(value, float) else str(value)[:20]
            raise UserError(f"{place}{name} is {shown}; it must be at most {most:g}")
    motion = config.motion
    if not 0 <= motion.skip < motion.layers or min(motion.width, motion.layers) < 1:
        raise UserError(f"{place}motion.skip is {motion.skip}; it must be below motion.layers, {motion.layers}")
    if min(motion.time_frequencies, motion.position_frequencies) < 1 or motion.hyper_dim < 0:
        raise UserError(f"{place}motion.time_frequencies, position_frequencies or hyper_dim are too small; restore it")


def _numbers(config: Any, prefix: str = "") -> Iterator[tuple[str, int | float]]:
    """Dotted names and values of all that are numbers."""
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            yield from _numbers(value, f"{prefix}{item.name}.")
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            yield f"{prefix}{item.name}", value


def _field(config: Any, name: str) -> Any:
    for part in name.split("."):
        config = getattr(config, part)
    return config
