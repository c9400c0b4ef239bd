"""What is asked of a rig's capture: its videos and settings, checked."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

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
    """Folder with one video per camera, or with one folder per camera that holds its video."""
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


def videos_of(folder: Path) -> dict[str, Path]:
    """Return the videos of a rig by the names of their cameras, in the natural order of these: the files in the folder,
    or the only file in each of its folders, whose name is then that of the camera.

    Raises:
        UserError: there are too few, or a camera has several.
    """
    if not folder.is_dir():
        raise UserError(f"--rig {folder}: no such folder; give the folder that holds one video per camera")
    files = files_in(folder, FILMS)
    inner = {path.name: files_in(path, FILMS) for path in folders_in(folder)} if len(files) < FEWEST_CAMERAS else {}
    inner = {name: own for name, own in inner.items() if own}
    if len(inner) >= FEWEST_CAMERAS:
        return _only_ones(folder, inner, files)
    if len(files) < FEWEST_CAMERAS:
        raise UserError(f"--rig {folder}: {_too_few(folder, files, inner)}")
    stems = [path.stem for path in files]
    twice = next((name for name in stems if stems.count(name) > 1), None)
    if twice is not None:
        raise UserError(f"--rig {folder}: two videos are called {twice}; give each camera its own name")
    return dict(zip(stems, files))


def _only_ones(folder: Path, inner: dict[str, list[Path]], beside: list[Path]) -> dict[str, Path]:
    """Return the only video of each camera's folder."""
    if beside:
        raise UserError(
            f"--rig {folder}: holds {beside[0].name} beside folders of videos ({', '.join(inner)}); give it a folder "
            "of its own if it is that of a camera, or take it out"
        )
    several = next((name for name, own in inner.items() if len(own) > 1), None)
    if several is not None:
        raise UserError(
            f"--rig {folder}: the folder {several} holds {len(inner[several])} videos ({inner[several][0].name}, "
            f"{inner[several][1].name}); leave one in the folder of each camera: join the parts of a recording"
        )
    return {name: own[0] for name, own in inner.items()}


def _too_few(folder: Path, files: list[Path], inner: dict[str, list[Path]]) -> str:
    """Say what is in a folder instead of the videos of a rig, and what to do."""
    of_images = [path.name for path in folders_in(folder) if files_in(path, read_suffixes())]
    if not inner and len(of_images) >= FEWEST_CAMERAS:
        return (
            f"holds folders of images ({of_images[0]} to {of_images[-1]}); make a video of each, all with one frame "
            "rate, and give --offsets 0 if they began at once"
        )
    below = next((name for name, own in inner.items() if len(own) >= FEWEST_CAMERAS), None)
    if below is not None:
        return f"holds {len(files)} videos, but {below} does; give --rig {folder / below}"
    return (
        f"holds {len(files) + len(inner)} videos ({', '.join(FILMS)}); give one video per camera, or one folder per "
        f"camera with its video, for at least {FEWEST_CAMERAS} cameras"
    )


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
