"""Skeletons as JSON: ``skeleton.json`` of a run, and the copy in an edit that names parts."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from pathlib import Path
from typing import Any, get_args

from ..errors import UserError
from ..storage.files import write_atomically
from .field_reader import FieldReader, one_line, read_object, show_value
from .skeleton import Part, Skeleton, Source, unit_axis

FILE = "skeleton.json"
FORMER = ".former.json"
"""Ending of the copy of a skeleton that somebody edited for other control points."""
FORMAT = "scgs-warp skeleton"
VERSION = 1


def to_plain(skeleton: Skeleton) -> dict[str, Any]:
    """Return the JSON object of a skeleton, which ``from_fields`` turns back into the same skeleton."""
    parts = [{k: v for k, v in dataclasses.asdict(part).items() if v is not None} for part in skeleton.parts]
    return {"source": skeleton.source, "parts": parts}


def from_fields(fields: FieldReader, count: int) -> Skeleton:
    """Read a skeleton of ``count`` control points.

    Raises:
        UserError: naming the field.
    """
    source = fields.choice("source", get_args(Source), "edited")
    parts = [_part(part, count) for part in fields.children("parts", 10_000)]
    fields.done("comment")
    _check(fields, parts, count)
    return Skeleton(tuple(parts), source)


def _part(fields: FieldReader, count: int) -> Part:
    joint, axis = fields.vector("joint", 3), fields.vector("axis", 3)
    if joint is None:
        raise fields.wrong("joint", "is missing", "give 3 numbers")
    part = Part(
        name=fields.text("name"),
        nodes=fields.indices("nodes", count=count),
        parent=fields.text_or_none("parent"),
        joint=joint,
        axis=None if axis is None else unit_axis(axis, fields),
        degrees=fields.number("degrees", 0.0, 0.0, 360.0),
        confidence=fields.number("confidence", 0.0, 0.0, 1.0),
    )
    fields.done("comment")
    return part


def _check(fields: FieldReader, parts: list[Part], count: int) -> None:
    names = [part.name for part in parts]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise fields.wrong("parts", f"has two called {twice!r}", "give every part a name of its own")
    held = sorted(node for part in parts for node in part.nodes)
    if held != list(range(count)) or not all(part.nodes for part in parts):
        what = f"do not hold each of the {count} control points of this scene once"
        raise fields.wrong("parts", what, "give the scene that the skeleton was made for, or leave the skeleton out")
    parents = {part.name: part.parent for part in parts}
    for name, parent in parents.items():
        if parent is not None and parent not in parents:
            raise fields.wrong("parts", f"has {one_line(name)} hang on an unknown {one_line(parent)}", "name a part")
        above, seen = parent, {name}
        while above is not None:
            if above in seen:
                raise fields.wrong("parts", f"has {one_line(name)} hang on itself", "name a part above it, or none")
            seen.add(above)
            above = parents.get(above)


def write(path: Path, skeleton: Skeleton, scene: dict[str, Any]) -> None:
    """Write a skeleton for a scene.

    Args:
        scene: its ``control_points`` and ``fingerprint``.

    Raises:
        UserError: the file cannot be written.
    """
    content = {"format": FORMAT, "version": VERSION, "scene": scene, **to_plain(skeleton)}
    write_atomically(path, (json.dumps(content, indent=1) + "\n").encode())


def replace(path: Path, skeleton: Skeleton, scene: dict[str, Any]) -> None:
    """Write a skeleton as ``write`` does. An edited one of other control points that stands there is kept beside it,
    since its names cannot be found again.

    Raises:
        UserError: a file cannot be written; the former one stays in place.
    """
    former: dict[str, Any] = {}
    with contextlib.suppress(UserError):  # what is no JSON object holds no names
        former = read_object(path)
    if former and former.get("source", "edited") == "edited" and former.get("scene") != scene:
        write_atomically(path.with_suffix(FORMER), (json.dumps(former, indent=1) + "\n").encode())
    write(path, skeleton, scene)


def read(path: Path, scene: dict[str, Any]) -> Skeleton | None:
    """Read the skeleton of a scene; return None if the file is of other control points.

    Raises:
        UserError: the file cannot be read, or a field is wrong.
    """
    root = FieldReader(read_object(path), str(path))
    if root.raw("format") != FORMAT:
        raise root.wrong("format", f"is {show_value(root.raw('format'))}", f'a skeleton has "format": "{FORMAT}"')
    if root.raw("version") != VERSION:
        raise root.wrong("version", f"is {show_value(root.raw('version'))}", f"this program reads version {VERSION}")
    if root.raw("scene") != scene:
        return None
    return from_fields(root, int(scene["control_points"]))
