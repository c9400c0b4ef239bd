"""Configurations recorded by older versions: fields that did not exist then get the value that stands for absence."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

from .fields import TrainConfig

FREE_TO_CHANGE = ("evaluate_every", "checkpoint_seconds", "data.cache_mib", "data.min_frames")
"""Settings that do not affect the result (it stays bit-identical): left out of checkpoints, and free to change when a
run is resumed."""


def with_newer_fields(values: Mapping[str, Any], *, recorded: bool = False) -> dict[str, Any]:
    """Add the fields that are newer than a recorded configuration, with the values declared as ``before``.

    A recorded configuration holds every field of its version, so an absent newer field did not exist, and the default
    of a preset must not stand in for it. The name of the preset does not matter then: ``paper`` once had the values of
    ``best``. A configuration that lacks an older field was written by hand, and is returned as it is: presets complete
    it.

    Args:
        recorded: True if a program wrote the configuration, whatever its age, as that of a checkpoint.
    """
    newer: dict[str, Any] = {}
    for name, default in _fields(TrainConfig()):
        if _lookup(values, name) is _ABSENT:
            if "before" in default:
                newer[name] = default["before"]
            elif name not in FREE_TO_CHANGE and not recorded:
                return dict(values)
    filled = {name: dict(value) if isinstance(value, dict) else value for name, value in values.items()}
    for name, value in newer.items():
        *sections, last = name.split(".")
        inner: Any = filled
        for section in sections:
            inner = inner.setdefault(section, {}) if isinstance(inner, dict) else None
        if isinstance(inner, dict):  # a reader reports a section that is no object
            inner[last] = value
    return filled


_ABSENT = object()


def _fields(config: Any, prefix: str = "") -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the dotted name and the metadata of every field."""
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        if dataclasses.is_dataclass(value):
            yield from _fields(value, f"{prefix}{item.name}.")
        else:
            yield f"{prefix}{item.name}", item.metadata


def _lookup(values: Any, name: str) -> Any:
    for part in name.split("."):
        if not isinstance(values, Mapping) or part not in values:
            return _ABSENT
        values = values[part]
    return values
