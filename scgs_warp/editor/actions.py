"""What pages may ask for, by name. A request is data of a stranger: every field is read with its range, and a wrong one
leaves the edit unchanged."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, get_args

import numpy as np

from ..edit import Target, View
from ..edit.field_reader import FieldReader
from ..edit.handles import STAY
from ..edit.keyframes import Easing
from ..edit.playback import Exaggerate, Hold
from ..edit.rotations import exponential, multiply, rotate
from ..errors import UserError
from ..geometry.axes import Axis, direction
from . import keys
from .host import Host
from .model import Combine
from .parts_tool import hit
from .pictures import camera_of

Action = Callable[[Host, FieldReader], Any]
LIMIT = 1e6
"""Largest coordinate, as a multiple of which no scene is drawn."""
COMBINE = get_args(Combine)


def _point(fields: FieldReader, name: str = "point") -> tuple[float, float, float]:
    value = fields.vector(name, 3)
    if value is None:
        raise fields.wrong(name, "is missing", "give 3 numbers")
    return value


def short_text(fields: FieldReader, name: str, most: int = 200) -> str:
    value = fields.raw(name)
    if not isinstance(value, str) or len(value) > most:
        raise fields.wrong(name, "is no short text", f"give at most {most} characters")
    return value


def _need_selection(editor: Host) -> tuple[int, ...]:
    if not editor.model.selection:
        raise UserError("nothing is chosen; click on the picture first")
    return editor.model.selection


# Choosing


def pick(editor: Host, fields: FieldReader) -> None:
    """Choose what a click at a surface point means; without a point, the click was beside the scene."""
    how, parts_first = fields.choice("how", COMBINE, editor.model.combine), fields.boolean("parts_first")
    if fields.raw("point") is None:
        editor.parts.click(None, how)
        return
    point, moment = np.array(_point(fields)), editor.model.moment()
    editor.parts.click(hit(editor.session, point, editor.model.region, moment), how, parts_first)


def pick_pixel(editor: Host, fields: FieldReader) -> None:
    """Choose what a click at a pixel of a page's picture means."""
    camera, pixel, moment = camera_of(fields), fields.vector("pixel", 2), editor.model.moment()
    if pixel is None:
        raise fields.wrong("pixel", "is missing", "give 2 numbers")
    point = editor.session.pick(camera, pixel[0], pixel[1], moment.time, moment.at)
    found = None if point is None else hit(editor.session, point, editor.model.region, moment)
    how = fields.choice("how", COMBINE, editor.model.combine)
    editor.parts.click(found, how, fields.boolean("parts_first"))


def select(editor: Host, fields: FieldReader) -> None:
    """Select all, none, more or other control points, or those of a lasso."""
    model, count = editor.model, len(editor.session)
    what = fields.choice("what", ("all", "none", "grow", "invert", "nodes"), "nodes")
    if what == "grow":
        model.select(editor.session.ring(_need_selection(editor), 1))
    elif what == "nodes":
        nodes = tuple(n for n in fields.items("nodes") if isinstance(n, int) and 0 <= n < count)
        model.select(nodes, fields.choice("how", COMBINE, model.combine))
    else:
        chosen = set(model.selection) if what == "invert" else set(range(count)) if what == "none" else set()
        model.select(tuple(n for n in range(count) if n not in chosen))


def choose_part(editor: Host, fields: FieldReader) -> None:
    """Choose a part by name."""
    editor.parts.choose(short_text(fields, "name"))


def activate(editor: Host, fields: FieldReader) -> None:
    editor.model.activate(short_text(fields, "name"))


# Moving


def grab(editor: Host, fields: FieldReader) -> None:
    """Begin to drag what is chosen: a part, or a handle on the selected control points."""
    from . import gizmo_pose

    model, moment = editor.model, editor.model.moment()
    handle = editor.session.edit.handle(model.active or "")
    if handle is not None and handle.part is not None and not model.acts(handle):
        editor.parts.choose(handle.part)
    model.prefer_acting()
    handle = editor.session.edit.handle(model.active or "")
    if editor.parts.part is not None:
        editor.parts.grab()
        editor.held = None
        return
    if handle is None:
        _need_selection(editor)
        frame, target = gizmo_pose.frame_of_selection(editor.session, model.selection, moment)
    else:
        frame = gizmo_pose.frame_of_handle(editor.session, handle, moment)
        target = editor.session.engine.targets(editor.session.edit, moment.at).get(handle.name, STAY)
    model.grab(target)
    editor.held = frame, frame.pose(target)


def drag(editor: Host, fields: FieldReader) -> None:
    """Pull what is held by a point to a place, or turn it, about its own pivot or another point. All are given since
    the beginning of the drag."""
    if not editor.model.dragging:
        return
    rotation, about = fields.vector("rotation", 4), fields.vector("about", 3)
    if editor.held is None:
        if rotation is not None:
            editor.parts.turn(rotation, about)
        else:
            editor.parts.pull(_point(fields, "to"), _point(fields, "grip"))
        return
    frame, (position, quat) = editor.held
    if rotation is not None:
        turned = np.array(Target.of(None, rotation).rotation)
        place = position if about is None else about + rotate(turned, position - np.array(about))
        editor.model.drag(frame.target(place, multiply(turned, quat)))
    else:
        shift = np.subtract(_point(fields, "to"), _point(fields, "grip"))
        editor.model.drag(frame.target(position + shift, quat))


def release(editor: Host, fields: FieldReader) -> None:
    editor.model.release()


def cancel(editor: Host, fields: FieldReader) -> None:
    editor.model.cancel()


def put(editor: Host, fields: FieldReader) -> None:
    """Set the target of the chosen handle, or of the chosen part's joint."""
    model, old = editor.model, editor.model.target
    move, degrees = fields.vector("translation", 3), fields.vector("degrees", 3)
    turn = None if degrees is None else exponential(np.radians(degrees)).tolist()
    target = Target.of(move or old.translation, turn or old.rotation)
    if editor.parts.part is not None:
        editor.parts.put(target)
        return
    grab(editor, fields)
    try:
        model.drag(target)
    finally:
        model.release()


# The edit


def undo(editor: Host, fields: FieldReader) -> None:
    _step(editor, editor.model.undo, "undo")


def redo(editor: Host, fields: FieldReader) -> None:
    _step(editor, editor.model.redo, "redo")


def _step(editor: Host, step: Callable[[], bool], name: str) -> None:
    """Undo or redo. A part that has other control points afterwards stays chosen."""
    chosen = editor.parts.part
    if not step():
        raise UserError(f"there is nothing to {name}")
    if chosen is not None and editor.parts.part is None and chosen in editor.session.skeleton.names:
        editor.parts.choose(chosen)


def reset(editor: Host, fields: FieldReader) -> None:
    editor.model.reset()


def remove(editor: Host, fields: FieldReader) -> None:
    editor.model.remove_handle()


def handle(editor: Host, fields: FieldReader) -> None:
    """Set how long and how firmly the active handle, and handles made later, act."""
    changes: dict[str, Any] = {}
    if "lasts" in fields:
        changes["lasts"] = fields.choice("lasts", ("motion", "frame", "fade"), "motion")
    if "window" in fields:
        changes["window"] = fields.number("window", 0.1, 1e-3, 10.0)
    if "stiffness" in fields:
        stiffness = fields.number("stiffness", 0.0, 0.0, LIMIT)
        changes["stiffness"] = stiffness or None
    editor.model.set(**changes)
    if editor.model.active is not None:
        editor.model.change_handle(**changes)


def pin(editor: Host, fields: FieldReader) -> None:
    model = editor.model
    what = fields.choice("what", ("selection", "rest", "none"), "selection")
    off = fields.boolean("off") or False
    nodes = _need_selection(editor) if what == "selection" else ()
    if what == "rest" and not model.session.edit.handles:
        raise UserError("there is no handle yet: all would be pinned; take hold of something first")
    with model.changing() as session:
        if what == "rest":
            session.pin_rest(3 if model.pin_rings is None else model.pin_rings)
        elif what == "none":
            session.unpin()
        else:
            (session.unpin if off else session.pin)(nodes)


def hold(editor: Host, fields: FieldReader) -> None:
    """Hold the selection in its present pose."""
    model, nodes = editor.model, _need_selection(editor)
    frame = fields.choice("frame", ("body", "world"), "body")
    made = Hold(nodes, model.time, frame, fields.integer("rings", Hold(()).rings, 0, 12))
    kept = tuple(other for other in model.session.edit.holds if other.nodes != nodes)
    model.replace(holds=(*kept, made))


def unhold(editor: Host, fields: FieldReader) -> None:
    holds = editor.session.edit.holds
    index = fields.integer("index", 0, 0, max(len(holds) - 1, 0))
    editor.model.replace(holds=tuple(hold for row, hold in enumerate(holds) if row != index))


def exaggerate(editor: Host, fields: FieldReader) -> None:
    """Scale the turns of the motion."""
    model = editor.model
    if fields.boolean("off"):
        model.replace(exaggerate=None)
        return
    changes: dict[str, Any] = {}
    if "factor" in fields:
        changes["factor"] = fields.number("factor", 1.0, 0.0, 10.0)
    if "selection" in fields:
        changes["nodes"] = _need_selection(editor) if fields.boolean("selection") else ()
    if "here" in fields:
        changes["about"] = model.time if fields.boolean("here") else None
    present = model.session.edit.exaggerate or Exaggerate(1.0)
    model.replace(exaggerate=dataclasses.replace(present, **changes))


# Time


def key(editor: Host, fields: FieldReader) -> None:
    editor.model.add_keyframe(fields.choice("easing", get_args(Easing), "smooth"))


def change_key(editor: Host, fields: FieldReader) -> None:
    """Move, copy or delete a handle's key, or with no name a whole keyframe; or set the way to the next."""
    what = fields.choice("what", ("move", "copy", "delete", "ease"), "move")
    at, name, edit = fields.number("from", 0.0, 0.0, 3600.0), fields.text_or_none("name"), editor.session.edit
    if what == "delete":
        changed = keys.removed(edit, name, at)
    elif what == "ease":
        changed = keys.eased(edit, at, fields.choice("easing", get_args(Easing), "smooth"))
    else:
        changed = keys.moved(edit, name, at, fields.number("to", 0.0, 0.0, 3600.0), copy=what == "copy")
    with editor.model.changing() as session:
        session.apply(changed)


def change_view(editor: Host, fields: FieldReader) -> None:
    """Move, copy or delete a view of the film's camera."""
    what = fields.choice("what", ("move", "copy", "delete"), "move")
    at, edit = fields.number("from", 0.0, 0.0, 3600.0), editor.session.edit
    if what == "delete":
        changed = keys.view_removed(edit, at)
    else:
        changed = keys.view_moved(edit, at, fields.number("to", 0.0, 0.0, 3600.0), copy=what == "copy")
    editor.model.replace(film=changed.film)


def film(editor: Host, fields: FieldReader) -> None:
    changes: dict[str, Any] = {}
    if "seconds" in fields:
        changes["seconds"] = fields.number("seconds", 4.0, 0.04, 600.0)
    if "fps" in fields:
        changes["fps"] = fields.number("fps", 30.0, 1.0, 120.0)
    if "size" in fields:
        changes["size"] = fields.integer("size", 512, 16, 8192)
    if "background" in fields:
        changes["background"] = fields.vector("background", 3)
    if "up" in fields:
        up = fields.choice("up", ("scene", *get_args(Axis)), "scene")
        upright = None if up == "scene" else direction(up)
        changes["shot"] = dataclasses.replace(editor.session.edit.film.shot, up=upright)
    editor.model.replace(film=dataclasses.replace(editor.session.edit.film, **changes))


def playback(editor: Host, fields: FieldReader) -> None:
    model, changes = editor.model, {}
    if "speed" in fields:
        changes["speed"] = fields.number("speed", 1.0, -100.0, 100.0)
    if "repeat" in fields:
        repeat = fields.choice("repeat", ("once", "loop", "swing", "still"), "once")
        changes["freeze"] = model.time if repeat == "still" else None
        if repeat != "still":
            changes["repeat"] = repeat
    model.replace(playback=dataclasses.replace(model.session.edit.playback, **changes))


def shot(editor: Host, fields: FieldReader) -> None:
    """Film all around, or from the page's present view, or add that view to the path."""
    kind = fields.choice("kind", ("turntable", "fixed", "orbit"), "turntable")
    settings = editor.session.edit.film
    changes: dict[str, Any] = {"kind": kind}
    if kind != "turntable":
        view = View(
            editor.model.at if kind == "orbit" else 0.0,
            fields.number("azimuth", 0.0),
            fields.number("elevation", 0.0, -80.0, 80.0),
            fields.number("distance", 1.0, 1e-6, LIMIT),
            _point(fields, "target"),
        )
        kept = settings.shot.views if kind == "orbit" and settings.shot.kind == "orbit" else ()
        kept = tuple(other for other in kept if not math.isclose(other.at, view.at, abs_tol=1e-6))
        changes["views"] = tuple(sorted((*kept, view), key=lambda v: v.at))
    film_now = dataclasses.replace(settings, shot=dataclasses.replace(settings.shot, **changes))
    editor.model.replace(film=film_now)


def tool(editor: Host, fields: FieldReader) -> None:
    """Set what clicks take and what drags leave behind."""
    model, region = editor.model, editor.model.region
    if "parts_first" in fields:
        editor.parts.set(bool(fields.boolean("parts_first")))
    if "combine" in fields:
        model.set(combine=fields.choice("combine", COMBINE, "replace"))
    if "pin_rings" in fields:
        rings = fields.raw("pin_rings")
        model.set(pin_rings=None if rings is None else fields.integer("pin_rings", 3, 0, 20))
    model.set(
        region=dataclasses.replace(
            region,
            kind=fields.choice("region", ("rings", "brush"), region.kind),
            rings=fields.integer("rings", region.rings, 0, 12),
            radius=fields.number("radius", region.radius, 0.0, LIMIT),
        )
    )


ACTIONS: dict[str, Action] = {
    action.__name__: action
    for action in (
        pick, pick_pixel, select, choose_part, activate, grab, drag, release, cancel, put, undo, redo, reset, remove,
        handle, pin, hold, unhold, exaggerate, key, change_key, change_view, film, playback, shot, tool,
    )
}  # fmt: skip
