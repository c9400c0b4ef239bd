"""List of all settings with their defaults, bounds and meanings, taken from ``fields.py``."""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import textwrap
import typing
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any, Literal, NamedTuple, get_args, get_origin

from .bounds import MAGNITUDE
from .presets import TrainConfig


class Setting(NamedTuple):
    """A field of the configuration."""

    name: str
    """Dotted name, as ``--set`` takes it."""
    default: Any
    values: str
    """Type, choices or bounds."""
    meaning: str


def settings(config: TrainConfig) -> list[Setting]:
    """List the fields of a configuration with its values as defaults."""
    return list(_settings(config, ""))


def _settings(part: Any, prefix: str) -> Iterator[Setting]:
    hints, meanings = typing.get_type_hints(type(part)), field_texts(type(part))
    for item in dataclasses.fields(part):
        value = getattr(part, item.name)
        if dataclasses.is_dataclass(value):
            yield from _settings(value, f"{prefix}{item.name}.")
        else:
            allowed = _allowed(hints[item.name], item.metadata)
            yield Setting(f"{prefix}{item.name}", value, allowed, meanings.get(item.name, ""))


def _allowed(hint: Any, metadata: Mapping[str, Any]) -> str:
    if get_origin(hint) is Literal:
        return " | ".join(map(str, get_args(hint)))
    if "choices" in metadata:
        return "{} to {}".format(*metadata["choices"])
    kind = {bool: "true | false", int: "whole number", float: "number", str: "text"}.get(hint, "value")
    least, most = metadata.get("least"), metadata.get("most")
    most = None if most == MAGNITUDE else most  # no limit of its own
    if least is not None and most is not None:
        return f"{kind} from {_number(least)} to {_number(most)}"
    if least is not None:
        return f"{kind}, at least {_number(least)}"
    return kind if most is None else f"{kind}, at most {_number(most)}"


def _number(value: float) -> str:
    return f"{value:,}" if isinstance(value, int) else f"{value:,.10g}"


@functools.cache
def field_texts(kind: type) -> dict[str, str]:
    """Return the text below each field of a dataclass, on one line."""
    (body,) = (
        node for node in ast.parse(textwrap.dedent(inspect.getsource(kind))).body if isinstance(node, ast.ClassDef)
    )
    texts = {}
    for before, after in pairwise(body.body):
        if not (isinstance(before, ast.AnnAssign) and isinstance(before.target, ast.Name)):
            continue
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and isinstance(after.value.value, str):
            texts[before.target.id] = " ".join(after.value.value.replace("``", "").split())
    return texts
