"""Edit a scene by moving control points, in the browser or by a script."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from scgs_warp.apps.arguments import parse
from scgs_warp.apps.cli import Device, prepare, run
from scgs_warp.geometry.axes import Axis

if TYPE_CHECKING:
    from scgs_warp.edit import EditSession


@dataclass(frozen=True)
class Options:
    """Edit a trained scene or a 3D-GS file: by a script into a film or a file, otherwise in the browser."""

    run: Path | None = None
    """Run folder, as apps/train.py writes it."""
    ply: Path | None = None
    """Instead of a run: a file of Gaussians, which does not move by itself: .ply, .compressed.ply, .splat, .spz, .sog
    or a SOG's meta.json."""
    up: Axis | None = None
    """Axis of --ply's file that points up; -y by default, as in reconstructions from photographs."""
    script: Path | None = None
    """Edit to load, as JSON (docs/editing.md). Without --output and --export, the editor opens with this edit."""
    output: Path | None = None
    """Film to write of the script's edit: a name that ends in .mp4 or .gif, or a folder for numbered PNGs."""
    export: Path | None = None
    """File to write the edited scene to, as it is at the moment --at of the film: .ply, .compressed.ply, .splat, .spz,
    .sog or .glb."""
    at: float | None = None
    """Second of the film that --export writes; by default that of the last keyframe."""
    skeleton: bool = False
    """Print the parts that moved together, with their joints, and end (docs/editing.md)."""
    parts: int | None = None
    """Number of parts to find, instead of the number that follows from the motion. There are more if the scene falls
    into more pieces, and fewer if the motion does not tell so many apart. A line then says so."""
    motion: Path | None = None
    """Motion to play on the scene's parts as keyframes: a run folder, or a glTF character (.glb, .gltf)."""
    clip: str | None = None
    """Name of the animation of --motion; the first one that moves by default."""
    match: Path | None = None
    """JSON object that maps parts of the scene to parts of --motion; by default, parts of the same name match."""
    nodes: int | None = None
    """Number of control points to make for a scene without motion; 512 by default."""
    size: int | None = None
    """Longer side of the film in pixels, instead of the script's; both sides are rounded to even numbers, which an
    .mp4 needs."""
    port: int | None = None
    """Port of the editor on 127.0.0.1, 8080 by default; if it is taken, the next free one. With --share, the port for
    other machines."""
    share: bool = False
    """Serve the editor to other machines, too: on all interfaces, to whoever has the token of the printed address."""
    folder: Path | None = None
    """Folder for the editor's edits, films and exports; by default edits/ in the run folder, or beside the file
    that --ply names. The editor keeps its edit there after every change and restores it when it starts again."""
    new: bool = False
    """Begin with an empty edit instead of the one that the editor has kept."""
    device: Device = "auto"
    """Where to render; auto takes a GPU if there is one."""
    threads: int | None = None
    """CPU threads; all cores by default."""
    memory_gib: float | None = None
    """Limit on memory in GiB (on a GPU, on the memory of the GPU); by default all free memory. Large images are drawn
    in bands, and what does not fit is refused with an error that names its size."""


def check(options: Options) -> None:
    """Refuse impossible options before anything is loaded.

    Raises:
        UserError: names the option and the remedy.
    """
    from scgs_warp.config.bounds import MOST_NODES
    from scgs_warp.errors import UserError
    from scgs_warp.export.request import STILL_FORMATS, SUFFIXES, Format, check_output, output_suffix
    from scgs_warp.storage.output_folders import refuse_inputs
    from scgs_warp.visualization import video

    if (options.run is None) == (options.ply is None):
        raise UserError("edit.py: give one of --run and --ply")
    if options.up is not None and options.ply is None:
        raise UserError(f"--up {options.up}: belongs to --ply; a run knows from its cameras what is up")
    if options.nodes is not None and not 1 <= options.nodes <= MOST_NODES:
        raise UserError(f"--nodes {options.nodes}: give 1 to {MOST_NODES}")
    if options.parts is not None and not 1 <= options.parts <= MOST_NODES:
        raise UserError(f"--parts {options.parts}: give 1 to {MOST_NODES}")
    if options.skeleton and (options.output is not None or options.export is not None):
        raise UserError("--skeleton prints and ends; leave --output and --export out")
    if options.size is not None and not 16 <= options.size <= 8192:
        raise UserError(f"--size {options.size}: give 16 to 8192 pixels")
    for name in ("clip", "match"):
        if getattr(options, name) is not None and options.motion is None:
            raise UserError(f"--{name}: belongs to --motion; give both, or neither")
    if options.clip is not None and options.motion is not None and options.motion.is_dir():
        raise UserError(
            f"--clip {options.clip}: a run has no clips; leave it out, or give a glTF character to --motion"
        )
    if options.output is not None and options.script is None and options.motion is None:
        raise UserError(f"--output {options.output}: a film needs --script or --motion")
    kinds: dict[str, Format] = {SUFFIXES[kind]: kind for kind in STILL_FORMATS}
    if options.export is not None and output_suffix(options.export) not in kinds:
        raise UserError(f"--export {options.export}: end the name in .ply, .compressed.ply, .splat, .spz, .sog or .glb")
    if options.port is not None and not 0 <= options.port <= 65535:
        raise UserError(f"--port {options.port}: give 1 to 65535, or 0 for any")
    if options.at is not None and not 0 <= options.at <= 3600:
        raise UserError(f"--at {options.at:g}: give a second of the film, from 0 to 3600")
    if options.motion is not None and not options.motion.exists():
        raise UserError(f"--motion {options.motion}: no such file or folder; give a run, a .glb or a .gltf")
    check_unused(options)
    if options.output is not None:
        video.check_path(options.output)
    if options.export is not None:
        refuse_inputs(options.export, [options.ply, options.motion], option="--export")
        check_output(options.export, kinds[output_suffix(options.export)], "--export")


def check_unused(options: Options) -> None:
    """Refuse options that would have no effect.

    Raises:
        UserError: names the option, and the one that it does not go with or needs.
    """
    from scgs_warp.errors import UserError

    if options.at is not None and options.export is None:
        raise UserError(f"--at {options.at:g}: belongs to --export; give both, or neither")
    ends = next((name for name in ("output", "export", "skeleton") if getattr(options, name)), None)
    if ends is None:
        return
    for name in ("port", "share", "new", "folder"):
        if getattr(options, name) not in (None, False):
            raise UserError(f"--{name}: belongs to the editor in the browser; leave it or --{ends} out")
    if options.size is not None and options.output is None:
        raise UserError(f"--size {options.size}: belongs to a film; leave it out, or give --output beside --{ends}")


def open_session(options: Options, device: str) -> EditSession:
    """Open the scene for editing, and load the script if there is one."""
    from scgs_warp.edit import EditSession
    from scgs_warp.errors import UserError
    from scgs_warp.motion import Static
    from scgs_warp.motion.static_nodes import COUNT
    from scgs_warp.scene.from_gaussians import open_gaussians, with_control_points
    from scgs_warp.scene.scene import Scene

    if options.ply is not None:
        scene = open_gaussians(options.ply, device, options.nodes or COUNT, options.up)
    else:
        assert options.run is not None
        scene = Scene.load(options.run, device=device)
        if isinstance(scene.motion, Static):
            scene = with_control_points(scene, options.nodes or COUNT)
        elif options.nodes is not None:
            raise UserError(f"--nodes {options.nodes}: --run {options.run} moves and has its own; leave --nodes out")
    session = EditSession(scene)
    if options.parts is not None:
        session.use_parts(options.parts)
    if options.script is not None:
        session.load(options.script)
        own = session.edit.skeleton
        if options.parts is not None and own is None:
            session.use_parts(options.parts)
        elif options.parts is not None and own is not None and own.parts != session.parts(options.parts):
            raise UserError(
                f"--parts {options.parts}: --script {options.script} holds its own parts; leave --parts out"
            )
        warn_of_another_scene(options.script, session)
    if options.parts is not None:
        note_other_count(session, options.parts)
    if options.motion is not None:
        play_motion(session, options, device)
    if options.size is not None:
        session.resize_film(options.size)
    return session


def note_other_count(session: EditSession, count: int) -> None:
    """Say so if --parts gives another number of parts."""
    from scgs_warp.edit.skeleton_from_motion import other_count

    said = other_count(session.skeleton, count)
    if said is not None:
        print(f"note: --parts {count}: {said}", file=sys.stderr)


def warn_of_another_scene(script: Path, session: EditSession) -> None:
    """Say so if the script names places outside the scene."""
    from scgs_warp.edit.edit_file import read_object
    from scgs_warp.edit.misplaced import misplaced

    found = misplaced(read_object(script), session.engine)
    if found is not None:
        print(f"warning: {script}: made for another scene? {found}", file=sys.stderr)


def play_motion(session: EditSession, options: Options, device: str) -> None:
    """Play the motion of a run or of a glTF character on the session's scene, frozen where its edit freezes it."""
    from scgs_warp.edit import EditSession, motion_of_gltf, motion_of_session, retarget
    from scgs_warp.edit.retarget import read_match
    from scgs_warp.errors import UserError
    from scgs_warp.scene.scene import Scene

    assert options.motion is not None
    if options.motion.is_dir():
        source = EditSession(Scene.load(options.motion, device=device))
        motion = motion_of_session(source, source.edit.film.seconds)
    else:
        motion = motion_of_gltf(options.motion, options.clip)
    if not motion.moves:
        print(f"note: {options.motion}: nothing moves in it, so the scene takes one pose", file=sys.stderr)
    match = None if options.match is None else read_match(options.match)
    try:
        matched = retarget(session, motion, match, session.edit.playback.freeze or 0.0)
    except UserError as error:
        raise UserError(f"{options.match or options.motion}: {error}") from None
    print(f"{options.motion}: plays on {', '.join(matched)}", flush=True)


def open_browser(session: EditSession, options: Options) -> None:
    """Serve the editor until Ctrl-C.

    Raises:
        UserError: the editor cannot run here.
    """
    from scgs_warp.editor import Editor
    from scgs_warp.editor.autosave import Autosave, folder_for
    from scgs_warp.runtime.stop_signals import stop_signals

    source = options.run or options.ply
    assert source is not None
    folder = folder_for(source, options.folder)
    autosave = Autosave(session, folder, "" if options.ply is None else options.ply.name)
    session.skeleton  # noqa: B018 a skeleton.json that is wrong is refused here
    asked = options.script is not None or options.motion is not None or options.parts is not None
    autosave.start(restore=not asked and not options.new)
    if options.size is not None:
        session.resize_film(options.size)
        autosave.note(session.edit)
    title = source.resolve().name
    served = {"port": 8080 if options.port is None else options.port, "shared": options.share, "source": source}
    with stop_signals() as stop:  # Shells may make background processes ignore Ctrl-C.
        editor = Editor(session, folder, title=title, **served, autosave=autosave)
        try:
            print(autosave.said or f"the edit is kept in {autosave.path}")
            print(f"open {editor.url} in a browser; Ctrl-C ends", flush=True)
            if options.share:
                print("from other machines: the same with this machine's name; whoever has the token may edit")
                print("what is sent is not encrypted: outside a network that you trust, forward the port over SSH")
                sys.stdout.flush()
            stop.wait()
        finally:
            editor.stop()
        print(f"the editor has ended; the edit is in {autosave.path}", flush=True)


def skeleton_lines(session: EditSession) -> list[str]:
    """Describe the skeleton, a line for each part."""
    said = (
        ["nothing moves by itself: these parts follow from the shape"] if session.skeleton.source == "geometry" else []
    )
    rows = [["part", "hangs on", "points", "joint", "axis", "turns by", "confidence"]]
    for part in session.parts():
        joint, axis = (
            "" if v is None else " ".join(f"{x:.3g}" for x in v)
            for v in (part.joint if part.parent else None, part.axis)
        )
        turns = [f"{part.degrees:.0f} degrees", f"{part.confidence:.2f}"] if part.parent else ["", ""]
        rows.append([part.name, part.parent or "", str(len(part.nodes)), joint, axis, *turns])
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [*said, *("  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in rows)]


def main(args: list[str] | None) -> None:
    options = parse(Options, "edit", args)
    check(options)
    browser = options.output is None and options.export is None and not options.skeleton
    if browser:
        from scgs_warp.live.server import import_aiohttp

        import_aiohttp()  # A missing package is reported before the scene is loaded.
    device = prepare(options.device, options.threads, options.memory_gib)
    session = open_session(options, device)
    if options.skeleton:
        print("\n".join(skeleton_lines(session)))
        return
    if browser:
        open_browser(session, options)
        return

    from scgs_warp.edit import film_camera, render_film
    from scgs_warp.runtime.progress import progress

    if options.output is not None:
        with progress(session.edit.film.frames, "edit") as shown:
            frames = render_film(session, options.output, shown.advance)
        camera = film_camera(session, 0.0)
        print(f"{options.output}: {frames} frames of {camera.width} x {camera.height}")
    if options.export is not None:
        from scgs_warp.edit.filming import beyond_end
        from scgs_warp.export.still import write_edited

        last = max((frame.at for frame in session.edit.keyframes), default=0.0)
        at = last if options.at is None else options.at
        which = ", the last keyframe" if options.at is None and session.edit.keyframes else ""
        held, note = write_edited(options.export, session, session.scene_time(at), at)
        which += beyond_end(session, at)
        print(f"{options.export}: {held:,} Gaussians, {at:g} s into the film{which}{note}")


def cli(args: list[str] | None = None) -> int:
    return run(main, args)


if __name__ == "__main__":
    sys.exit(cli())
