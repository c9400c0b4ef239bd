"""Make a data set from a video, or from those of a rig: ``python apps/capture.py film.mp4 --output data/film``."""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import tyro

from scgs_warp.apps.arguments import parse
from scgs_warp.apps.cli import Device, prepare, run
from scgs_warp.errors import shell_words


@dataclass(frozen=True)
class Options:
    """Find the cameras of a video or of a rig, or import them; write frames, cameras, times and points to a folder for
    train.py --data."""

    output: Path
    """Folder to make. The same command continues an interrupted one; finished work is never overwritten."""
    video: tyro.conf.Positional[Path | None] = None
    """Video, or folder of images from one camera."""
    rig: Path | None = None
    """Instead of VIDEO, folder with one video (or one folder with a video) per camera of a rig: cameras that stand
    still. They are synchronised by their sound. Beside a poses_bounds.npy (Neural 3D Video), the videos are unpacked
    and the cameras kept."""
    poses: Path | None = None
    """Instead of VIDEO, what another program has found: an .npz of MegaSaM, VGGT, MapAnything, Depth Anything 3,
    SpatialTrackerV2 or Pi3, or a folder of MonST3R, ViPE, CUT3R, DA3-Streaming, Polycam, Record3D, 3D Scanner App or
    Stray Scanner. Its cameras and depth maps are taken as they are."""
    offsets: tuple[float, ...] | None = None
    """Seconds at which the videos of a rig begin, in the order of their names, or 0 if all begin at once; by default
    found by sound."""
    held_out: str | None = None
    """Camera of a rig that is held out for evaluation; the first by default."""
    lens: Literal["auto", "shared", "each"] = "auto"
    """Lenses of a rig. shared: all cameras have the same; each: every camera has its own; auto: shared if all videos
    have one size, unless lenses of their own fit clearly better."""
    frames: int | None = None
    """Largest number of frames to pick: the sharpest, spread over time and motion. By default 150 of a video and all of
    a folder. For a rig, number of instants, 150 at most by default."""
    start: float | None = None
    """Second of the video to begin at; for a rig, counted from the first moment at which all cameras record."""
    end: float | None = None
    """Second of the video to end at, counted in the same way."""
    size: int = 1280
    """Longer side of the images in pixels; smaller ones are not enlarged."""
    masks: str = "auto"
    """Masks of image regions to ignore when finding the cameras. auto: moving regions are detected; none: nothing is
    ignored; otherwise a folder or video of masks, black where something moves."""
    keep_static: Literal["on", "off"] = "on"
    """off: keep only what the given masks mark as moving, cut out by alpha, for a scene of the mover alone."""
    keep_moving: Literal["on", "off"] = "on"
    """off: keep only what stands still, for a scene of the background alone; training ignores what the masks mark."""
    matching: Literal["auto", "sequential", "exhaustive"] = "auto"
    """Pairs of frames to match. sequential: neighbours in time; exhaustive: all pairs; auto: by their number."""
    camera_model: Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"] = (
        "SIMPLE_RADIAL"
    )
    """COLMAP's camera model: OPENCV for wide angles, OPENCV_FISHEYE for wider ones. All frames share its parameters,
    which are found together with the poses."""
    fov: float | None = None
    """Initial value of the horizontal field of view in degrees, if it is known."""
    features: int = 4096
    """Largest number of features per frame."""
    least: float = 0.5
    """Smallest share of the frames whose cameras must be found; below it, the command fails and says what to do."""
    seed: int = 0
    """Random seed; the same video and seed give the same frames and cameras."""
    device: Device = "auto"
    """Where to compare features; auto takes a GPU if there is one."""
    threads: int | None = None
    """CPU threads; all cores by default. pycolmap itself uses one."""


def main(args: list[str] | None) -> None:
    options = parse(Options, "capture", args)
    device = prepare(options.device, options.threads)

    import cv2

    from scgs_warp.errors import UserError
    from scgs_warp.runtime import environment

    cv2.setNumThreads(environment.thread_count())
    given = [name for name in ("video", "rig", "poses") if getattr(options, name) is not None]
    if len(given) != 1:
        shown = ["VIDEO" if name == "video" else f"--{name}" for name in given]
        what = f"both {' and '.join(shown)}" if given else "neither VIDEO nor --rig nor --poses"
        raise UserError(
            f"{what}: give a video (or a folder of images), or --rig and a folder of one video per camera, or --poses "
            "and what another program exported"
        )
    further = ""
    if options.video is not None:
        _capture_video(options, options.video, device)
    elif options.rig is not None:
        _capture_rig(options, options.rig, device)
    elif options.poses is not None:
        further = _import_scene(options, options.poses)
    print(f"next: python apps/train.py --data {shell_words(options.output)}{further}")


def _capture_video(options: Options, video: Path, device: str) -> None:
    """Make a data set from one camera's film."""
    from scgs_warp.capture import CaptureRequest, capture
    from scgs_warp.errors import UserError

    o = options
    for name in ("offsets", "held_out"):
        if getattr(o, name) is not None:
            raise UserError(f"--{name.replace('_', '-')}: is for --rig; leave it out")
    if o.keep_static == o.keep_moving == "off":
        raise UserError("--keep-static off --keep-moving off: nothing is left; give one of them")
    keep = "moving" if o.keep_static == "off" else "static" if o.keep_moving == "off" else "all"
    film = (video, o.frames, o.start, o.end, o.size, o.masks)
    request = CaptureRequest(*film, o.matching, o.camera_model, o.fov, o.features, o.least, o.seed, keep)
    made = capture(request, o.output, device=device)
    print("\n".join(made.lines))
    registered = f"{made.outcome.registered} of {made.outcome.picked} frames have a camera"
    print(f"{o.output}: {registered}; contact_sheet.png, cameras.png{' (made before)' if made.made_before else ''}")


def _capture_rig(options: Options, folder: Path, device: str) -> None:
    """Make a data set from the videos of a rig."""
    from scgs_warp.capture import RigRequest, capture_rig
    from scgs_warp.errors import UserError

    o = options
    for name in ("keep_static", "keep_moving"):
        if getattr(o, name) != "on":
            raise UserError(f"--{name.replace('_', '-')}: is for one camera, not for --rig; leave it out")
    film = (folder, o.frames, o.start, o.end, o.offsets, o.size)
    request = RigRequest(*film, o.lens, o.camera_model, o.fov, o.features, o.least, o.held_out, o.seed)
    made = capture_rig(request, o.output, device=device)
    print("\n".join(made.lines))
    found = f"{len(made.registered)} of {len(made.names)} cameras, {made.held_out} held out"
    print(f"{o.output}: {found}{' (made before)' if made.made_before else ''}")


def cli(args: list[str] | None = None) -> int:
    return run(main, args)


def _import_scene(options: Options, path: Path) -> str:
    """Make a data set from the cameras of another program; return the further options that training needs."""
    from scgs_warp.capture import import_scene
    from scgs_warp.capture.imports import TOLERATED
    from scgs_warp.errors import UserError

    for field in fields(options):
        if field.name not in ("output", "poses", "device", "threads") and getattr(options, field.name) != field.default:
            raise UserError(f"--{field.name.replace('_', '-')}: is for films, not for --poses; leave it out")
    made = import_scene(path, options.output)
    points = f"{made.points:,} points from its depth" if made.points else "no depth that could give points"
    print(f"{options.output}: {made.frames} frames of {made.program}; {points}")
    if made.note is not None:
        print(f"note: {made.note}")
    if made.pose_error is None or made.pose_error <= TOLERATED:
        return ""
    print(f"note: the poses differ from the images by {made.pose_error:.1f} pixels; training should correct them")
    return " --set optim.cameras=2e-4"


if __name__ == "__main__":
    sys.exit(cli())
