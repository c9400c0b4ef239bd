"""A moving scene as a folder of files of Gaussians, one per frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from ..errors import UserError
from ..formats.gaussian_files import write_gaussians
from ..storage.files import new_beside
from ..storage.output_folders import check_replaceable, make_parent, replace_folder
from ..types import Gaussians

NAME = "frame_{:05d}"
ENDINGS = {"ply-sequence": ".ply", "sog-sequence": ".sog"}
"""Suffix of the frames of each format."""


def check_folder(path: Path) -> Path:
    """Check that a sequence may replace a folder, as :func:`check_replaceable`."""
    return check_replaceable(path, r"frame_\d{5,}\.(ply|sog)", "a sequence's frames")


def write_sequence(
    path: Path,
    frames: Iterable[Gaussians],
    advance: Callable[[], None] | None = None,
    *,
    ending: str = ".ply",
    antialiased: bool = False,
) -> int:
    """Write activated Gaussians, world units, as ``frame_00000.ply`` and so on. An earlier sequence in the same folder
    is replaced as a whole once the new one is complete.

    Args:
        advance: called after each frame.
        ending: suffix of the frames, one of ``ENDINGS``.
        antialiased: whether the Gaussians were trained with the antialiasing compensation.

    Returns:
        Frame count.

    Raises:
        UserError: as :func:`check_replaceable`, or the folder cannot be written.
    """
    path = check_folder(path)
    make_parent(path)
    count = 0
    try:
        with new_beside(path, folder=True) as temporary:
            for gaussians in frames:
                write_gaussians(temporary / f"{NAME.format(count)}{ending}", gaussians, antialiased=antialiased)
                count += 1
                if advance is not None:
                    advance()
            check_folder(path)
            replace_folder(path, temporary)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror}); give another folder") from None
    return count
