"""Exports from request to file: open the scene, pose it, write it."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from .. import data
from ..config.fields import IMAGE_SETTINGS
from ..edit import EditSession, edit_file
from ..edit.filming import beyond_end, note_what_is_late
from ..edit.skeleton import Skeleton as Parts
from ..errors import UserError
from ..formats.gaussian_files import read_antialiased, read_gaussians, shortage_as_user_error
from ..formats.sog_files import META
from ..geometry.axes import direction
from ..motion.control_points import ControlPoints
from ..motion.static_nodes import COUNT
from ..runtime.progress import progress
from ..scene.from_gaussians import open_gaussians, with_control_points
from ..scene.scene import Scene
from ..types import Gaussians
from .cameras import write_cameras
from .control_graph import write_graph
from .finite import finite_rows, keep_finite, select_gaussians
from .glb import write_glb
from .moments import AnimationMoment, at_rest, even_moments, film_moments, posed_gaussians
from .moving import export_fourdgs, export_tracks
from .no_surface import explained
from .npz import write_npz
from .part_rig import build_rig
from .plain import plain_scene
from .poster import edited_poster
from .request import FRAME_FORMATS, SEQUENCES, ExportRequest, check_request
from .sequence import ENDINGS, check_folder, write_sequence
from .skeleton import Skeleton, build_skeleton
from .still import FILE_UP, check_reach, losses, write_still

if TYPE_CHECKING:
    from .page import PageOptions

FRAMES, FPS = 60, 30.0


def export(request: ExportRequest, device: str = "cpu") -> str:
    """Write the requested file and return a line that describes it.

    Raises:
        UserError: the request cannot be met; an existing file stays unchanged.
    """
    check_request(request)
    if request.kind in SEQUENCES:
        check_folder(request.output)
    if request.kind == "mesh":
        with explained(request.run, request.ply):
            held = _export_mesh(request, device)
    elif request.still:
        held = _export_still(request, device)
    elif request.kind == "cameras":
        held = _export_cameras(request, device)
    elif request.kind == "html":
        held = _export_page(request, device)
    else:
        held = _export_moving(request, device)
    return f"{request.output}: {held}, {_size(request.output)}"


def _size(path: Path) -> str:
    folder = path.parent if path.name.lower() == META else path
    files = folder.iterdir() if folder.is_dir() else [path]
    return f"{sum(file.stat().st_size for file in files) / 2**20:.1f} MiB"


def _open(request: ExportRequest, device: str) -> Scene:
    if request.run is not None:
        return Scene.load(request.run, device=device)
    assert request.ply is not None
    return open_gaussians(request.ply, device, up=request.up)


def _open_session(request: ExportRequest, scene: Scene) -> EditSession:
    """Return a session on the scene with the edit. A scene at rest has as many control points as the edit's had."""
    if request.edit is not None and not scene.motion.moves:
        scene = with_control_points(scene, edit_file.control_points_of(request.edit) or COUNT)
    session = EditSession(scene)
    if request.edit is not None:
        session.load(request.edit)
        if not request.still and request.at is None:
            note_what_is_late(session.edit)
    return session


def _export_still(request: ExportRequest, device: str) -> str:
    up, antialiased, when = direction(request.up or FILE_UP), False, "at rest"
    if request.run is None and request.edit is None:
        assert request.ply is not None
        antialiased = read_antialiased(request.ply)
        with torch.no_grad():
            stored = read_gaussians(request.ply)
            with shortage_as_user_error(request.ply):
                gaussians, when = keep_finite(stored.activate()), f"as in {request.ply}"
            if stored.left_out:
                when += f", without {stored.left_out:,} that cannot be drawn"
    else:
        scene = _open(request, device)
        up, antialiased = scene.overview.up, scene.config.antialiased
        session = None if request.edit is None else _open_session(request, scene)
        scene = scene if session is None else session.scene
        check_reach(request.output, lambda: _at_moment(request, scene, session)[0])
        scene = plain_scene(scene)
        gaussians, when = _at_moment(request, scene, session)
        if session is None and request.time is None:
            gaussians = _with_mean_colors(scene, None, even_moments(FRAMES, FPS))
    gaussians = keep_finite(gaussians)
    version = request.spz_version or 4
    clipped = write_still(request.output, gaussians, up=up, antialiased=antialiased, spz_version=version)
    return f"{len(gaussians.means):,} Gaussians {when}{losses(request.output, gaussians, clipped)}"


def _at_moment(request: ExportRequest, scene: Scene, session: EditSession | None) -> tuple[Gaussians, str]:
    """Return the Gaussians of a scene at the moment of a still, and the moment in words."""
    if session is not None:
        session, at = session.drawn_with(scene), request.at or 0.0
        when = f"{at:g} s into the edit's film{beyond_end(session, at)}"
        return session.gaussians_at(session.scene_time(at), at), when
    if request.time is not None:
        return scene.gaussians_at(request.time), f"at time {request.time:g}"
    return at_rest(scene), "at rest"


def _export_moving(request: ExportRequest, device: str) -> str:
    scene, session = _open(request, device), None
    if request.edit is None and not scene.motion.moves:
        _refuse_at_rest(request)
    if request.edit is None and scene.motion.moves and request.kind not in FRAME_FORMATS:
        _refuse_without_joints(request, scene)
    if request.edit is not None or (request.kind not in FRAME_FORMATS and scene.motion.moves):
        session = _open_session(request, scene)
    parts = session.skeleton if session is not None and request.skeleton == "parts" else None
    if request.kind not in ("graph", "tracks"):
        scene = plain_scene(scene if session is None else session.scene)
        session = None if session is None else session.drawn_with(scene)
    if session is None and request.kind == "glb":
        gaussians = keep_finite(at_rest(scene))
        write_glb(request.output, gaussians, scene.overview.up)
        return f"{len(gaussians.means):,} Gaussians that stand still"
    frames = even_moments(request.frames or FRAMES, request.fps or FPS)
    moments = film_moments(session) if session is not None and request.edit is not None else frames
    if request.kind in SEQUENCES:
        return _write_frames(request, scene, session, moments)
    if request.kind == "tracks":
        with explained(request.run, request.ply):
            return export_tracks(request.output, scene, session, moments, request.points)
    if request.kind == "4dgs":
        return export_fourdgs(request.output, scene, session, moments, _usable(scene))
    assert session is not None
    if parts is not None:
        return _write_rig(request.output, session, parts, moments)
    return _write_skeleton(request, session, moments)


def _refuse_at_rest(request: ExportRequest) -> None:
    """Refuse what only a moving scene or an edit has."""
    if request.kind != "glb" and request.kind not in SEQUENCES:
        raise UserError(f"--format {request.kind}: {request.run} stands still; write its Gaussians as ply or glb")
    if request.skeleton == "parts":
        raise UserError(f"--skeleton parts: {request.run} stands still; give an --edit that poses it, or leave it out")
    if request.kind == "glb":
        for option in ("frames", "fps"):
            if getattr(request, option) is not None:
                raise UserError(f"--{option}: {request.run} stands still; leave it out")


def _refuse_without_joints(request: ExportRequest, scene: Scene) -> None:
    """Refuse formats whose motion is that of control points, for motion models that have none."""
    if not hasattr(scene.motion, "apply_pose"):
        still = "a still (--time), or " if request.kind == "glb" else ""
        raise UserError(
            f"--format {request.kind}: holds the motion of control points, and that of {request.run} has none "
            f"({scene.motion_name}); write {still}--format ply-sequence, 4dgs or tracks"
        )


def _write_frames(
    request: ExportRequest, scene: Scene, session: EditSession | None, moments: list[AnimationMoment]
) -> str:
    counts, rows = [], _usable(scene)  # the same rows in every frame, so that row i is always the same Gaussian

    def frames() -> Iterator[Gaussians]:
        for moment in moments:
            finite = keep_finite(select_gaussians(posed_gaussians(scene, session, moment), rows))
            counts.append(len(finite.means))
            yield finite

    with progress(len(moments), "export") as shown:
        how = {"ending": ENDINGS[request.kind], "antialiased": scene.config.antialiased}
        count = write_sequence(request.output, frames(), shown.advance, **how)
    least, most = min(counts), max(counts)
    held = f"{most:,}" if least == most else f"{least:,} to {most:,}"
    return f"{count} frames of {held} Gaussians"


def _write_skeleton(request: ExportRequest, session: EditSession, moments: list[AnimationMoment]) -> str:
    scene, up = session.scene, session.scene.overview.up
    with progress(len(moments), "export") as shown:
        skeleton = build_skeleton(session, moments, shown.advance, bound=request.kind != "graph")
    length = f"{len(skeleton.rest)} control points at {len(moments)} instants"
    if request.kind == "graph":
        write_graph(request.output, skeleton, session.graph.edges, up)
        return f"{length}, {len(session.graph.edges):,} edges"
    rest, rows, skeleton = _finite(scene, skeleton)
    if request.kind == "glb":
        rest = select_gaussians(_with_mean_colors(scene, session, moments), rows)
        write_glb(request.output, rest, up, skeleton)
    else:
        shading = scene.gaussians.shading.detach().cpu().numpy()[rows]
        correctives = scene.normalisation.undo_scale(scene.gaussians.correctives.detach()).cpu().numpy()[rows]
        write_npz(request.output, rest, skeleton, shading=shading, correctives=correctives, up=up)
    return f"{len(rest.means):,} Gaussians, {length}"


def _write_rig(path: Path, session: EditSession, parts: Parts, moments: list[AnimationMoment]) -> str:
    with progress(len(moments), "export") as shown:
        rig = build_rig(session, parts, moments, _usable(session.scene), shown.advance)
    write_glb(path, rig.gaussians, session.scene.overview.up, rig.skeleton)
    joints = f"{len(rig.skeleton.rest)} joints at {len(moments)} instants"
    return f"{len(rig.gaussians.means):,} Gaussians, {joints} ({rig.loss})"


def _finite(scene: Scene, skeleton: Skeleton) -> tuple[Gaussians, np.ndarray, Skeleton]:
    """Return the finite Gaussians at rest, their rows [N] bool, and the skeleton restricted to them."""
    rows = _usable(scene) & np.isfinite(skeleton.weights).all(axis=1)
    if not rows.any():
        raise UserError("no Gaussian of the scene is finite; train again with a lower rate")
    return select_gaussians(at_rest(scene), rows), rows, skeleton.select(rows)


def _usable(scene: Scene) -> np.ndarray:
    """Return [N] bool: Gaussians whose parameters are all finite."""
    rows = finite_rows(at_rest(scene))
    for part in (scene.gaussians.shading, scene.gaussians.correctives, scene.gaussians.hyper):
        rows &= part.detach().isfinite().all(dim=1).cpu().numpy()
    return rows


def _with_mean_colors(scene: Scene, session: EditSession | None, moments: list[AnimationMoment]) -> Gaussians:
    """Return Gaussians at rest with their mean colours over all moments, for formats that hold one colour: shading
    changes a colour as the surface turns, and tints change it over time."""
    rest = at_rest(scene)
    tinted = isinstance(scene.motion, ControlPoints) and scene.config.motion.has_tints
    if not scene.motion.moves or not (tinted or scene.gaussians.shading.shape[1]):
        return rest
    total = torch.zeros_like(rest.sh_dc, dtype=torch.float64)
    for moment in moments:
        total += posed_gaussians(scene, session, moment).sh_dc.detach()
    return replace(rest, sh_dc=(total / len(moments)).float())


def _export_cameras(request: ExportRequest, device: str) -> str:
    from ..training.camera_refinement import refined

    assert request.run is not None
    scene = Scene.load(request.run, device=device)
    settings = scene.settings.get("data", {})
    folder = settings.get("folder")
    if not isinstance(folder, str) or not Path(folder).is_dir():
        raise UserError(f"{request.run}/config.json: data.folder {folder} is no folder; put it back or correct it")
    if request.output.exists() and request.output.resolve().parent == Path(folder).resolve():
        raise UserError(f"--output {request.output}: would overwrite a file of the data set; give another name")
    how = {key: settings[key] for key in IMAGE_SETTINGS if key in settings}
    splits = {split: data.load(folder, split, **how) for split in ("train", "test")}
    splits["train"] = refined(splits["train"], request.run, scene.normalisation) or splits["train"]
    count = write_cameras(request.output, splits)
    return f"{count} cameras"


def _export_mesh(request: ExportRequest, device: str) -> str:
    from .mesh.job import FACES, RESOLUTION, MeshJob, MeshSettings

    scene = _open(request, device)
    moves = scene.motion.moves or request.edit is not None
    if request.sequence and not moves:
        raise UserError(f"--sequence: {request.run or request.ply} stands still; leave --sequence out")
    if request.sequence and scene.motion.moves and not isinstance(scene.motion, ControlPoints):
        raise UserError(
            f"--sequence: the motion model {scene.motion_name!r} has no control points, which move a mesh; write "
            "a mesh of each instant with --time"
        )
    session = _open_session(request, scene) if request.sequence or request.edit is not None else None
    job = MeshJob(scene, session, MeshSettings(request.faces or FACES, request.resolution or RESOLUTION))
    if request.sequence:
        assert session is not None
        frames = even_moments(request.frames or FRAMES, request.fps or FPS)
        return job.write_moving(request.output, film_moments(session) if request.edit is not None else frames)
    at = (request.at or 0.0) if request.edit is not None else None
    time = session.scene_time(at) if session is not None and at is not None else request.time or 0.0
    return job.write_still(request.output, AnimationMoment(at or 0.0, time, at))


def _export_page(request: ExportRequest, device: str) -> str:
    from .captions import read_captions
    from .page import PageOptions, card_path, write_page

    captions = [] if request.captions is None else read_captions(request.captions)
    scene = _open(request, device)
    source = request.run or request.ply
    assert source is not None
    title = request.title or source.resolve().name
    options = PageOptions(title, request.max_mib, request.url, captions=captions)
    if request.edit is not None or request.pose:
        scene, options = _with_session(request, scene, options)
    count = write_page(scene, request.output, options)
    moves = scene.motion.moves or request.edit is not None
    parts = " and parts to pull" if request.pose else ""
    card = f", with {card_path(request.output).name} for links to it" if request.url else ""
    return f"{count:,} Gaussians {'and their motion' if moves else 'that stand still'}{parts}{card}"


def _with_session(request: ExportRequest, scene: Scene, options: PageOptions) -> tuple[Scene, PageOptions]:
    """Return the scene with control points, and the page's options with the edit's film and the parts."""
    from .page_edit import edited_motion, film_times, own_motion
    from .page_pose import posable

    session = _open_session(request, scene)
    if request.edit is None:
        motion, picture = own_motion(session), None
    else:
        with progress(len(film_times(session)), "export") as shown:
            motion = edited_motion(session, shown.advance)
        picture = functools.partial(edited_poster, session)
    motion = posable(session, motion) if request.pose else motion
    return session.scene, replace(options, motion=motion, picture=picture)
