"""Command-line arguments: tyro reads them, and a mistake in them becomes one line with the remedy."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import io
import os
import re
import shutil
import sys
import typing
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, TypeVar

from scgs_warp.errors import UserError

Options = TypeVar("Options")

BARE_WORDS = ("data", "run", "ply")
"""Options that a bare word was probably meant for; the first one that the app has is suggested."""
SPLATS = (".ply", ".splat", ".spz", ".sog")
WIDE = "4000"
"""Number of columns at which tyro breaks no line of an error."""
NARROWEST = 40
"""Smallest number of columns of ``--help``: tyro never ends in a few."""


def program(name: str) -> str:
    """Return the name under which an app was started: ``train.py`` or ``scgs-warp train``."""
    return f"{name}.py" if Path(sys.argv[0]).name == f"{name}.py" else f"scgs-warp {name}"


def parse(
    kind: type[Options],
    name: str,
    args: Sequence[str] | None,
    *,
    groups: Mapping[str, type] | None = None,
    description: str | None = None,
) -> Options:
    """Read the options of an app.

    Args:
        kind: dataclass of the options.
        name: name of the app.
        args: words after the app's name; None: those of this process.
        groups: dataclasses into which ``--help`` groups the options, by their titles; together they have the fields of
            ``kind``. None: one group.

    Raises:
        UserError: a word is no option, or its value does not fit.
        SystemExit: after ``--help``.
    """
    import tyro

    words = list(sys.argv[1:] if args is None else args)
    if groups is None:
        with one_line_errors(name, words, kind):
            return tyro.cli(kind, args=words, prog=program(name), description=description)
    parts = [(title, part, dataclasses.field(default_factory=part)) for title, part in groups.items()]
    grouped = dataclasses.make_dataclass(kind.__name__, parts)
    grouped.__doc__ = kind.__doc__
    flat = (tyro.conf.OmitArgPrefixes,)
    with one_line_errors(name, words, kind):
        found = tyro.cli(grouped, args=words, prog=program(name), description=description, config=flat)
    values = {item.name: getattr(part, item.name) for part in vars(found).values() for item in dataclasses.fields(part)}
    return kind(**values)


def refuse_given(options: Any, names: Sequence[str], why: str) -> None:
    """Refuse options that would have no effect.

    Args:
        options: dataclass of the options.
        names: those that must keep their defaults.
        why: what they belong to, and the remedy.

    Raises:
        UserError: names the first option that has another value.
    """
    for item in dataclasses.fields(options):
        if item.name in names and getattr(options, item.name) != item.default:
            raise UserError(f"--{item.name.replace('_', '-')}: {why}")


@contextlib.contextmanager
def one_line_errors(name: str, words: Sequence[str], *kinds: type) -> Iterator[None]:
    """Turn the errors that tyro prints into a UserError.

    Args:
        kinds: dataclasses of the options, from which the remedies are taken.
    """
    _refuse_empty_paths(words, *kinds)
    said, columns = io.StringIO(), os.environ.get("COLUMNS")
    asks = any(word in ("-h", "--help") for word in words)
    if not asks:
        os.environ["COLUMNS"] = WIDE
    elif shutil.get_terminal_size().columns < NARROWEST:
        os.environ["COLUMNS"] = str(NARROWEST)
    try:
        with contextlib.redirect_stderr(said):
            yield
    except SystemExit as end:
        if end.code in (0, None):
            raise
        raise UserError(explain(said.getvalue(), name, words, *kinds)) from None
    finally:
        os.environ.pop("COLUMNS", None)
        if columns is not None:
            os.environ["COLUMNS"] = columns


def _refuse_empty_paths(words: Sequence[str], *kinds: type) -> None:
    """Refuse empty names of files and folders, as of a variable that a script has not set: ``Path`` would take them for
    the current folder."""
    parts = [part for word in words for part in (word.split("=", 1) if word.startswith("--") else [word])]
    for option, value in pairwise(["", *parts]):
        if not option.startswith("--") and not value.strip():
            raise UserError("an empty name is given; name a file or folder, or leave it out")
        if option.startswith("--") and not value.strip() and "Path" in _hint(option, *kinds):
            raise UserError(f"{option}: is followed by an empty name; name a file or folder, or leave {option} out")


def explain(text: str, name: str, words: Sequence[str], *kinds: type) -> str:
    """Say in one line what tyro prints in a box."""
    plain = " ".join(re.sub(r"[╭╮╰╯│─]", " ", text).split())
    ask = f"'{program(name)} --help' lists the options"
    wrong = re.search(
        r"Unrecognized(?: or misplaced)? options: (.+?)(?: Perhaps you meant| For full helptext|$)", plain
    )
    if wrong is not None:
        return _unrecognised(wrong[1].split(", ")[0].split(" ")[0], words, ask, *kinds)
    choice = re.search(r"invalid choice '(.*?)' for argument '(\S+?)'", plain)
    if choice is not None:
        option = choice[2].split("/")[0]
        allowed = _choices(option, *kinds)
        return f"{option} {choice[1]}: choose one of {', '.join(allowed)}" if allowed else f"{plain[:200]}; {ask}"
    value = re.search(r"Error parsing (\S+?): (.*?)(?: Argument helptext| For full helptext|$)", plain)
    if value is not None:
        option = value[1].split("/")[0].rstrip(":")
        given = next((word for flag, word in pairwise(words) if flag == option), "")
        hint = _hint(option, *kinds)
        wanted = "a whole number" if "int" in hint else "a number" if "float" in hint else "another value"
        return f"{option} {given}: give {wanted}; {ask}"
    empty = re.search(r"Missing value for argument '(\S+?)'", plain)
    if empty is not None:
        return f"{empty[1].split('/')[0]}: give a value after it; {ask}"
    missing = re.search(r"Missing from .*?: (--\S+|\S+) \S+ (.*?) \(required\)", plain)
    if missing is not None:
        return f"{missing[1]} is missing: {missing[2]} {ask}"
    return f"{plain.removesuffix('.')[:300]}; {ask}"


def _unrecognised(token: str, words: Sequence[str], ask: str, *kinds: type) -> str:
    flags = option_names(*kinds)
    if token.startswith("-"):
        near = difflib.get_close_matches(token.split("=")[0], flags, 1)
        return f"{token}: no such option{f'; did you mean {near[0]}?' if near else ''}; {ask}"
    at = words.index(token) if token in words else 0
    before = words[at - 1] if at else ""
    if at > 1 and words[at - 2] == "--set" and not before.startswith("-"):
        return f"--set {before} {token}: write NAME=VALUE, for example --set {before}={token}"
    joined = next((word.split("=")[0] for word in words if word.endswith(f"={token}")), before)
    if joined in flags and _hint(joined, *kinds) == str(bool):
        return f"{joined} {token}: takes no value; write {joined} alone, or leave it out"
    if before and not before.startswith("-"):
        return f"{token}: belongs to no option; quote a name that contains spaces ('{before} {token}')"
    likely = [flag for flag in (f"--{word}" for word in BARE_WORDS) if flag in flags]
    if "--ply" in likely and token.lower().endswith(SPLATS):
        likely = ["--ply"]
    return f"{token}: belongs to no option; {f'write {likely[0]} {token}' if likely else ask}"


def option_names(*kinds: type) -> list[str]:
    """Return the options of dataclasses, as they are written on the command line."""
    return [f"--{item.name.replace('_', '-')}" for kind in kinds for item in dataclasses.fields(kind)]


def _type_of(option: str, *kinds: type) -> Any:
    name = option.lstrip("-").replace("-", "_")
    for kind in kinds:
        hints = typing.get_type_hints(kind)
        if name in hints:
            return hints[name]
    return None


def _hint(option: str, *kinds: type) -> str:
    return str(_type_of(option, *kinds))


def _choices(option: str, *kinds: type) -> list[str]:
    """Return the values of an option that is a Literal, in their order."""
    hint = _type_of(option, *kinds)
    for part in (hint, *typing.get_args(hint)):
        if typing.get_origin(part) is Literal:
            return [str(value) for value in typing.get_args(part)]
    return []
