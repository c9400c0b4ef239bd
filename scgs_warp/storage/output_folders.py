"""Output folders, which are checked before work begins and replaced as a whole after it."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

from ..errors import UserError
from .files import hidden_beside, new_beside

OF_RUNS = (
    "config.json",
    "checkpoint.safetensors",
    "checkpoint.previous.safetensors",
    "log.jsonl",
    "skeleton.json",
)
"""Files of a run folder that training or an editing user made, and nothing can make again."""
OF_SYSTEMS = (".DS_Store", "Thumbs.db", "desktop.ini", ".directory")
ATTEMPTS = 5
"""Number of attempts to replace a folder that other processes replace at the same time."""


def make_parent(path: Path) -> None:
    """Make the parent folder of ``path``.

    Raises:
        UserError: it cannot be made, or is not writable.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK | os.X_OK):
            raise PermissionError(13, "Permission denied")
    except OSError as error:
        raise UserError(f"{path.parent}: cannot be written ({error.strerror}); give another output folder") from None


def refuse_inputs(path: Path, inputs: Iterable[Path | None], run: Path | None = None, option: str = "--output") -> None:
    """Refuse to write over what the program reads, or over what a run cannot be opened or continued without.

    Args:
        inputs: files that are read; None stands for one that is not given.
        run: folder of the run, or None.

    Raises:
        UserError: ``path`` is one of these.
    """
    of_run = [] if run is None else [run / name for name in OF_RUNS]
    for given in filter(None, [*inputs, *of_run]):
        with suppress(OSError):  # one of the two does not exist
            if path.samefile(given):
                why = "the run needs it" if given in of_run else "it is read"
                raise UserError(f"{option} {path}: would be overwritten, and {why}; give another name")


def paths_in(folder: Path) -> list[Path]:
    """List what is in a folder, without what file managers put into every folder that they show."""
    return [path for path in folder.iterdir() if path.name not in OF_SYSTEMS and not path.name.startswith("._")]


def holds_only(folder: Path, pattern: str) -> bool:
    """Return whether a folder may be replaced: all names in it that ``paths_in`` lists match a regular
    expression."""
    return all(re.fullmatch(pattern, path.name) for path in paths_in(folder))


def check_replaceable(path: Path, pattern: str, held: str) -> Path:
    """Check that a folder may be replaced as a whole, or made, and return it with links followed: what a link leads to
    is replaced, not the link.

    Args:
        pattern: regular expression of the names that it may hold.
        held: what these are, for the message.

    Raises:
        UserError: it is the current folder or contains it, or it holds other files.
    """
    folder = Path(os.path.realpath(path))
    if Path.cwd().is_relative_to(folder):
        raise UserError(f"{path}: is the current folder or contains it; name a new folder")
    if folder.is_dir() and not holds_only(folder, pattern):
        raise UserError(f"{path}: holds other files than {held}; name a new folder")
    return folder


def write_folder_atomically(folder: Path, write: Callable[[Path], None]) -> None:
    """Let ``write`` fill a temporary folder next to ``folder``, then rename it, so that an incomplete folder never
    remains. A link stays one: the folder that it leads to is written.

    Raises:
        UserError: the folder cannot be written, or is the current one or contains it.
    """
    folder = Path(os.path.realpath(folder))
    if Path.cwd().is_relative_to(folder):
        raise UserError(f"{folder}: is the current folder or contains it; name a new folder")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{folder}: cannot be made ({error.strerror}); choose a folder that can be written") from None
    try:
        with new_beside(folder, folder=True) as work:
            write(work)
            replace_folder(folder, work)
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror}); make room or choose another folder") from None


def replace_folder(path: Path, new: Path) -> None:
    """Replace the folder ``path`` by the folder ``new``, and remove the earlier one afterwards.

    If several processes replace one folder, the last one wins.

    Raises:
        OSError: replacing failed; the earlier folder is back in its place.
    """
    for attempt in range(1, ATTEMPTS + 1):
        try:
            return _replace(path, new, hidden_beside(path, f"{os.getpid()}.old"))
        except OSError as error:  # Another process put its folder there, or took the earlier one away.
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOENT) or attempt == ATTEMPTS:
                raise


def _replace(path: Path, new: Path, old: Path) -> None:
    if not path.is_dir():
        os.replace(new, path)
        return
    os.replace(path, old)
    try:
        os.replace(new, path)
    except BaseException:
        if path.is_dir():
            shutil.rmtree(old, ignore_errors=True)  # What another process put there has replaced it.
        else:
            os.replace(old, path)
        raise
    shutil.rmtree(old, ignore_errors=True)
