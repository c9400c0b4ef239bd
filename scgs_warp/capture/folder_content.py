"""What folders hold instead of images, or beside them: films, folders, and photographs in formats that are not read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from ..data.natural_order import natural
from ..data.unknown import VIDEOS
from ..errors import UserError
from ..storage import heif_files

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
"""Suffixes of images that OpenCV reads."""
UNREAD = (".avif", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
"""Suffixes of photographs in formats of phones and cameras that are not read; HEIF is if pillow-heif is there."""
FEWEST_IMAGES = 6
"""Smallest number of images that can be meant where there is a film as well."""
MOST_FOLDERS = 200
"""Number of folders in which images are looked for."""


def is_shown(file: Path) -> bool:
    """Return whether a file is none that systems hide: ``._1.png``, which macOS puts beside each file on disks of other
    systems, and ``.trashed-1.jpg``, which Android keeps for a while."""
    return not file.name.startswith(".")


def files_in(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """Return the files that are not hidden and have one of the suffixes, in the natural order of their names."""
    found = [file for file in folder.iterdir() if file.suffix.lower() in suffixes and is_shown(file) and file.is_file()]
    return sorted(found, key=lambda file: natural(file.name))


def read_suffixes() -> tuple[str, ...]:
    """Return the suffixes of images that are read here."""
    return (*SUFFIXES, *heif_files.SUFFIXES) if heif_files.reads_heif() else SUFFIXES


def _without_doubles(files: list[Path]) -> list[Path]:
    """Leave out photographs in HEIF of which there is another image."""
    others = {file.stem for file in files if not heif_files.is_heif(file)}
    return [file for file in files if file.stem not in others or not heif_files.is_heif(file)]


def _unread_in(folder: Path) -> list[Path]:
    return files_in(folder, UNREAD if heif_files.reads_heif() else (*heif_files.SUFFIXES, *UNREAD))


def images_in(folder: Path) -> list[Path]:
    """Return the images of a folder.

    Raises:
        UserError: it holds none; the message names what it holds instead.
    """
    files, films = _without_doubles(files_in(folder, read_suffixes())), files_in(folder, VIDEOS)
    if files and (len(files) >= FEWEST_IMAGES or not films):  # A film may have a picture of itself beside it.
        return files
    unread = _unread_in(folder)
    below = next((inner for inner in folders_in(folder) if files_in(inner, read_suffixes())), None)
    if unread and (len(unread) >= FEWEST_IMAGES or not films):
        raise UserError(f"{folder}: holds {_counted(unread)}, which cannot be read; {_remedy(unread)}")
    if films:
        more = f", or --rig {folder} for films of one rig" if len(films) > 1 else ""
        raise UserError(f"{folder}: holds {len(files) or 'no'} images, but {films[0].name}; give {films[0]}{more}")
    if below is not None:
        raise UserError(f"{folder}: holds no images, but {below.name} does; give {below}")
    raise UserError(f"{folder}: holds no images ({', '.join(read_suffixes())}); give the folder that does, or a video")


def photographs_left_out(folder: Path) -> list[str]:
    """Name the photographs of a folder that are left out, because their formats are not read; those of which there is
    an image as well do not count."""
    images = {file.stem for file in files_in(folder, read_suffixes())}
    unread = [file for file in _unread_in(folder) if file.stem not in images]
    return [f"note: {folder}: {_counted(unread)} are left out; {_remedy(unread)}"] if unread else []


def folders_in(folder: Path) -> list[Path]:
    """Return the folders in a folder that are not hidden, in the natural order of their names, unless they are many."""
    found = [inner for inner in folder.iterdir() if is_shown(inner) and inner.is_dir()]
    return sorted(found, key=lambda inner: natural(inner.name))[:MOST_FOLDERS]


def _remedy(unread: Sequence[Path]) -> str:
    return "save them as JPEG" + (f", or {heif_files.COMMAND}" if any(map(heif_files.is_heif, unread)) else "")


def _counted(files: Sequence[Path]) -> str:
    kinds = Counter(file.suffix.lower() for file in files)
    return f"{len(files)} photographs in other formats ({', '.join(kinds)})"
