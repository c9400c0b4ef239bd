"""Filming of an edit: camera path and frames."""

from __future__ import annotations

import dataclasses
import functools
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry import cameras
from ..runtime.caller_settings import unaffected
from ..types import Camera
from ..visualization.figures import to_bytes
from ..visualization.video import film, require_memory
from .document import Edit, Film, View
from .keyframes import cubic
from .session import EditSession

FIELDS = ("azimuth", "elevation", "distance")


def beyond_end(session: EditSession, at: float) -> str:
    """Return words for a moment in seconds after the film's end, at which the scene goes on; empty before it."""
    end = session.edit.film.seconds
    return f", after its end at {end:g} s" if at > end else ""


def film_camera(session: EditSession, at: float, size: int | None = None) -> Camera:
    """Return the film's camera at a moment in seconds, on the CPU."""
    overview, azimuth, elevation = film_view(session, at)
    return cameras.orbit_camera(overview, azimuth, size or session.edit.film.size, elevation)


def film_view(session: EditSession, at: float) -> tuple[cameras.Overview, float, float]:
    """Return the film's camera at a moment in seconds: its sphere around a point, and its azimuth and elevation on the
    sphere, degrees."""
    settings = session.edit.film
    shot, overview = settings.shot, session.scene.overview
    changes: dict[str, Any] = {}
    if shot.up is not None:
        length = math.sqrt(math.fsum(x * x for x in shot.up))
        changes["up"] = tuple(x / length for x in shot.up)
    if shot.fov is not None:
        changes["fov_x"] = shot.fov
    view = _view_at(shot.views, at if shot.kind == "orbit" else -math.inf, overview)
    azimuth = view["azimuth"][0]
    if shot.kind == "turntable":
        azimuth += 360.0 * shot.turns * at / settings.seconds
    x, y, z = view["target"].tolist()
    moved = dataclasses.replace(overview, centre=(x, y, z), radius=float(view["distance"][0]), **changes)
    return moved, float(azimuth), float(view["elevation"][0])


def _view_at(views: tuple[View, ...], at: float, overview: cameras.Overview) -> dict[str, np.ndarray]:
    """Interpolate each quantity of the camera separately, smoothly and without overshoot; quantities that no view sets
    come from the overview."""
    usual = {"azimuth": overview.azimuth, "elevation": overview.elevation, "distance": overview.radius}
    rows = {
        name: np.array([[usual[name] if getattr(view, name) is None else getattr(view, name)] for view in views])
        for name in FIELDS
    }
    rows["target"] = np.array([overview.centre if view.target is None else view.target for view in views])
    times = np.array([view.at for view in views])
    if len(views) == 1 or at <= times[0]:
        return {name: values[0] for name, values in rows.items()}
    if at >= times[-1]:
        return {name: values[-1] for name, values in rows.items()}
    i = int(np.searchsorted(times, at, side="right")) - 1
    share = float((at - times[i]) / (times[i + 1] - times[i]))
    return {name: cubic(times, values, i, share) for name, values in rows.items()}


def moments(settings: Film) -> list[float]:
    """Return the time of every frame in seconds."""
    return [index / settings.fps for index in range(settings.frames)]


def film_frame(session: EditSession, at: float, size: int | None = None) -> np.ndarray:
    """Render the film's frame at a moment in seconds, [H, W, 3] uint8."""
    camera = film_camera(session, at, size).to(session.scene.device)
    background = session.edit.film.background
    return to_bytes(session.render(camera, session.scene_time(at), at, background).rgb)


def note_what_is_late(edit: Edit) -> None:
    """Name keyframes and views of the camera that lie after the film's end, in a line on standard error."""
    if edit.after_film is not None:
        print(f"note: {edit.after_film}", file=sys.stderr)


def _at_once(draw: Callable[[], np.ndarray]) -> np.ndarray:
    return draw()


@unaffected
def render_film(
    session: EditSession,
    output: str | Path,
    advance: Callable[[], None] | None = None,
    compute: Callable[[Callable[[], np.ndarray]], np.ndarray] = _at_once,
) -> int:
    """Write the session's film, whose frames are those that the editor shows. A line on standard error names keyframes
    and views of the camera that lie after the film's end.

    Args:
        output: name that ends in .mp4 or .gif, or a folder for numbered PNGs.
        advance: called after each frame; an exception that it raises ends the film and removes what was written.
        compute: calls the function that draws a frame and returns its result, so that another thread may draw.

    Returns:
        Frame count.

    Raises:
        UserError: the output cannot be written, or the film does not fit into memory.
    """
    settings = session.edit.film
    note_what_is_late(session.edit)
    first = film_camera(session, 0.0)
    require_memory(output, first.width, first.height, settings.frames, str(session.scene.device))
    with film(output, settings.fps) as writer:
        for at in moments(settings):
            writer.write(compute(functools.partial(film_frame, session, at)))
            if advance is not None:
                advance()
    return settings.frames
