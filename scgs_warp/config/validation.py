"""Validation of a configuration: the bounds declared in ``fields.py`` with ``bounds.py``, and rules between fields."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any

from ..errors import UserError
from .bounds import MAGNITUDE, MOST_NODES
from .presets import TrainConfig

LARGEST_NETWORKS = 64 * 2_048**2
"""Largest number of weights of all chunks' networks together: that of a single network of the largest size."""


def check(config: TrainConfig) -> TrainConfig:
    """Refuse a configuration that cannot run.

    Raises:
        UserError: names the field and the remedy.
    """
    if not isinstance(config, TrainConfig):
        raise UserError(f"config is {str(config)[:80]!r}; give a TrainConfig, such as config.presets.preset returns")
    check_sizes(config)
    for name, value, bounds in _numbers(config):
        least, choices = bounds.get("least"), bounds.get("choices")
        if least is not None and not least <= value < math.inf:  # refuses NaN, too
            raise UserError(f"{name} is {value}; it must be at least {least}")
        if choices is not None and not choices[0] <= value <= choices[1]:
            raise UserError(f"{name} is {value}; choose {choices[0]} to {choices[1]}")
    _check_rules(config)
    return config


def check_node_count(nodes: int, neighbors: int, option: str) -> None:
    """Refuse a number of control points.

    Args:
        neighbors: number of control points that a Gaussian follows.
        option: where the number was given, for the message.

    Raises:
        UserError: there are too few for the neighbours, or too many.
    """
    if nodes < neighbors + 1:
        raise UserError(f"{option} {nodes}: needs at least {neighbors + 1}")
    if nodes > MOST_NODES:
        raise UserError(
            f"{option} {nodes}: choose at most {MOST_NODES}; a Gaussian follows {neighbors} of them, and sampling more "
            "takes hours"
        )


def _check_rules(config: TrainConfig) -> None:
    motion = config.motion
    if config.main_steps < 1:
        raise UserError(
            f"steps {config.steps} leave nothing after {config.pretrain_steps} pre-training steps; raise --steps"
        )
    if not 1 <= motion.skip < motion.layers:
        raise UserError(f"motion.skip is {motion.skip}; choose 1 to {motion.layers - 1}, below motion.layers")
    if motion.plane_times != 0 and not 2 <= motion.plane_times <= 4096:
        raise UserError(f"motion.plane_times is {motion.plane_times}; choose 2 to 4096, or 0 for half of the times")
    if motion.chunks > 1 and motion.model not in ("control-points", "per-gaussian"):
        raise UserError(f"motion.chunks is {motion.chunks}; --motion {motion.model} has no network: leave it out")
    check_node_count(motion.nodes, motion.neighbors, "--nodes")
    if config.densify.max_gaussians < 100:
        raise UserError(f"--max-gaussians {config.densify.max_gaussians}: needs at least 100")


def check_sizes(config: TrainConfig, prefix: str = "") -> None:
    """Refuse numbers that are too large for any run, before arrays of that size are allocated. Also applies to a
    configuration stored in a file.

    Args:
        prefix: start of the message.

    Raises:
        UserError: names the field and the remedy.
    """
    for name, value, bounds in _numbers(config):
        most = bounds.get("most", MAGNITUDE)
        if not -MAGNITUDE <= value <= most:  # refuses NaN, too
            shown = str(value) if isinstance(value, float) else str(value)[:20]
            raise UserError(f"{prefix}{name} is {shown}; it must be at most {most:g}")
    motion = config.motion
    if not 0 <= motion.skip < motion.layers or min(motion.width, motion.layers) < 1:
        raise UserError(f"{prefix}motion.skip is {motion.skip}; it must be below motion.layers, {motion.layers}")
    if motion.chunks > 1 and motion.chunks * motion.layers * motion.width**2 > LARGEST_NETWORKS:
        raise UserError(f"{prefix}motion.chunks is {motion.chunks}; so many networks of this size are too large")
    if min(motion.time_frequencies, motion.position_frequencies, motion.chunks) < 1 or motion.hyper_dim < 0:
        names = "time_frequencies, position_frequencies, chunks or hyper_dim"
        raise UserError(f"{prefix}motion.{names} are too small; restore it")


def _numbers(config: Any, prefix: str = "") -> Iterator[tuple[str, int | float, Mapping[str, Any]]]:
    """Yield the dotted name, value and bounds of every number."""
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            yield from _numbers(value, f"{prefix}{item.name}.")
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            yield f"{prefix}{item.name}", value, item.metadata
