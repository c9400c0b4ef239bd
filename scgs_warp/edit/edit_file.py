"""Edits as JSON: readable, versioned, checked, without paths or code. Numbers are stored without rounding."""

from __future__ import annotations

import dataclasses
import json
import zlib
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import numpy as np

from ..config.bounds import MOST_NODES
from ..errors import UserError
from . import skeleton_file
from .document import Edit, Film, Shot, View, film_fields, ordered_views, shot_fields, view_fields
from .engine import Engine
from .field_reader import FieldReader, one_line, read_object, show_value, whole_number
from .handles import Handle, Target, handle_fields
from .keyframes import Keyframe, keyframe_fields
from .part_skin import SkinName
from .playback import Exaggerate, Hold, Playback, exaggerate_fields, hold_fields, playback_fields
from .rotations import from_axis
from .skeleton import Skeleton

FORMAT = "scgs-warp edit"
VERSION = 2
"""In version 1, a handle of several control points without ``turns`` fixed their rotations."""


def fingerprint(engine: Engine) -> str:
    """Return the CRC-32 of the control points' rest positions, which tells scenes apart: node indices are only valid
    in the scene they were chosen in."""
    rest = engine.rig.positions.detach().cpu().contiguous().numpy()
    return f"{zlib.crc32(np.ascontiguousarray(rest).tobytes()):08x}"


def scene_of(engine: Engine) -> dict[str, Any]:
    """Return what a file says of the scene whose control points it names."""
    return {"control_points": len(engine.graph), "fingerprint": fingerprint(engine)}


def to_json(edit: Edit, engine: Engine) -> str:
    """Return the JSON text of an edit, which ``read`` turns back into the same edit."""
    content: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "scene": scene_of(engine),
        "skeleton": None if edit.skeleton is None else skeleton_file.to_plain(edit.skeleton),
        "skin": None if edit.skeleton is None and edit.skin == Edit().skin else edit.skin,
        "handles": [_handle_entry(handle) for handle in edit.handles],
        "pins": list(edit.pins),
        "targets": {name: _plain(target) for name, target in edit.targets.items()},
        "keyframes": [
            {"at": k.at, "easing": k.easing, "targets": {n: _plain(t) for n, t in k.targets.items()}}
            for k in edit.keyframes
        ],
        "playback": _plain(edit.playback),
        "hold": [_plain(hold) for hold in edit.holds],
        "exaggerate": None if edit.exaggerate is None else _plain(edit.exaggerate),
        "film": _plain(edit.film),
    }
    lines = [f" {json.dumps(key)}: {_compact(value)}" for key, value in content.items() if value is not None]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def control_points_of(path: Path) -> int:
    """Return the number of control points of the scene for which an edit was saved; 0 if the file does not say."""
    scene = FieldReader(read_object(path), str(path)).child("scene")
    return 0 if scene is None else scene.integer("control_points", 0, 0, MOST_NODES)


def checked(edit: Edit, engine: Engine) -> Edit:
    """Return an edit with its fields checked and converted, as reading it back from its file would.

    Raises:
        UserError: naming a field that no file may hold.
    """
    return parse(json.loads(to_json(edit, engine)), "the edit", engine)


def _plain(value: Any) -> dict[str, Any]:
    """Return the fields that are not None."""
    return {name: item for name, item in dataclasses.asdict(value).items() if item is not None}


def _handle_entry(handle: Handle) -> dict[str, Any]:
    """Return a handle's entry; the control points of a part are in the skeleton."""
    entry = _plain(handle)
    if handle.part is not None:
        del entry["nodes"]
    return entry


def _compact(value: Any) -> str:
    """Write lists of objects with one entry per line."""
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "[\n  " + ",\n  ".join(json.dumps(item) for item in value) + "\n ]"
    return json.dumps(value)


def read(path: Path, engine: Engine, default: Callable[[], Skeleton] | None = None) -> Edit:
    """Read an edit for the engine's scene; regions given by place become lists of control points.

    Args:
        default: gives the skeleton of a file that names parts but holds none.

    Raises:
        UserError: naming the file, the field and the remedy.
    """
    return parse(read_object(path), str(path), engine, default)


def parse(content: Any, source: str, engine: Engine, default: Callable[[], Skeleton] | None = None) -> Edit:
    """Decode an edit from a JSON value, as ``read`` does; errors name ``source``."""
    root = FieldReader(content, source)
    if root.raw("format") != FORMAT:
        raise root.wrong("format", f"is {show_value(root.raw('format'))}", f'an edit has "format": "{FORMAT}"')
    version = whole_number(root.raw("version"))
    if version is None or not 1 <= version <= VERSION:
        what = f"is {show_value(root.raw('version'))}"
        raise root.wrong("version", what, f"this program reads versions 1 to {VERSION}")
    _check_scene(root, engine)
    handles: list[Handle] = []
    own = root.child("skeleton")
    skeleton = None if own is None else skeleton_file.from_fields(own, len(engine.graph))
    for fields in root.children("handles", 1000):
        handle, skeleton = _handle(fields, engine, skeleton, default)
        if version == 1 and handle.turns is None and handle.part is None:
            handle = dataclasses.replace(handle, turns=len(handle.nodes) > 1)
        if any(handle.name == other.name for other in handles):
            raise fields.wrong("name", f"{handle.name!r} is taken", "give every handle a name of its own")
        handles.append(handle)
    names = {handle.name for handle in handles}
    frames = [_keyframe(fields, names) for fields in root.children("keyframes")]
    frames.sort(key=lambda frame: frame.at)
    for first, second in pairwise(frames):
        if first.at == second.at:
            raise root.wrong("keyframes", f"has two at {first.at:g} s", "leave one of them out")
    edit = Edit(
        handles=tuple(handles),
        pins=_pins(root, handles, engine),
        targets=_targets(root, names),
        keyframes=tuple(frames),
        playback=_playback(root.child("playback")),
        holds=tuple(_hold(fields, engine) for fields in root.children("hold", 1000)),
        exaggerate=_exaggerate(root.child("exaggerate"), engine),
        film=_film(root.child("film")),
        skeleton=skeleton,
        skin=root.choice("skin", get_args(SkinName), "parts"),
    )
    root.done("comment")
    return edit


def _check_scene(root: FieldReader, engine: Engine) -> None:
    scene = root.child("scene")
    if scene is None:
        return
    count = scene.integer("control_points", len(engine.graph), 0, 1 << 31)
    if count != len(engine.graph):
        remedy = f"this scene has {len(engine.graph)}: give the scene that it was made for"
        if not engine.rig.moves:
            remedy += f", with --nodes {count}"
        raise scene.wrong("control_points", f"is {count}", remedy)
    mark = scene.raw("fingerprint")
    if mark is not None and mark != fingerprint(engine):
        remedy = "give that scene, or say regions by place (point, sphere, box) and leave fingerprint out"
        raise scene.wrong("fingerprint", "is that of another scene's control points", remedy)
    scene.done()


def _nodes(fields: FieldReader, name: str, engine: Engine, *, time: float = 0.0) -> tuple[int, ...]:
    """Read control points: a list, or a region {"point", "rings"}, {"sphere", "radius"} or {"box"} at a time."""
    value = fields.raw(name)
    if isinstance(value, dict):
        return _region(FieldReader(value, fields.source, f"{fields.path}.{name}".strip(".")), engine, time)
    if value is None or not isinstance(value, list) or not value:
        raise fields.wrong(name, "is missing or empty", "list control points, or say a place: point, sphere or box")
    return fields.indices(name, count=len(engine.graph))


def _region(region: FieldReader, engine: Engine, time: float) -> tuple[int, ...]:
    time = region.number("time", time, 0.0, 1.0)
    points = engine.to_world(engine.motion_at(time).positions)
    point, sphere, box = region.vector("point", 3), region.vector("sphere", 3), region.items("box", 2)
    rings = region.integer("rings", 0, 0, 1000)
    radius = region.number("radius", None, 0.0)
    region.done()
    given = [name for name in ("point", "sphere", "box") if name in region]
    if len(given) > 1:
        raise region.wrong(given[1], f"stands beside {given[0]}", "name one place: point, sphere or box")
    if radius is not None and sphere is None:
        raise region.wrong("radius", "belongs to sphere", "give both, or leave radius out")
    if point is not None:
        chosen = [int(np.linalg.norm(points - point, axis=1).argmin())]
    elif sphere is not None and radius is not None:
        chosen = np.flatnonzero(np.linalg.norm(points - sphere, axis=1) <= radius).tolist()
    elif len(box) == 2:
        corners = FieldReader({"low": box[0], "high": box[1]}, region.source, f"{region.path}.box")
        low, high = corners.vector("low", 3), corners.vector("high", 3)
        if low is None or high is None:
            raise region.wrong("box", "lacks a corner", "give two corners of 3 numbers")
        low, high = np.sort([low, high], axis=0)  # any two opposite corners
        chosen = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1)).tolist()
    else:
        raise region.wrong("", "names no place", "give point, sphere with radius, or box with two corners")
    if not chosen:
        raise region.wrong("", f"holds no control point at time {time:g}", "make it larger or move it")
    return engine.graph.ring(chosen, rings)


def _handle(
    fields: FieldReader, engine: Engine, skeleton: Skeleton | None, default: Callable[[], Skeleton] | None
) -> tuple[Handle, Skeleton | None]:
    """Read a handle, and return the skeleton with it, which the first one that names a part brings in."""
    part = fields.text_or_none("part")
    values = handle_fields(fields, name=part)
    if part is None:
        handle = Handle(nodes=_nodes(fields, "nodes", engine, time=values["time"]), **values)
        fields.done("comment")
        return handle, skeleton
    if fields.raw("nodes") is not None:
        raise fields.wrong("part", "and nodes stand together", "give one of them")
    if skeleton is None and default is not None:
        skeleton = default()
    known = skeleton.names if skeleton is not None else ()
    if skeleton is None or part not in known:
        raise fields.wrong("part", f"is {show_value(part)}", f"there is {one_line(', '.join(known)) or 'none'}")
    fields.done("comment")
    return Handle(nodes=skeleton.part(part).nodes, **values), skeleton


def _pins(root: FieldReader, handles: list[Handle], engine: Engine) -> tuple[int, ...]:
    value = root.raw("pins")
    if value is None or value == []:
        return ()
    if isinstance(value, dict) and "beyond" in value:
        fields = FieldReader(value, root.source, "pins")
        rings = fields.integer("beyond", 2, 0, 1000)
        fields.done()
        return engine.graph.beyond({n for handle in handles for n in handle.nodes}, rings)
    return _nodes(root, "pins", engine)


def _target(fields: FieldReader) -> Target:
    """Read a target, whose turn is either a quaternion (``rotation``, wxyz) or ``axis`` and ``degrees``."""
    rotation, axis = fields.vector("rotation", 4), fields.direction("axis")
    degrees = fields.number("degrees", None, -180.0, 180.0)
    translation = fields.vector("translation", 3)
    if (axis is None) != (degrees is None) or (rotation is not None and axis is not None):
        raise fields.wrong("axis", "and degrees belong together", "give both, or rotation alone")
    if axis is not None:
        rotation = tuple(from_axis(axis, degrees).tolist())
    fields.done()
    try:
        return Target.of(translation, rotation)
    except UserError as error:
        raise fields.wrong("", f"is wrong: {error}", "correct it") from None


def _targets(root: FieldReader, names: set[str]) -> dict[str, Target]:
    targets = {}
    for name, fields in root.entries("targets"):
        if name not in names:
            raise fields.wrong("", "names no handle", f"there is {one_line(', '.join(sorted(names))) or 'none'}")
        targets[name] = _target(fields)
    return targets


def _keyframe(fields: FieldReader, names: set[str]) -> Keyframe:
    frame = Keyframe(**keyframe_fields(fields), targets=_targets(fields, names))
    fields.done("comment")
    return frame


def _playback(fields: FieldReader | None) -> Playback:
    if fields is None:
        return Playback()
    playback = Playback(**playback_fields(fields))
    fields.done()
    return playback


def _hold(fields: FieldReader, engine: Engine) -> Hold:
    values = hold_fields(fields)
    hold = Hold(_nodes(fields, "nodes", engine, time=values["time"]), **values)
    fields.done("comment")
    return hold


def _exaggerate(fields: FieldReader | None, engine: Engine) -> Exaggerate | None:
    if fields is None:
        return None
    nodes = () if fields.raw("nodes") in (None, []) else _nodes(fields, "nodes", engine)
    exaggerate = Exaggerate(nodes=nodes, **exaggerate_fields(fields))
    fields.done("comment")
    return exaggerate


def _film(fields: FieldReader | None) -> Film:
    if fields is None:
        return Film()
    film = Film(shot=_shot(fields.child("shot")), **film_fields(fields))
    fields.done()
    return film


def _shot(fields: FieldReader | None) -> Shot:
    if fields is None:
        return Shot()
    views = []
    for view in fields.children("views"):
        views.append(View(**view_fields(view)))
        view.done()
    shot = Shot(views=ordered_views(fields, views), **shot_fields(fields))
    fields.done()
    return shot
