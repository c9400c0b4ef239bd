"""Formats that hold Gaussians or points moment by moment, so that scenes of every motion model can be written."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ..edit import EditSession
from ..errors import UserError
from ..gaussians import SH_C0
from ..geometry.cameras import Overview, orbit_camera
from ..runtime import memory
from ..runtime.progress import progress
from ..scene.scene import Scene
from .finite import finite_rows
from .fourdgs import COEFFICIENT, KEYFRAME_EVERY, StillPart, View, write_fourdgs
from .moments import AnimationMoment, posed_gaussians
from .segments import Course
from .skeleton import extent_of
from .tracks import build_tracks, read_points, write_tracks

THINNEST = 1e-30
"""Scale in place of 0, of which there is no logarithm."""
COURSE_BYTES = 52
"""Memory of a Gaussian at a moment: position, rotation, scale and colour in float32."""


def export_tracks(
    path: Path, scene: Scene, session: EditSession | None, moments: list[AnimationMoment], points: str | None
) -> str:
    """Write tracks and return what was written.

    Args:
        points: a number, the name of a .csv of points, or None (:func:`~scgs_warp.export.tracks.build_tracks`).

    Raises:
        UserError: the points cannot be read, there is no surface, memory does not suffice, or the file cannot be
            written.
    """
    chosen = None if points is None else int(points) if points.isdecimal() else read_points(Path(points))
    with progress(len(moments), "export") as shown:
        tracks = build_tracks(scene, session, moments, chosen, shown.advance, path.suffix.lower())
    write_tracks(path, tracks, scene.overview.up)
    return f"tracks of {tracks.points.shape[1]:,} points at {len(moments)} instants"


def export_fourdgs(
    path: Path, scene: Scene, session: EditSession | None, moments: list[AnimationMoment], usable: np.ndarray
) -> str:
    """Write a .4dgs and return what was written.

    Args:
        usable: [N] bool, Gaussians to write.

    Raises:
        UserError: there are fewer than two moments, no Gaussian is finite, or memory or the format do not suffice.
    """
    if len(moments) < 2:
        raise UserError("--format 4dgs: needs at least two moments; give --frames 2 or more, or a longer film")
    need = COURSE_BYTES * len(moments) * int(usable.sum())
    memory.require(need, "cpu", f"--format 4dgs of {len(moments)} frames", "give fewer --frames, or a shorter film")
    with progress(2 * len(moments) - 1, "export") as shown:
        frames, harmonics, rows = [], [], usable.copy()
        for number, moment in enumerate(moments):
            posed = posed_gaussians(scene, session, moment)
            rows &= finite_rows(posed)
            held = posed.means, posed.quats, posed.scales.clamp_min(THINNEST), 0.5 + SH_C0 * posed.sh_dc
            frames.append([value.detach().cpu().numpy() for value in held])
            if number == 0:
                opacities = posed.opacities.detach().cpu().numpy()
            if number % KEYFRAME_EVERY == 0 and number < len(moments) - 1:
                harmonics.append(posed.sh_rest.detach().cpu().numpy())
            shown.advance()
        if not rows.any():
            raise UserError("no Gaussian of the scene is finite at all moments; train again with a lower rate")
        seconds = np.array([moment.seconds for moment in moments])
        means, quats, scales, colors = (np.stack([frame[k][rows] for frame in frames]) for k in range(4))
        course = Course(seconds, means, quats, scales, colors, extent_of(means[0]))
        still = StillPart(opacities[rows], [values[rows] for values in harmonics])
        clipped = count_clipped(course, still)
        up, view = scene.overview.up, default_view(scene.overview)
        count = write_fourdgs(path, course, still, up=up, view=view, advance=shown.advance)
    note = f" ({clipped:,} values clipped to what .4dgs can hold)" if clipped else ""
    return f"{int(rows.sum()):,} Gaussians in {count:,} linear segments, {seconds[-1]:g} s{note}"


def count_clipped(course: Course, still: StillPart) -> int:
    """Return how many colours and harmonics the format clips at any moment, each counted once."""
    bytes_ = np.rint(255.0 * course.colors)
    total = int(((bytes_ < 0) | (bytes_ > 255)).any(axis=0).sum())
    return total + int((np.abs(np.stack(still.harmonics)) > COEFFICIENT).any(axis=0).sum())


def default_view(overview: Overview) -> View:
    """Return the view with which films begin."""
    camera = orbit_camera(overview, overview.azimuth, 512)
    fov_y = math.degrees(2.0 * math.atan(camera.height / 2.0 / float(camera.K[1, 1])))
    viewmat = camera.viewmat.double().numpy()
    x, y, z = (-viewmat[:3, :3].T @ viewmat[:3, 3]).tolist()
    return View(fov_y, (x, y, z), overview.centre)
