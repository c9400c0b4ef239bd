"""What is asked of a rig's capture: its videos and settings, checked."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ...data.natural_order import natural
from ...data.unknown import FILMS
from ...errors import UserError
from ..features import CameraModel
from ..folder_content import files_in, folders_in, read_suffixes
from ..limits import check_limits

FEWEST_CAMERAS = 2


@dataclass(frozen=True)
class RigRequest:
    """Settings of a rig's capture."""

    folder: Path
    """Folder with one video per camera."""
    frames: int | None = None
    """Number of instants; None: at most ``instants.RIG_INSTANTS``."""
    start: float | None = None
    end: float | None = None
    """Part of the common time to use, in seconds from the moment at which all cameras record."""
    offsets: tuple[float, ...] | None = None
    """Seconds at which the videos begin, in the order of their names, or one number for all; None: found by sound."""
    size: int = 1280
    """Largest size of the longer side of the images, pixels."""
    lens: Literal["auto", "shared", "each"] = "auto"
    """``shared``: one lens for all cameras; ``each``: its own for each; ``auto``: shared if sizes are equal,
    unless lenses of their own fit clearly better."""
    camera_model: CameraModel = "SIMPLE_RADIAL"
    fov: float | None = None
    """Horizontal field of view, degrees; None if unknown."""
    features: int = 4096
    least: float = 0.5
    """Smallest share of the cameras that must be found."""
    held_out: str | None = None
    """Name of the camera that is held out; None: the first."""
    seed: int = 0


def videos_of(folder: Path) -> list[Path]:
    """Return the videos of a rig, in the natural order of their names.

    Raises:
        UserError: there are too few.
    """
    if not folder.is_dir():
        raise UserError(f"--rig {folder}: no such folder; give the folder that holds one video per camera")
    found = [path for path in folder.iterdir() if path.suffix.lower() in FILMS and path.is_file()]
    files = sorted((path for path in found if not path.name.startswith(".")), key=lambda path: natural(path.name))
    if len(files) < FEWEST_CAMERAS:
        of_images = [inner.name for inner in folders_in(folder) if files_in(inner, read_suffixes())]
        if len(of_images) >= FEWEST_CAMERAS:
            raise UserError(
                f"--rig {folder}: holds folders of images ({of_images[0]} to {of_images[-1]}); make a video of each, "
                "all with one frame rate, and give --offsets 0 if they began at once"
            )
        raise UserError(
            f"--rig {folder}: holds {len(files)} videos ({', '.join(FILMS)}); give one video per camera, at "
            f"least {FEWEST_CAMERAS}"
        )
    stems = [path.stem for path in files]
    twice = next((name for name in stems if stems.count(name) > 1), None)
    if twice is not None:
        raise UserError(f"--rig {folder}: two videos are called {twice}; give each camera its own name")
    return files


def check(request: RigRequest, names: list[str]) -> None:
    """Check the values of a request.

    Raises:
        UserError: naming the option, its value and the remedy.
    """
    if request.frames is not None and request.frames < 6:
        raise UserError(f"--frames {request.frames}: give at least 6")
    check_limits(request)
    begin, end = request.start or 0.0, math.inf if request.end is None else request.end
    if not 0.0 <= begin < end:
        raise UserError(f"--start {begin:g} --end {end:g}: give two seconds of the common time, the earlier one first")
    if request.offsets is not None:
        if len(request.offsets) not in (1, len(names)):
            raise UserError(
                f"--offsets: {len(request.offsets)} numbers for {len(names)} videos ({', '.join(names)}); give one for "
                "each, or a single 0 if all begin at once"
            )
        if not all(math.isfinite(value) and abs(value) < 1e6 for value in request.offsets):
            raise UserError("--offsets: give seconds")
    if request.held_out is not None and request.held_out not in names:
        raise UserError(f"--held-out {request.held_out}: the cameras are {', '.join(names)}; name one of them")
