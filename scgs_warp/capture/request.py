"""What is asked of a capture: its source and settings, checked."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from ..errors import UserError
from .features import CameraModel, Matching
from .limits import check_limits
from .writing import Keep

MIN_FRAMES = 6
"""Smallest number of frames for a capture."""


@dataclass(frozen=True)
class CaptureRequest:
    """Settings of a capture."""

    source: Path
    """A video, or a folder of images."""
    frames: int | None = None
    """Largest number of frames; None: ``VIDEO_FRAMES`` for a video, all images for a folder."""
    start: float | None = None
    end: float | None = None
    """End of the part of the video to use, seconds; ``start`` is its beginning."""
    size: int = 1280
    """Largest size of the longer side of the images, pixels."""
    masks: str = "auto"
    """``auto``: masks of independently moving pixels; ``none``: no masks; anything else: a path of masks."""
    matching: Matching = "auto"
    camera_model: CameraModel = "SIMPLE_RADIAL"
    fov: float | None = None
    """Horizontal field of view, degrees; None if unknown."""
    features: int = 4096
    """Largest number of features per frame."""
    least: float = 0.5
    """Smallest share of the frames that must get a camera."""
    seed: int = 0
    keep: Keep = "all"
    """What the data set shows. ``moving`` needs given masks."""


def check(request: CaptureRequest) -> None:
    """Check the values of a request.

    Raises:
        UserError: naming the option, its value and the remedy.
    """
    if request.frames is not None and request.frames < MIN_FRAMES:
        raise UserError(f"--frames {request.frames}: give at least {MIN_FRAMES}")
    check_limits(request)
    start, end = request.start or 0.0, math.inf if request.end is None else request.end
    if not 0.0 <= start < end:
        raise UserError(f"--start {start:g} --end {end:g}: give two seconds of the video, the earlier one as --start")
    if not request.masks.strip():
        raise UserError("--masks: is followed by an empty name; give auto, none, a folder or a video")
    if request.masks not in ("auto", "none") and not Path(request.masks).exists():
        raise UserError(f"--masks {request.masks}: no such file or folder; give auto, none, or masks")
    if request.keep == "moving" and request.masks in ("auto", "none"):
        raise UserError(
            "--keep-static off: needs masks of the whole mover, black where it is; give --masks DIR or --masks "
            "FILE.mp4 (masks that are found cover only a part of it)"
        )
    if request.keep == "static" and request.masks == "none":
        raise UserError("--keep-moving off: needs masks; leave out --masks none, or give --masks DIR")
