"""Zip archives that phone apps export: Record3D's ``.r3d``, and the ``.zip`` of Polycam and 3D Scanner App."""

from __future__ import annotations

import os
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ...errors import UserError
from ...runtime.progress import ShowProgress
from ...storage.output_folders import make_parent

ZIPPED = (".zip", ".r3d")
PACKED = (".tar", ".gz", ".tgz", ".bz2", ".xz", ".7z", ".rar", ".zst")
"""Suffixes of archives that are not unpacked."""
MOST_FILES = 1_000_000
LEAST_FREE = 1 << 30
"""Bytes of the disk that unpacking leaves free."""
BLOCK = 1 << 20
ENCRYPTED = 0x1
"""Bit of a member's flags."""


@contextmanager
def unpacked(path: Path, folder: Path, show: ShowProgress) -> Iterator[Path]:
    """Yield the folder to import: ``path`` itself, or what a zip archive holds, unpacked beside ``folder`` until the
    context ends.

    Raises:
        UserError: the archive is damaged, encrypted, of another format, or larger than the disk has room for.
    """
    suffix = path.suffix.lower()
    if path.is_file() and suffix in PACKED:
        raise UserError(f"--poses {path}: is an archive; unpack it, and give the folder")
    if not (path.is_file() and suffix in ZIPPED):
        yield path
        return
    make_parent(folder)
    prefix = f".{folder.name}-unpacked-"
    with tempfile.TemporaryDirectory(prefix=prefix, dir=folder.parent, ignore_cleanup_errors=True) as name:
        work = Path(name)
        try:
            _unpack(path, work, show)
            yield _only_folder(work)
        except UserError as error:  # names files by their places in the archive
            raise UserError(str(error).replace(str(work), str(path))) from None


def _unpack(path: Path, work: Path, show: ShowProgress) -> None:
    try:
        with zipfile.ZipFile(path) as archive:
            members = [member for member in archive.infolist() if _is_wanted(member)]
            _check(path, members, shutil.disk_usage(work).free - LEAST_FREE)
            with show(len(members), f"unpacking {path.name}") as bar:
                for member in members:
                    _write(archive, member, work)
                    bar.advance()
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError):
        raise UserError(f"{path}: is no zip archive, or a damaged one; export or copy it again") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be unpacked ({error.strerror or 'damaged'}); export it again") from None


def _is_wanted(member: zipfile.ZipInfo) -> bool:
    """Return whether a member is a file that is not hidden."""
    parts = member.filename.split("/")
    return not member.is_dir() and "__MACOSX" not in parts and not parts[-1].startswith(".")


def _check(path: Path, members: list[zipfile.ZipInfo], room: int) -> None:
    if any(member.flag_bits & ENCRYPTED for member in members):
        raise UserError(f"{path}: is encrypted; export it without a password")
    size = sum(member.file_size for member in members)
    if len(members) > MOST_FILES or size > room:
        raise UserError(
            f"{path}: holds {len(members)} files of {size / 1e9:.1f} GB, and the disk of --output has room for "
            f"{max(room, 0) / 1e9:.1f} GB; free some, or choose another --output"
        )


def _write(archive: zipfile.ZipFile, member: zipfile.ZipInfo, work: Path) -> None:
    """Write a member below ``work``: a file that says it is smaller than it is ends at the size that it says.

    Raises:
        ValueError: its name leads out of the folder.
    """
    to = work.joinpath(*member.filename.replace("\\", "/").split("/"))
    if not to.resolve().is_relative_to(work.resolve()):
        raise ValueError(member.filename)
    to.parent.mkdir(parents=True, exist_ok=True)
    left = member.file_size
    with archive.open(member) as source, open(to, "xb") as target:
        while left > 0 and (block := source.read(min(BLOCK, left))):
            target.write(block)
            left -= len(block)


def _only_folder(work: Path) -> Path:
    """Return the folder that holds more than another folder: archives of a folder hold that alone."""
    while len(inside := list(os.scandir(work))) == 1 and inside[0].is_dir():
        work = Path(inside[0].path)
    return work
