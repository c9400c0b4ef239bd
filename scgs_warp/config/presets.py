"""The presets, and functions to read and write configurations.

``with_steps`` scales the milestones when ``--steps`` changes the total. ``config.json`` of a run folder holds
``to_dict`` of the configuration and can be read back.
"""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from ..errors import UserError
from ..storage.files import read_text
from ..storage.json_files import parse_json
from .fields import (
    DataConfig,
    DensifyConfig,
    LossConfig,
    MotionConfig,
    MotionName,
    OptimConfig,
    PresetName,
    PretrainConfig,
    TrainConfig,
)
from .paper import PAPER
from .recorded import FREE_TO_CHANGE, with_newer_fields

__all__ = [
    "FREE_TO_CHANGE",
    "DataConfig",
    "DensifyConfig",
    "LossConfig",
    "MotionConfig",
    "MotionName",
    "OptimConfig",
    "PresetName",
    "PretrainConfig",
    "TrainConfig",
]

MOTIONS: tuple[str, ...] = get_args(MotionName)
PRESETS: tuple[str, ...] = get_args(PresetName)


def preset(name: PresetName) -> TrainConfig:
    """Make a configuration. ``quick`` suits the built-in scene, ``cpu`` takes minutes on two cores, ``best`` takes
    40,000 steps, ``paper`` is the schedule of the SC-GS supplement in 80,000."""
    if name == "best":
        return TrainConfig()
    if name == "paper":
        return PAPER
    cpu = TrainConfig(
        preset="cpu",
        steps=24_000,
        freeze=400,
        coarse=1_800,
        half_size=9_000,
        init_points=10_000,
        evaluate_every=5_000,
        pretrain=PretrainConfig(steps=3_000, densify_until=2_000, warm_up=100, progressive_every=300),
        motion=MotionConfig(nodes=256),
        optim=OptimConfig(means_until=21_000, network_until=21_000),
        densify=DensifyConfig(
            start=400,
            until=12_000,
            opacity_reset_every=3_000,
            sh_every=500,
            nodes_every=2_000,
            nodes_until=9_000,
        ),
        loss=LossConfig(log_error_from=0.5, arap_until=24_000),
    )
    if name == "cpu":
        return cpu
    # The built-in figure swings an arm through 137 degrees: spheres follow it only frame by frame. So followed, they
    # need no pooled residual.
    stage1 = dataclasses.replace(
        cpu.pretrain,
        steps=1_800,
        densify_until=1_500,
        pooled=False,
        progressive=True,
        progressive_every=330,
        start_ratio=16.0,
    )
    quick = with_steps(cpu, 7_000)
    # Rigidity that spares no edge, neighbours by place alone, less sharpness: least error of motion on the built-in
    # figure.
    motion = dataclasses.replace(quick.motion, hyper_dim=0, node_weight=False, correctives=False, turns=False)
    loss = dataclasses.replace(quick.loss, arap_slack=0.0)
    changed = {"half_size": 3_500, "sharpness": 0.25, "pretrain": stage1, "motion": motion, "loss": loss}
    return dataclasses.replace(quick, preset="quick", **changed)


def with_steps(config: TrainConfig, steps: int) -> TrainConfig:
    """Compress or stretch a run to a total of ``steps``; every milestone scales with it, three of them not below
    ``shortest``.

    Raises:
        UserError: ``steps`` is below 10.
    """
    if steps < 10:
        raise UserError(f"--steps {steps}: a run needs at least 10 steps")
    if config.steps < 1:
        raise UserError(f"steps is {config.steps}; a run needs at least 10 steps")
    made = dataclasses.replace(_scale(config, steps / config.steps), steps=steps)
    every = max(made.densify.opacity_reset_every, min(config.densify.opacity_reset_every, config.shortest))
    return dataclasses.replace(
        made,
        freeze=max(made.freeze, min(config.freeze, config.shortest)),
        coarse=max(made.coarse, min(config.coarse, config.shortest)),
        densify=dataclasses.replace(made.densify, opacity_reset_every=every),
    )


def _scale(config: Any, ratio: float) -> Any:
    changes: dict[str, Any] = {}
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if item.metadata.get("milestone"):
            changes[item.name] = max(min(value, 1), round(value * ratio))
        elif dataclasses.is_dataclass(value):
            changes[item.name] = _scale(value, ratio)
    return dataclasses.replace(config, **changes)


def to_dict(config: TrainConfig) -> dict[str, Any]:
    return dataclasses.asdict(config)


def lasting(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Drop the settings in ``FREE_TO_CHANGE`` from the result of :func:`to_dict`."""
    return {
        name: lasting(value, f"{prefix}{name}.") if isinstance(value, dict) else value
        for name, value in values.items()
        if f"{prefix}{name}" not in FREE_TO_CHANGE
    }


def from_dict(values: dict[str, Any], source: str = "config", base: Any = None, prefix: str = "") -> TrainConfig:
    """Read a (possibly partial) configuration over ``base`` (default: the preset it names, else ``best``). A field
    that is newer than a recorded configuration takes the value that stands for its absence.

    Raises:
        UserError: a field is unknown or a value has the wrong type; names the file and the field.
    """
    if base is None:
        name = values.get("preset", "best")
        if name not in PRESETS:
            raise UserError(f"{source}: preset is {name!r}; choose one of {', '.join(PRESETS)}")
        base = preset(name)
        values = with_newer_fields(values)
    hints = typing.get_type_hints(type(base))
    known = {item.name for item in dataclasses.fields(base)}
    changes: dict[str, Any] = {}
    for key, value in values.items():
        label = f"{prefix}{key}"
        if key not in known:
            near = difflib.get_close_matches(key, known, 1)
            hint = f"did you mean {prefix}{near[0]}?" if near else f"known here: {', '.join(sorted(known))}"
            raise UserError(f"{source}: unknown field {label!r}; {hint} ('scgs-warp config' lists all)")
        current = getattr(base, key)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, dict):
                raise UserError(f"{source}: {label} must be an object with fields")
            changes[key] = from_dict(value, source, current, f"{label}.")
        else:
            changes[key] = _checked(value, hints[key], f"{source}: {label}")
    return dataclasses.replace(base, **changes)


WORDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
"""What messages call the types of settings."""


def _checked(value: Any, hint: Any, label: str) -> Any:
    if getattr(value, "ndim", None) == 0:  # a scalar of NumPy's or torch's, as in a loop over np.arange
        value = value.item()
    if get_origin(hint) is Literal:
        if value not in get_args(hint):
            raise UserError(f"{label} is {value!r}; choose one of {', '.join(map(str, get_args(hint)))}")
        return value
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            raise UserError(f"{label} is {str(value)[:20]}...; give a smaller number") from None
    if hint is int and isinstance(value, float) and value.is_integer():
        return int(value)
    if hint is str and isinstance(value, int) and not isinstance(value, bool):
        return str(value)  # a name that looks like a number
    if not isinstance(value, hint if not isinstance(hint, types.UnionType) else get_args(hint)) or (
        isinstance(value, bool) and hint is not bool
    ):
        raise UserError(f"{label} is {value!r}; give {WORDS.get(hint, 'another value')}")
    return value


def with_field(config: TrainConfig, name: str, value: Any, source: str) -> TrainConfig:
    """Replace one field by its dotted name (``motion.hyper_dim``).

    Raises:
        UserError: the name is unknown or the value has the wrong type.
    """
    values: dict[str, Any] = {}
    inner = values
    if name in ("steps", "preset"):
        raise UserError(f"{source}: give --{name} instead: it changes more than one field")
    *outer, last = name.split(".")
    for part in outer:
        inner = inner.setdefault(part, {})
    inner[last] = value
    return from_dict(values, source, config)


def whole_number(value: Any, label: str) -> int:
    """Return the value if it is an int.

    Raises:
        UserError: the value is not an int.
    """
    return _checked(value, int, label)


def parse_value(text: str) -> Any:
    """Parse a JSON value, or Python's True and False; return any other text unchanged."""
    if text in ("True", "False"):
        return text == "True"
    try:
        return parse_json(text)
    except ValueError:
        return text


def read_config(path: Path) -> dict[str, Any]:
    """Read the JSON object in ``path``.

    Raises:
        UserError: the file is missing, not JSON, or not an object.
    """
    try:
        values = parse_json(read_text(path))
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); give a config.json of an earlier run") from error
    except ValueError as error:
        raise UserError(
            f"{path}: not valid JSON ({error}); correct it or give a config.json of an earlier run"
        ) from None
    if not isinstance(values, dict):
        raise UserError(f"{path}: must hold a JSON object; give a config.json of an earlier run")
    return values
