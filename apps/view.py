"""Render a film of a trained scene to a file: a turntable, the motion, or both. Or show the scene in the browser."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from scgs_warp.apps.arguments import parse, refuse_given
from scgs_warp.apps.cli import Device, prepare, run
from scgs_warp.geometry.axes import Axis

if TYPE_CHECKING:
    from scgs_warp.scene.scene import Scene
    from scgs_warp.types import Camera

LARGEST_SIDE = 8192
FRAMES = 120
"""Default frame count of a film."""
OF_FILMS = ("mode", "show", "frames", "size", "fps", "time", "frame", "target", "zoom", "path")
"""Options that the page in the browser does not have."""


@dataclass(frozen=True)
class Options:
    """Render a film of a trained scene to a file, or show the scene in the browser (--live)."""

    output: Path | None = None
    """Film to write: a name that ends in .mp4 or .gif, or a folder for numbered PNGs."""
    run: Path | None = None
    """Run folder, as apps/train.py writes it."""
    also: tyro.conf.UseAppendAction[tuple[Path, ...]] = ()
    """Run folder of a further training of the same data with another seed: the film shows the mean of their pictures.
    Repeat it for more."""
    ply: Path | None = None
    """Instead of a run: a file of Gaussians, which does not move: .ply, .compressed.ply, .splat, .spz, .sog or a SOG's
    meta.json."""
    up: Axis | None = None
    """Axis of --ply's file that points up; -y by default, as in reconstructions from photographs."""
    mode: Literal["turntable", "time", "both"] = "both"
    """turntable: the camera moves round a still scene; time: the scene moves; both: both at once. If the training
    cameras saw the scene from one side only, the camera swings within that range."""
    show: Literal["rgb", "depth", "alpha", "nodes", "trajectories"] = "rgb"
    """Content of the film: colours, depth (near is warm), alpha, control points, or their trajectories."""
    frames: int | None = None
    """Frame count of the film; 120 by default, with --path that of the path."""
    size: int = 512
    """Longer side of the film in pixels; the proportions are those of the training images. An .mp4 needs even numbers
    of pixels, to which its sides are rounded."""
    fps: float = 30.0
    """Frames per second; at most 50 in a .gif."""
    time: float | None = None
    """Time that a turntable shows, from 0 to 1; 0.5 by default. With a time, --mode is turntable."""
    frame: Literal["auto", "cameras", "subject"] = "auto"
    """What the camera keeps in the picture. cameras: what the training cameras saw; subject: all of the opaque scene,
    from all sides and at all times; auto: the subject if it is cut out, otherwise what the cameras saw."""
    target: tuple[float, float, float] | None = None
    """Point to look at, world units: --target X Y Z."""
    zoom: float = 1.0
    """Factor on the focal length: 2 shows half as much, twice as large."""
    path: Path | None = None
    """Camera path to follow instead: nerfstudio's camera_path.json, or a transforms.json. With --frames, as many
    cameras are interpolated along it."""
    live: bool = False
    """Instead of a film, show the scene in the browser (docs/page.md), also while another process trains it."""
    port: int = 8080
    """With --live: port on 127.0.0.1; if it is taken, one of the next. With --share, the port for other machines."""
    share: bool = False
    """With --live: serve the page to other machines, too. The printed address has a token."""
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
    from scgs_warp.errors import UserError
    from scgs_warp.visualization import video

    if (options.run is None) == (options.ply is None):
        raise UserError("view.py: give one of --run and --ply")
    if options.also and (options.run is None or options.live):
        raise UserError("--also: takes runs beside --run, for films; leave --ply and --live out")
    if options.also and options.show in ("nodes", "trajectories"):
        raise UserError(f"--also: control points have no mean; leave out --show {options.show}")
    if options.up is not None and options.ply is None:
        raise UserError(f"--up {options.up}: belongs to --ply; a run knows from its cameras what is up")
    if options.live:
        if options.output is not None:
            raise UserError("--live shows the scene in the browser and writes nothing; leave --output out")
        refuse_given(options, OF_FILMS, "belongs to a film; leave it out with --live")
        if not 0 <= options.port <= 65535:
            raise UserError(f"--port {options.port}: give 1 to 65535, or 0 for any")
        return
    if options.output is None:
        raise UserError("--output is missing: name a film (.mp4 or .gif) or a folder for PNGs, or give --live")
    refuse_given(options, ("port", "share"), "belongs to --live; leave it out for a film")
    if options.frames is not None and not 1 <= options.frames <= video.MAX_FRAMES:
        raise UserError(f"--frames {options.frames}: give 1 to {video.MAX_FRAMES:,}")
    if options.path is not None and (options.target is not None or options.frame != "auto" or options.zoom != 1.0):
        raise UserError(f"--path {options.path}: states the cameras; leave out --frame, --target and --zoom")
    if not 16 <= options.size <= LARGEST_SIDE:
        memory = f"; a frame of {options.size} x {options.size} would take {video.frame_gib(options.size):,.1f} GiB"
        needed = memory if options.size > LARGEST_SIDE else ""
        raise UserError(f"--size {options.size}: give 16 to {LARGEST_SIDE} pixels{needed}")
    if not video.SLOWEST <= options.fps <= 1000:
        raise UserError(f"--fps {options.fps:g}: give {video.SLOWEST} to 1000 frames a second")
    if options.time is not None and not 0 <= options.time <= 1:
        raise UserError(f"--time {options.time:g}: give a time from 0 to 1")
    if options.time is not None and options.mode == "time":
        raise UserError(f"--time {options.time:g}: --mode time shows all times; leave one of the two out")
    video.check_path(options.output)


def open_scene(options: Options, device: str) -> Scene:
    """Load the run, the mean of several, or the file."""
    from scgs_warp.scene.scene import Scene

    if options.ply is not None:
        from scgs_warp.scene.from_gaussians import open_gaussians

        return open_gaussians(options.ply, device, up=options.up)
    assert options.run is not None
    if options.also:
        from scgs_warp.scene.mean import load_mean

        return load_mean([options.run, *options.also], device)
    return Scene.load(options.run, device=device)


def show_live(options: Options, device: str) -> None:
    """Serve the scene until Ctrl-C.

    Raises:
        UserError: the scene cannot be shown, or the page cannot be served.
    """
    from scgs_warp.live.run_view import view_file, view_run
    from scgs_warp.live.viewer import SceneView
    from scgs_warp.runtime.progress import say
    from scgs_warp.runtime.stop_signals import stop_signals

    source = options.run or options.ply
    assert source is not None
    served = {"port": options.port, "shared": options.share, "source": source}
    with stop_signals() as stop, SceneView(source.resolve().name, **served) as view:
        say(f"reading {source}")
        watcher = view_run(source, view, device) if options.run is not None else None
        if watcher is None:
            view_file(source, view, device, options.up)
        print(view.invitation, flush=True)
        stop.wait()
        if watcher is not None:
            watcher.stop()


def film_views(options: Options, scene: Scene) -> list[tuple[Camera, float]]:
    """Return the camera and the time of each frame.

    Raises:
        UserError: the path cannot be read, or the scene cannot be framed as asked.
    """
    from scgs_warp.data.camera_path import read_camera_path
    from scgs_warp.geometry.cameras import orbit_camera, turntable
    from scgs_warp.visualization import video
    from scgs_warp.visualization.framing import aim, frame_subject, framed

    assert options.output is not None
    given: list[float | None]
    step = video.size_step(options.output)
    if options.path is not None:
        film = read_camera_path(options.path, scene.overview).film(options.frames, options.size, step)
        path, given = [camera for camera, _ in film], [time for _, time in film]
    else:
        overview = scene.overview
        if options.frame == "subject":
            overview = frame_subject(scene)
        elif options.frame == "auto" and options.target is None:
            overview = framed(scene)
        overview = aim(overview, options.target, options.zoom)
        frames = FRAMES if options.frames is None else options.frames
        if options.mode == "time":
            path = [orbit_camera(overview, overview.azimuth, options.size, step=step)] * frames
        else:
            path = turntable(overview, frames, options.size, step=step)
        given = [None] * frames
    if options.mode == "turntable" or options.time is not None:
        return [(camera, 0.5 if options.time is None else options.time) for camera in path]
    last = max(len(path) - 1, 1)
    return [(camera, index / last if time is None else time) for index, (camera, time) in enumerate(zip(path, given))]


def main(args: list[str] | None) -> None:
    options = parse(Options, "view", args)
    check(options)
    if options.live:
        from scgs_warp.live.server import import_aiohttp

        import_aiohttp()  # A missing package is reported before the scene is loaded.
    device = prepare(options.device, options.threads, options.memory_gib)
    if options.live:
        show_live(options, device)
        return
    assert options.output is not None

    from scgs_warp.runtime.progress import progress
    from scgs_warp.visualization import video
    from scgs_warp.visualization.overlay import Painter

    scene = open_scene(options, device)
    if scene.unfinished is not None:
        print(f"{options.run}: {scene.unfinished}")
    views = [(camera.to(device), time) for camera, time in film_views(options, scene)]
    first = views[0][0]
    video.require_memory(options.output, first.width, first.height, len(views), device)
    painter = Painter(scene, options.show, views)
    with video.film(options.output, options.fps) as writer, progress(len(views), "view") as shown:
        for camera, time in views:
            writer.write(painter.paint(camera, time))
            shown.advance()
    print(f"{options.output}: {len(views)} frames of {first.width} x {first.height}")


def cli(args: list[str] | None = None) -> int:
    return run(main, args)


if __name__ == "__main__":
    sys.exit(cli())
