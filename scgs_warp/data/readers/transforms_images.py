"""Files of the images that ``transforms*.json`` names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from ...errors import UserError
from ...storage.safe_paths import first_there, inside
from ..moved_images import Move, find_move, parts_of
from .colmap_images import reduced_folders
from .transforms import IMAGE_SUFFIXES, find_mask

RARE = (".tif", ".tiff", ".bmp", ".exr")
"""Suffixes of images that few data sets have; the decoder says which of them it does not read."""
FOREGROUND = "fg_mask_path"
"""Field of a frame that names the mask of its foreground, as GaussianAvatars' data of NeRSemble's heads have."""


class FrameFiles(NamedTuple):
    files: list[Path]
    """File of each frame's image; it need not exist."""
    entries: list[dict[str, Any]]
    """Entries of ``frames``; names of masks and depth maps have moved with the images."""
    notes: tuple[str, ...]
    """Lines that the user should read."""


def find_images(path: Path, folder: Path, entries: list[dict[str, Any]]) -> FrameFiles:
    """Find the frames' images. If none is where it should be, as after a move to another machine, they are looked for
    below ``folder`` (:func:`find_move`).

    Raises:
        UserError: a name is no text, or leads out of the folder.
    """
    names: list[str] = []
    for index, entry in enumerate(entries):
        name = entry.get("file_path")
        if not isinstance(name, str) or not name:
            raise UserError(f"{path}: frames[{index}].file_path is missing or not text; name the image file")
        names.append(name)
    if not any(_existing(folder, name) for name in names):
        moved = _moved(path, folder, entries)
        if moved is not None:
            return moved
    files = [_find_image(path, folder, index, name) for index, name in enumerate(names)]
    return FrameFiles(files, entries, _other_suffixes(path, names, files))


def films_of(
    folder: Path, entries: list[dict[str, Any]], others: Sequence[dict[str, Any]] = ()
) -> list[dict[str, Any]]:
    """Return a frame for each image of a rig's films, if files list no more than the cameras, as DiVa-360's do: one
    image of each, all of one name and without a time, in folders that hold more. Their times are the numbers in the
    names of the images. Other frames are returned as they are.

    Args:
        others: frames of another file, with other cameras of the rig.
    """
    every = [PurePosixPath(str(entry.get("file_path")).replace("\\", "/")) for entry in (*entries, *others)]
    alike = len({path.name for path in every}) == 1 < len({path.parent for path in every}) == len(every)
    timed = any(entry.get("time") is not None for entry in (*entries, *others))
    if timed or not alike or not every[0].stem.isdecimal():
        return entries
    shown: list[dict[str, Any]] = []
    for path, entry in zip(every, entries):
        place = _existing(folder, str(path))
        files = [] if place is None else [file for file in place.parent.iterdir() if file.suffix == place.suffix]
        numbered = sorted((int(file.stem), file.name) for file in files if file.stem.isdecimal())
        for time, name in numbered or [(int(path.stem), path.name)]:
            shown.append({**entry, "file_path": str(path.parent / name), "time": time})
    return shown if len(shown) > len(entries) else entries


def _moved(path: Path, folder: Path, entries: list[dict[str, Any]]) -> FrameFiles | None:
    """Return the images that are at another place than their names say; None without them."""
    names = [entry["file_path"] for entry in entries]
    moved = find_move(names, lambda name: _existing(folder, name), [each.name for each in reduced_folders(folder)])
    if moved is None:
        return None
    move, found = moved
    expected = [file or folder / (move.of(name) or "images") for file, name in zip(found, names)]
    first = next(index for index, file in enumerate(found) if file is not None)
    line = f"{path}: {names[first][:60]!r} is not there; images are taken from {expected[first].parent}"
    return FrameFiles(expected, [_with_moved_maps(entry, move) for entry in entries], (line,))


def _with_moved_maps(entry: dict[str, Any], move: Move) -> dict[str, Any]:
    """Drop from the names of a frame's mask and depth map the folders that its image's name has lost."""
    lost, moved = parts_of(entry["file_path"])[: move.dropped], dict(entry)
    for key in ("mask_path", FOREGROUND, "depth_file_path", "depth_path"):
        if isinstance(entry.get(key), str) and parts_of(entry[key])[: move.dropped] == lost:
            moved[key] = "/".join(parts_of(entry[key])[move.dropped :])
    return moved


def _find_image(path: Path, folder: Path, index: int, name: str) -> Path:
    """Find the frame's image file; complete a name that lacks its suffix."""
    where = f"{path}: frames[{index}].file_path"
    if is_foreign(name):
        raise UserError(f"{where} is {name[:60]!r}, a path of another machine; write it relative to {folder}")
    return _completed(inside(folder, name, where, "image"))


def _existing(folder: Path, name: str) -> Path | None:
    """Return the image of a name below ``folder``; None if there is none."""
    try:
        file = _completed(inside(folder, name, ""))
    except UserError:
        return None
    return file if file.is_file() else None


def _completed(base: Path) -> Path:
    if base.suffix.lower() in IMAGE_SUFFIXES:
        candidates = [base, *(base.with_suffix(suffix) for suffix in IMAGE_SUFFIXES)]
    else:
        candidates = [base.with_name(base.name + suffix) for suffix in (*IMAGE_SUFFIXES, *RARE)]
    return base if base.is_file() else first_there(candidates) or candidates[0]


def _other_suffixes(path: Path, names: list[str], files: list[Path]) -> tuple[str, ...]:
    """Return a note if images have other suffixes than their names, as after a conversion."""
    pairs = [(PurePosixPath(name.replace("\\", "/")), file) for name, file in zip(names, files)]
    other = [
        f"{file.name} for {name.name}"
        for name, file in pairs
        if name.suffix.lower() in IMAGE_SUFFIXES and name.suffix.lower() != file.suffix.lower()
    ]
    return (f"{path}: images of other names than listed are used, such as {other[0]}",) if other else ()


def find_foregrounds(
    path: Path, folder: Path, entries: list[dict[str, Any]], indices: Sequence[int]
) -> list[Path | None]:
    """Return the masks that cut frames out, white on the foreground; None for each frame unless all have one."""
    masks = [find_mask(path, folder, index, entries[index], FOREGROUND) for index in indices]
    return masks if all(mask is not None and mask.is_file() for mask in masks) else [None] * len(masks)


def is_foreign(name: str) -> bool:
    """Return whether a name is an absolute path of Windows, or one that does not exist here."""
    return re.match(r"[A-Za-z]:[/\\]", name) is not None or (name.startswith("/") and not Path(name).exists())
