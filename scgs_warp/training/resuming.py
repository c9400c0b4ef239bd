"""Comparison of a run that is to continue with its checkpoint."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..config.presets import FREE_TO_CHANGE, TrainConfig
from ..data.dataset import Dataset
from ..data.thumbnails import thumbnails
from ..errors import UserError
from ..geometry.cameras import Overview, overview, places_and_directions
from ..storage.recorded_images import differ
from .automatic import has_initial_points
from .scene_distance import depth_ahead

SAME_CAMERAS = 0.02
"""Largest relative difference between two summaries of the same cameras, which versions may compute differently."""


def as_begun(data: Dataset, config: TrainConfig, init_from: Any) -> Dataset:
    """Leave out the initial points of the data if a run began without any: earlier versions did not find all of them.

    Args:
        config: settings that are asked for.
        init_from: ``TrainConfig.init_from`` of the run.
    """
    began_without = init_from == "spheres" and not config.pretrain.with_points
    return data.without_points() if began_without and has_initial_points(data, config) else data


def check_steps(step: int, config: TrainConfig, source: str) -> None:
    """Refuse to continue a run until a step that it has passed.

    Raises:
        UserError: names the steps and the remedy.
    """
    if step > config.steps:
        raise UserError(
            f"{source}: is at step {step:,} already, beyond --steps {config.steps}; give at least {step}, or leave "
            "--steps out"
        )


def check_same_frames(saved: dict[str, Any], data: Dataset, source: str) -> None:
    """Refuse to continue on other frames, on frames with other cameras, or on other images.

    Args:
        saved: metadata of the checkpoint.

    Raises:
        UserError: names the data set and the remedy.
    """
    if saved.get("frames") != data.fingerprint:
        raise UserError(f"{source}: made from other frames than those of {data.folder}; give the same --data")
    then = Overview.from_dict(saved["overview"])
    # Where the axes do not meet, the distance of the scene is not a property of the cameras.
    ahead = depth_ahead(*places_and_directions(data.cameras), np.array(then.centre))
    if not any(_alike(then, overview(data.cameras, distance)) for distance in (None, ahead)):
        raise UserError(
            f"{source}: made with other cameras than those of {data.folder}; restore them, or train again with "
            "another --output"
        )
    images = saved.get("images")
    if isinstance(images, dict) and differ(images.get(data.split), thumbnails(data)):
        raise UserError(
            f"{source}: made from other images than those of {data.folder}, which have the same names; give the same "
            "--data, or train again with another --output"
        )


def _alike(then: Overview, now: Overview) -> bool:
    shift, turn = math.dist(then.centre, now.centre) / then.radius, math.dist(then.up, now.up)
    return max(shift, turn, abs(now.radius / then.radius - 1.0), abs(now.fov_x / then.fov_x - 1.0)) <= SAME_CAMERAS


def check_same_configuration(
    saved: dict[str, Any], wanted: dict[str, Any], source: str, prefix: str = "", besides: tuple[str, ...] = ()
) -> None:
    """Refuse to resume with settings other than the checkpoint's. The total of the steps may differ.

    Args:
        besides: dotted names of settings that are not compared.

    Raises:
        UserError: names the field, its two values and the remedy.
    """
    for name, value in wanted.items():
        label = f"{prefix}{name}"
        if label in FREE_TO_CHANGE or label in besides or label == "steps":
            continue
        if isinstance(value, dict):
            inner = saved.get(name, {})
            check_same_configuration(inner if isinstance(inner, dict) else {}, value, source, f"{label}.", besides)
        elif name not in saved:  # no value of the field stands for that version's behaviour
            raise UserError(
                f"{source}: made by another version, which had no {label}; train again with another --output"
            )
        elif saved[name] != value:
            raise UserError(
                f"{source}: made with {label} = {saved[name]!r}, now {value!r}; "
                "give the same options to --resume, or another --output"
            )
