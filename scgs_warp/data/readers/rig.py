"""Frames of a rig: cameras that stand still, and an image of each at every instant."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...errors import UserError
from ..assemble import FrameRecord, assemble
from ..choice import choose, held_camera, of_cameras
from ..dataset import Dataset
from ..images import ReadOptions, is_reduced, size_text
from ..lens import Lens, make_lens, rescaled
from ..name_times import times_from_names
from ..natural_order import natural
from .transforms import IMAGE_SUFFIXES

OFF_CENTRE = 0.8
"""Shares of width and height beyond which a principal point is that of larger images."""


class RigCamera(NamedTuple):
    """A camera that stands still."""

    name: str
    viewmat: np.ndarray
    """[4, 4] world-to-camera, OpenCV."""
    lens: Callable[[tuple[int, int]], Lens]
    """Function from the (width, height) of an image to its lens; raises UserError if the size does not fit."""
    files: dict[str, Path]
    """Images by the names of their instants, which are the same for all cameras."""
    masks: dict[str, Path] | None = None
    """Masks by the names of their instants, black on the background; None without any."""


def read_rig(
    path: Path,
    folder: Path,
    cameras: Sequence[RigCamera],
    split: str,
    options: ReadOptions,
    *,
    held: Collection[str] = (),
) -> Dataset:
    """Read one split: the cameras ``held`` or, if none of the chosen ones is among them, the one that is chosen first
    (of all, the first in the order of names) is ``test`` and ``val``; the others are ``train``. Times are those in the
    names of the instants.

    Args:
        path: file that lists the cameras, named in messages.

    Raises:
        UserError: the data is invalid; one line names the file, the field and the remedy.
    """
    filmed = sorted((camera for camera in cameras if camera.files), key=lambda camera: natural(camera.name))
    if len(filmed) < 2:
        raise UserError(
            f"{path}: images of {len(filmed)} of {len(cameras)} cameras are there, but two are needed; restore the "
            "others, or unpack their videos"
        )
    without = [camera.name for camera in cameras if not camera.files]
    lines = (
        [f"{path}: {len(without)} cameras without images are left out ({', '.join(without)[:60]})"] if without else []
    )
    chosen = [filmed[index] for index in of_cameras([camera.name for camera in filmed], options)]
    if len(chosen) < 2:
        raise UserError(f"--only-cameras {options.only_cameras}: name two cameras or more; one is held out")
    names = {camera.name for camera in chosen}
    first = held_camera([camera.name for camera in chosen], options)
    outside = (names & set(held)) or {first}
    if outside == names:
        outside = {first}
    cut_out, unmasked = _cut_out(folder, chosen)
    instants = sorted({instant for camera in filmed for instant in camera.files}, key=natural)
    times = dict(zip(instants, times_from_names(instants) if len(instants) > 1 else [0.0]))
    listed = [
        (camera, instant) for camera in chosen if (camera.name in outside) != (split == "train") for instant in instants
    ]
    files = [camera.files.get(instant, folder / camera.name / instant) for camera, instant in listed]
    choice = choose(path, files, [times[instant] for _, instant in listed], options)
    records = [
        FrameRecord(
            files[index],
            listed[index][0].viewmat,
            choice.times[index],
            listed[index][0].lens,
            f"{listed[index][0].name}_{listed[index][1]}",
            cut_out_by=(listed[index][0].masks or {}).get(listed[index][1]) if cut_out else None,
        )
        for index in choice.indices
    ]
    return assemble(records, options, folder=folder, split=split, notes=(*lines, *unmasked, *choice.notes))


def _cut_out(folder: Path, cameras: Sequence[RigCamera]) -> tuple[bool, list[str]]:
    """Return whether all images have masks that cut them out, and a note if only some have."""
    images = sum(len(camera.files) for camera in cameras)
    missing = sum(len(camera.files.keys() - (camera.masks or {}).keys()) for camera in cameras)
    if missing in (0, images):
        return missing == 0, []
    return False, [f"{folder}: {missing} of {images} images have no mask; no image is cut out"]


def images_in(folder: Path) -> dict[str, Path]:
    """Return the images in a folder by their names without suffix; none if there is no such folder."""
    if not folder.is_dir():
        return {}
    files = (
        file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES and not file.name.startswith(".")
    )
    return {file.stem: file for file in files}


def fitted_lens(where: str, lens: Lens, stated: tuple[int, int] | None, source: tuple[int, int]) -> Lens:
    """Return a lens at the size of an image, which is the one that the camera states or a reduced one.

    Args:
        where: file and camera, for messages.
        lens: at the size ``stated``, or of the image if the camera states none.

    Raises:
        UserError: the camera is of images of another size.
    """
    if stated is None or stated == source:
        if lens.cx > OFF_CENTRE * source[0] and lens.cy > OFF_CENTRE * source[1]:
            raise UserError(
                f"{where}: its principal point is ({lens.cx:g}, {lens.cy:g}), far from the centre of images of "
                f"{size_text(source)}; give the images that were calibrated"
            )
        return lens
    if not is_reduced(source, stated):
        raise UserError(
            f"{where}: is of {size_text(stated)}, but the images are {size_text(source)}; give the images that were "
            "calibrated, or reduced ones of the same proportions"
        )
    if not lens.params:
        lens = make_lens("PINHOLE", (lens.fx, lens.fy, lens.cx, lens.cy))
    return rescaled(lens, stated, source)
