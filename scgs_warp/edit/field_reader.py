"""Checked access to JSON that people write: every error names the file, the field and the remedy in one line."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..errors import UserError
from ..storage.files import read_text
from ..storage.json_files import parse_json

MAX_BYTES = 64 << 20
"""Largest size of an edit file in bytes."""
_JOINERS: dict[int, str | None] = {0x200C: None, 0x200D: None}
EDIT = "give an edit's JSON"
MAX_NUMBER = 1e9
"""Largest magnitude of numbers without a limit of their own; beyond it float32 cannot resolve a scene."""


def read_object(path: Path, remedy: str = EDIT) -> dict[str, Any]:
    """Read the JSON object in a file.

    Args:
        remedy: what errors say to give instead.

    Raises:
        UserError: the file is missing, too large, not JSON, or not an object.
    """
    try:
        text = read_text(path, MAX_BYTES)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file; {remedy}") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); {remedy}") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: is no UTF-8 text; {remedy}") from None
    return parse_object(text, str(path), remedy)


def parse_object(text: str, path: str, remedy: str = EDIT) -> dict[str, Any]:
    """Parse a text as a JSON object; errors name ``path``.

    Raises:
        UserError: the text is not JSON, or not an object.
    """
    try:
        content = parse_json(text, parse_constant=_no_constant, object_pairs_hook=_unique)
    except json.JSONDecodeError as error:
        where = f"line {error.lineno} column {error.colno}"
        raise UserError(f"{path}: not valid JSON, {where}: {error.msg}; correct it") from None
    except ValueError as error:
        raise UserError(f"{path}: not valid JSON ({str(error)[:80] or 'nested too deeply'}); correct it") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: must hold a JSON object; {remedy}")
    return content


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{twice!r} stands there twice")
    return content


Record = TypeVar("Record")


class FieldReader:
    """Reader of the fields of a JSON object by name and type; ``done`` refuses fields that were not read.

    Args:
        value: the object.
        source: file named in error messages.
        path: place of the object in the file, such as ``handles[0]``.
    """

    def __init__(self, value: Any, source: str, path: str = "") -> None:
        self.source, self.path = source, path
        if not isinstance(value, dict):
            raise self.wrong("", f"is {show_value(value)}", "give an object")
        self._value = value
        self._taken: set[str] = set()

    def wrong(self, name: str, what: str, remedy: str) -> UserError:
        field = self._inside(name)
        return UserError(f"{self.source}: {field or 'the file'} {what}; {remedy}")

    def _inside(self, name: str) -> str:
        """Return the path of a field on one line; the field's name may be any text."""
        return ".".join(part for part in (self.path, one_line(name)) if part)

    def __contains__(self, name: str) -> bool:
        return self._value.get(name) is not None

    def raw(self, name: str) -> Any:
        self._taken.add(name)
        return self._value.get(name)

    def done(self, *also: str) -> None:
        unknown = sorted(set(self._value) - self._taken - set(also))
        if unknown:
            known = ", ".join(sorted(self._taken | set(also)))
            raise self.wrong(unknown[0], "is not known", f"known here: {known}")

    def number(self, name: str, default: Any = None, low: float = -MAX_NUMBER, high: float = MAX_NUMBER) -> Any:
        value = self.raw(name)
        if value is None:
            return default
        if not _is_number(value) or not low <= value <= high:
            raise self.wrong(name, f"is {show_value(value)}", f"give a number from {low:g} to {high:g}")
        return float(value)

    def integer(self, name: str, default: int, low: int, high: int) -> int:
        value = self.raw(name)
        if value is None:
            return default
        whole = whole_number(value)
        if whole is None or not low <= whole <= high:
            raise self.wrong(name, f"is {show_value(value)}", f"give a whole number from {low} to {high}")
        return whole

    def boolean(self, name: str) -> bool | None:
        value = self.raw(name)
        if value is not None and not isinstance(value, bool):
            raise self.wrong(name, f"is {show_value(value)}", "give true or false")
        return value

    def choice(self, name: str, options: tuple[str, ...], default: str) -> Any:
        value = self.raw(name)
        if value is None:
            return default
        if not isinstance(value, str) or value not in options:
            raise self.wrong(name, f"is {show_value(value)}", f"choose one of {', '.join(options)}")
        return value

    def text(self, name: str) -> str:
        value = self.raw(name)
        if not isinstance(value, str) or not value.strip() or len(value) > 100 or not _printable(value):
            raise self.wrong(name, f"is {show_value(value)}", "give a name of 1 to 100 letters")
        return value

    def text_or_none(self, name: str) -> str | None:
        return None if self.raw(name) is None else self.text(name)

    def vector(
        self, name: str, size: int, default: Any = None, low: float = -MAX_NUMBER, high: float = MAX_NUMBER
    ) -> Any:
        value = self.raw(name)
        if value is None:
            return default
        fits = isinstance(value, list | tuple) and len(value) == size and all(map(_is_number, value))
        if not fits or not all(low <= x <= high for x in value):
            which = f"{size} finite numbers" if high == math.inf else f"{size} numbers from {low:g} to {high:g}"
            raise self.wrong(name, f"is {show_value(value)}", f"give {which}")
        return tuple(float(x) for x in value)

    def direction(self, name: str) -> Any:
        value = self.vector(name, 3)
        if value is not None and not sum(x * x for x in value) > 1e-200:
            raise self.wrong(name, "has no direction", "give 3 numbers, not all close to 0")
        return value

    def items(self, name: str, most: int = 100_000) -> list[Any]:
        value = self.raw(name)
        if value is None:
            return []
        if not isinstance(value, list) or len(value) > most:
            raise self.wrong(name, f"is {show_value(value)}", f"give a list of at most {most}")
        return value

    def indices(self, name: str, least: int = 0, count: int | None = None) -> tuple[int, ...]:
        """Return whole numbers from 0 on, at least ``least`` of them, ascending.

        Args:
            count: number of control points; without it, the scene says which exist.
        """
        value = self.items(name)
        if len(value) < least:
            raise self.wrong(name, "is missing or empty", "list control points")
        found = set()
        for item in value:
            index = whole_number(item)
            if index is None or index < 0 or (count is not None and index >= count):
                known = "on" if count is None else f"to {count - 1}"
                raise self.wrong(name, f"names control point {show_value(item)}", f"give whole numbers from 0 {known}")
            found.add(index)
        return tuple(sorted(found))

    def records(self, name: str, kind: type[Record]) -> tuple[Record, ...]:
        """Return records that a caller has made, which check their own fields."""
        value = self.raw(name)
        value = [] if value is None else value
        if not isinstance(value, list | tuple) or not all(isinstance(item, kind) for item in value):
            raise self.wrong(name, f"is {show_value(value)}", f"give a list of {kind.__name__}")
        return tuple(value)

    def named_records(self, name: str, kind: type[Record]) -> dict[str, Record]:
        value = self.raw(name)
        value = {} if value is None else value
        if not isinstance(value, Mapping) or not all(isinstance(item, kind) for item in value.values()):
            raise self.wrong(name, f"is {show_value(value)}", f"give a mapping of names to {kind.__name__}")
        return dict(value)

    def record(self, name: str, kind: type[Record]) -> Record | None:
        value = self.raw(name)
        if value is not None and not isinstance(value, kind):
            raise self.wrong(name, f"is {show_value(value)}", f"give {kind.__name__}(...)")
        return value

    def child(self, name: str) -> FieldReader | None:
        value = self.raw(name)
        return None if value is None else FieldReader(value, self.source, self._inside(name))

    def children(self, name: str, most: int = 10_000) -> Iterator[FieldReader]:
        for index, value in enumerate(self.items(name, most)):
            yield FieldReader(value, self.source, f"{self._inside(name)}[{index}]")

    def entries(self, name: str) -> Iterator[tuple[str, FieldReader]]:
        """Iterate over the names and readers of an object of objects."""
        inner = self.child(name)
        if inner is not None:
            for key in inner._value:
                reader = inner.child(key)
                if reader is None:
                    raise inner.wrong(key, "is null", "give an object")
                yield key, reader


def plain_values(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields with arrays and tensors as Python's numbers and lists, also inside lists and tuples."""

    def plain(value: Any) -> Any:
        if hasattr(value, "tolist"):
            return value.tolist()
        return [plain(item) for item in value] if isinstance(value, (list, tuple)) else value

    return {name: plain(value) for name, value in fields.items()}


def check_record(record: Any, source: str, read: Callable[[FieldReader], dict[str, Any]]) -> None:
    """Check and convert the fields of a frozen record that a caller makes, as those of a file are.

    Args:
        source: name of the record in error messages.
        read: reads the fields that it returns.

    Raises:
        UserError: naming the field and the remedy.
    """
    for name, value in read(FieldReader(plain_values(vars(record)), source)).items():
        object.__setattr__(record, name, value)


def point_of(name: str, value: Sequence[float]) -> np.ndarray:
    """Return a point [3] that a caller gives.

    Raises:
        UserError: it is not three finite numbers.
    """
    plain = plain_values({name: value})[name]  # of tensors on a GPU, and of those that need a gradient, too
    try:
        point = np.asarray(plain, np.float64)
    except (TypeError, ValueError):
        point = np.zeros(0)
    if point.shape != (3,) or not np.isfinite(point).all() or np.abs(point).max() > MAX_NUMBER:
        raise UserError(f"{name} {show_value(plain)}: give 3 finite numbers")
    return point


def _printable(text: str) -> bool:
    """Return whether a text can be shown on one line. Joiners count as letters: Persian, Hindi and emoji need them."""
    return text.translate(_JOINERS).isprintable()


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(float(value))
    except OverflowError:
        return False


def whole_number(value: Any) -> int | None:
    """Return a whole number, which some languages write as 1.0; None if the value is none."""
    return int(value) if _is_number(value) and value == int(value) else None


def show_value(value: Any) -> str:
    """Quote a JSON value in at most 60 characters of one line."""
    try:
        text = json.dumps(value, default=repr, ensure_ascii=False) if value is not None else "missing"
        text = text if text.isprintable() else json.dumps(value, default=repr)
    except RecursionError:
        return "nested too deeply"
    return text if len(text) <= 60 else text[:57] + "..."


def one_line(text: str) -> str:
    """Shorten a text to at most 100 characters of one line."""
    plain = text if text.isprintable() else json.dumps(text)[1:-1]
    return plain if len(plain) <= 100 else plain[:97] + "..."
