"""Make a data set from a video: ``python apps/capture.py film.mp4 --output data/film``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from scgs_warp.apps.arguments import parse
from scgs_warp.apps.cli import Device, prepare, run


@dataclass(frozen=True)
class Options:
    """Find the cameras of a video; write frames, cameras, times and points to a folder for train.py --data."""

    video: tyro.conf.Positional[Path]
    """Video, or folder of images from one camera."""
    output: Path
    """Folder to make. The same command continues an interrupted one; finished work is never overwritten."""
    frames: int | None = None
    """Largest number of frames to pick: the sharpest, spread over time and motion. By default 150 of a video and all of
    a folder."""
    start: float | None = None
    """Second of the video to begin at."""
    end: float | None = None
    """Second of the video to end at."""
    size: int = 1280
    """Longer side of the images in pixels; smaller ones are not enlarged."""
    masks: str = "auto"
    """Masks of image regions to ignore when finding the cameras. auto: moving regions are detected; none: nothing is
    ignored; otherwise a folder or video of masks, black where something moves."""
    matching: Literal["auto", "sequential", "exhaustive"] = "auto"
    """Frames to compare. sequential: neighbours in time; exhaustive: each with each; auto: depends on their number."""
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
    """Smallest share of the frames whose cameras must be found; with fewer the command fails and says what to do."""
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

    from scgs_warp.capture import CaptureRequest, capture
    from scgs_warp.runtime import environment

    cv2.setNumThreads(environment.thread_count())
    o = options
    film = (o.video, o.frames, o.start, o.end, o.size, o.masks)
    request = CaptureRequest(*film, o.matching, o.camera_model, o.fov, o.features, o.least, o.seed)
    made = capture(request, o.output, device=device)
    print("\n".join(made.lines))
    registered = f"{made.outcome.registered} of {made.outcome.picked} frames have a camera"
    print(f"{o.output}: {registered}; contact_sheet.png, cameras.png{' (made before)' if made.made_before else ''}")
    print(f"next: python apps/train.py --data {o.output}")


def cli(args: list[str] | None = None) -> int:
    return run(main, args)


if __name__ == "__main__":
    sys.exit(cli())
