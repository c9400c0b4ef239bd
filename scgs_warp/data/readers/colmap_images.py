"""Files of the images that a COLMAP model names: at full size, or those of a reduced folder, ``images_2`` and so on."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from ...errors import UserError
from ...storage.safe_paths import inside
from ..moved_images import find_move
from .transforms import IMAGE_SUFFIXES

REDUCED = re.compile(r"images_([1-9][0-9]{0,2})(_png)?")
"""Names of the folders of reduced images, as LLFF and Mip-NeRF 360 call them."""


class ImageFiles(NamedTuple):
    files: list[Path]
    """File of each name; it need not exist."""
    folder: Path
    reduced: bool
    """Whether the folder is one of reduced images."""
    notes: tuple[str, ...]
    """Lines that the user should read."""


def reduced_folders(folder: Path) -> list[Path]:
    """Return the folders of reduced images, those of the largest images first."""
    found = [(match, path) for path in folder.iterdir() if (match := REDUCED.fullmatch(path.name)) and path.is_dir()]
    return [path for match, path in sorted(found, key=lambda pair: (int(pair[0][1]), pair[1].name))]


def find_images(folder: Path, model_folder: Path, names: Sequence[str]) -> ImageFiles:
    """Find the images of a model by their names: in ``images``, in ``input`` or in the folder itself. If none of them
    is there, they are those of other folders or with the first folders of their names left out (:func:`find_move`), or
    those in the first folder of reduced images that has any.

    Raises:
        UserError: a name leads out of the folder.
    """
    places = [folder / "images", model_folder / "images", folder / "input"]
    base = next((place for place in places if place.is_dir()), folder)
    listed: dict[Path, dict[str, str]] = {}
    if not any(_existing(base, model_folder, name, listed) for name in names):
        moved = _moved(folder, model_folder, names) or _reduced(folder, model_folder, names)
        if moved is not None:
            return moved
    files = _named(base, model_folder, names, listed)
    return ImageFiles(files, base, False, _other_suffixes(base, files, names))


def _reduced(folder: Path, model_folder: Path, names: Sequence[str]) -> ImageFiles | None:
    """Return the images of the first folder of reduced ones that has any; None without them."""
    for reduced in reduced_folders(folder):
        smaller = _named(reduced, model_folder, names)
        if not any(file.is_file() for file in smaller):
            smaller = _in_order(reduced, names)
        if smaller:
            return ImageFiles(smaller, reduced, True, _other_suffixes(reduced, smaller, names))
    return None


def _moved(folder: Path, model_folder: Path, names: Sequence[str]) -> ImageFiles | None:
    """Return the images that are in another folder than the model says; None without them."""
    listed: dict[Path, dict[str, str]] = {}
    moved = find_move(names, lambda name: _existing(folder, model_folder, name, listed))
    if moved is None:
        return None
    move, found = moved
    files = [file or folder / (move.of(name) or "images") for file, name in zip(found, names)]
    base = folder / move.place
    name, file = next((name, file) for name, file in zip(names, found) if file is not None)
    line = f"{model_folder}: {name[:60]!r} is not there; images are taken from {file.parent}"
    return ImageFiles(files, base, False, (line, *_other_suffixes(base, files, names)))


def _existing(base: Path, model_folder: Path, name: str, listed: dict[Path, dict[str, str]]) -> Path | None:
    """Return the image of a name in a folder; None if there is none."""
    try:
        file = _named(base, model_folder, [name], listed)[0]
    except UserError:
        return None
    return file if file.is_file() else None


def _named(
    base: Path, model_folder: Path, names: Sequence[str], listed: dict[Path, dict[str, str]] | None = None
) -> list[Path]:
    """Return the file of each name. Without one of the very name, it is the one whose name differs only in upper and
    lower case, which Windows and macOS ignore, or else only in the suffix, as after a conversion.

    Args:
        listed: names in the folders that were read before, and those of further folders afterwards.
    """
    files = [inside(base, name, f"{model_folder}: the name of an image", "image") for name in names]
    listed = {} if listed is None else listed
    for index, file in enumerate(files):
        if not file.is_file():
            if file.parent not in listed:
                listed[file.parent] = _listing(file.parent)
            there, wanted = listed[file.parent], PurePosixPath(file.name.lower())
            found = there.get(wanted.name) or there.get(wanted.stem)
            files[index] = file.with_name(found) if found else file
    return files


def _listing(folder: Path) -> dict[str, str]:
    """Return the names of a folder's images by their names in lower case, with and without suffix."""
    try:
        names = sorted(name for name in os.listdir(folder) if name.lower().endswith(IMAGE_SUFFIXES))
    except OSError:
        return {}
    listing: dict[str, str] = {}
    for key in (str.lower, lambda name: PurePosixPath(name).stem.lower()):
        for name in names:
            listing.setdefault(key(name), name)
    return listing


def _in_order(folder: Path, names: Sequence[str]) -> list[Path]:
    """Return the files of a folder in the order of the names, which LLFF's reduced images (``image000.png``) keep; an
    empty list if there are more of them, or fewer."""
    files = sorted(
        folder / name for name in os.listdir(folder) if name.lower().endswith(IMAGE_SUFFIXES) and name[0] != "."
    )
    if len(files) != len(names):
        return []
    ordered = sorted(range(len(names)), key=lambda index: names[index])
    return [file for _, file in sorted(zip(ordered, files))]


def _other_suffixes(base: Path, files: Sequence[Path], names: Sequence[str]) -> tuple[str, ...]:
    """Return a note if files are not of the names that the model has, but for upper and lower case."""
    pairs = [(PurePosixPath(name.replace("\\", "/")).name, file) for name, file in zip(names, files) if file.is_file()]
    other = [(name, file.name) for name, file in pairs if name.lower() != file.name.lower()]
    if not other:
        return ()
    return (f"{base}: images of other names than in the model are used, such as {other[0][1]} for {other[0][0]}",)
