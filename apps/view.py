"""Render a film of a trained scene to a file: a turntable, the motion, or both. Or show the scene in the browser."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from scgs_warp.apps.cli import Device, prepare, run

if TYPE_CHECKING:
    from scgs_warp.scene.scene import Scene

LARGEST_SIDE = 8192


@dataclass(frozen=True)
class Options:
    """Render a film of a trained scene to a file, or show the scene in the browser (--live)."""

    output: Path | None = None
    """Film to write: a name that ends in .mp4 or .gif, or a folder for numbered PNGs."""
    run: Path | None = None
    """Run folder, as apps/train.py writes it."""
    ply: Path | None = None
    """Instead of a run: a file of Gaussians, which does not move: .ply, .compressed.ply, .splat, .spz, .sog or a SOG's
    meta.json."""
    mode: Literal["turntable", "time", "both"] = "both"
    """turntable: the camera moves round a still scene; time: the scene moves; both: both at once. If the training
    cameras saw the scene from one side only, the camera swings within that range."""
    show: Literal["rgb", "depth", "alpha", "nodes", "trajectories"] = "rgb"
    """Content of the film: colours, depth (near is warm), alpha, control points, or their trajectories."""
    frames: int = 120
    """Frame count of the film."""
    size: int = 512
    """Longer side of the film in pixels; the proportions are those of the training images."""
    fps: float = 30.0
    """Frames per second."""
    time: float = 0.5
    """Time that a turntable shows, from 0 to 1."""
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
    if options.live:
        if options.output is not None:
            raise UserError("--live shows the scene in the browser and writes nothing; leave --output out")
        if not 0 <= options.port <= 65535:
            raise UserError(f"--port {options.port}: give 1 to 65535, or 0 for any")
        return
    if options.output is None:
        raise UserError("view.py: give --output for a film, or --live for the browser")
    if options.share:
        raise UserError("--share: belongs to --live; leave it out for a film")
    if options.frames < 1:
        raise UserError(f"--frames {options.frames}: a film needs at least 1")
    if not 16 <= options.size <= LARGEST_SIDE:
        memory = f"; a frame of {options.size} x {options.size} would take {video.frame_gib(options.size):,.1f} GiB"
        needed = memory if options.size > LARGEST_SIDE else ""
        raise UserError(f"--size {options.size}: give 16 to {LARGEST_SIDE} pixels{needed}")
    if not 0 < options.fps <= 1000:
        raise UserError(f"--fps {options.fps:g}: give more than 0 and at most 1000 frames a second")
    if not 0 <= options.time <= 1:
        raise UserError(f"--time {options.time:g}: give a time from 0 to 1")
    video.check_path(options.output)


def open_scene(options: Options, device: str) -> Scene:
    """Load the run or the file."""
    from scgs_warp.scene.scene import Scene

    if options.ply is not None:
        from scgs_warp.scene.from_gaussians import open_gaussians

        return open_gaussians(options.ply, device)
    assert options.run is not None
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
    with stop_signals() as stop, SceneView(source.resolve().name, port=options.port, shared=options.share) as view:
        say(f"reading {source}")
        watcher = view_run(source, view, device) if options.run is not None else None
        if watcher is None:
            view_file(source, view, device)
        print(view.invitation, flush=True)
        stop.wait()
        if watcher is not None:
            watcher.stop()


def main(args: list[str] | None) -> None:
    import tyro

    options = tyro.cli(Options, args=args, prog="view.py")
    check(options)
    if options.live:
        from scgs_warp.live.server import import_aiohttp

        import_aiohttp()  # A missing package is reported before the scene is loaded.
    device = prepare(options.device, options.threads, options.memory_gib)
    if options.live:
        show_live(options, device)
        return
    assert options.output is not None

    from scgs_warp.geometry import cameras
    from scgs_warp.runtime.progress import progress
    from scgs_warp.visualization import video
    from scgs_warp.visualization.overlay import Painter

    scene = open_scene(options, device)
    if options.mode == "time":
        path = [cameras.orbit_camera(scene.overview, scene.overview.azimuth, options.size)] * options.frames
    else:
        path = cameras.turntable(scene.overview, options.frames, options.size)
    times = [frame / max(options.frames - 1, 1) for frame in range(options.frames)]
    if options.mode == "turntable":
        times = [options.time] * options.frames
    views = [(camera.to(device), time) for camera, time in zip(path, times)]
    video.require_memory(options.output, path[0].width, path[0].height, options.frames, device)
    painter = Painter(scene, options.show, views)
    with video.film(options.output, options.fps) as writer, progress(options.frames, "view") as shown:
        for camera, time in views:
            writer.write(painter.paint(camera, time))
            shown.advance()
    print(f"{options.output}: {options.frames} frames of {path[0].width} x {path[0].height}")


def cli(args: list[str] | None = None) -> int:
    return run(main, args)


if __name__ == "__main__":
    sys.exit(cli())
