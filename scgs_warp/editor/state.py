"""State of the editor as its pages show it: plain values for JSON."""

from __future__ import annotations

import dataclasses
from typing import Any, get_args

import numpy as np

from ..edit import Edit, EditSession
from ..edit.filming import film_view
from ..edit.handles import STAY
from ..edit.rotations import logarithm
from ..export.page_edit import camera_path
from ..geometry.axes import Axis, direction
from .autosave import Autosave
from .jobs import JobProgress
from .model import EditorModel
from .parts_tool import PartsTool

MAX_PATH = 301
"""Largest number of moments in the path of the camera."""


CURVE = 97
"""Number of moments of the film in a curve."""


def turn_curve(session: EditSession, edit: Edit, name: str | None) -> list[list[float]]:
    """Return how the keyframes turn a handle over the film, [CURVE, 3] degrees about x, y and z at once, at even
    moments. It is empty without keyframes."""
    if name is None or not any(name in frame.targets for frame in edit.keyframes):
        return []
    moments = np.linspace(0.0, edit.film.seconds, CURVE).tolist()
    turns = np.array([session.engine.targets(edit, at).get(name, STAY).rotation for at in moments])
    return np.degrees(logarithm(turns)).round(1).tolist()


def film_camera_of(session: EditSession) -> dict[str, Any]:
    """Return the path of the film's camera at even moments, as exported pages hold it, and its overview."""
    film = session.edit.film
    moments = np.linspace(0.0, film.seconds, min(max(film.frames, 2), MAX_PATH)).tolist()
    return {"path": camera_path(session, moments), "overview": film_view(session, 0.0)[0].to_dict()}


def page_state(
    model: EditorModel, parts: PartsTool, version: int, autosave: Autosave | None, job: JobProgress | None
) -> dict[str, Any]:
    """Return what changes while a scene is edited. Poses, curves and the path of the camera are not part of it."""
    with model.lock:
        session, edit = model.session, model.session.edit
        return {
            "version": version,
            "unedited": _unedited(edit),
            "film": _film(edit),
            "playback": dataclasses.asdict(edit.playback),
            "handles": [_handle(handle) for handle in edit.handles],
            "keyframes": [{"at": k.at, "easing": k.easing, "names": sorted(k.targets)} for k in edit.keyframes],
            "holds": [
                {"count": len(hold.nodes), "time": hold.time, "frame": hold.frame, "rings": hold.rings}
                for hold in edit.holds
            ],
            "exaggerate": None if edit.exaggerate is None else _exaggeration(edit),
            "pins": list(edit.pins),
            "selection": list(model.selection),
            "part": parts.part,
            "active": model.active,
            "target": _target(model),
            "following": model.following,
            "dragging": model.dragging,
            "tool": {
                "parts_first": parts.on,
                "region": model.region.kind,
                "rings": model.region.rings,
                "radius": model.region.radius,
                "combine": model.combine,
                "pin_rings": model.pin_rings,
                "lasts": model.lasts,
                "window": model.window,
                "stiffness": model.stiffness,
            },
            "undo": session.can_undo,
            "redo": session.can_redo,
            "saved": autosave is not None and autosave.saved(edit),
            "problem": None if autosave is None else autosave.problem,
            "job": None if job is None else {"name": job.name, "percent": job.percent, "stopping": job.stopping},
        }


def _unedited(edit: Edit) -> bool:
    """Return whether the scene looks as it was trained, whatever the film does with its time."""
    moved = any(not target.is_identity for frame in edit.keyframes for target in frame.targets.values())
    return not (
        moved or any(not t.is_identity for t in edit.targets.values()) or edit.holds or edit.exaggerate is not None
    )


def _film(edit: Edit) -> dict[str, Any]:
    film = edit.film
    background, up = None if film.background is None else list(film.background), film.shot.up
    return {
        "seconds": film.seconds, "fps": film.fps, "size": film.size, "background": background, "shot": film.shot.kind,
        "views": [view.at for view in film.shot.views] if film.shot.kind == "orbit" else [],
        "up": "scene" if up is None else next((axis for axis in get_args(Axis) if direction(axis) == up), "other"),
    }  # fmt: skip


def _handle(handle: Any) -> dict[str, Any]:
    return {
        "name": handle.name, "part": handle.part, "nodes": list(handle.nodes), "time": handle.time,
        "lasts": handle.lasts, "window": handle.window, "stiffness": handle.stiffness,
    }  # fmt: skip


def _exaggeration(edit: Edit) -> dict[str, Any]:
    assert edit.exaggerate is not None
    return {"factor": edit.exaggerate.factor, "about": edit.exaggerate.about, "count": len(edit.exaggerate.nodes)}


def _target(model: EditorModel) -> dict[str, Any]:
    """Return the active handle's translation and its turn in degrees about x, y and z at once."""
    target = STAY if model.active is None else model.target
    turned = np.degrees(logarithm(np.array(target.rotation))).tolist()
    return {"translation": list(target.translation), "degrees": turned}
