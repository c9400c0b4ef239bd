"""Automatic saving of an edit and of the selection: after every change. Both are restored when the editor starts
again."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from ..edit import Edit, EditSession, edit_file
from ..errors import UserError, one_line
from ..runtime import addresses
from ..storage.files import read_text, write_atomically
from ..storage.locks import AlreadyLocked, lock_file
from ..storage.own_folder import own_folder
from .files import unused_path

NAME = "autosave"
AGAIN = 5.0
"""Seconds after which it is tried again to save what could not be saved."""
MAX_CHOICE = 4 << 20
"""Largest size of the file that says what is chosen."""
PREVIOUS = "previous"
"""Suffix of the edit that a new one has replaced."""
DAMAGED = "damaged"
"""Suffix of a saved edit that could not be read."""


def folder_for(source: Path, chosen: Path | None = None) -> Path:
    """Make and return the folder of edits: the chosen one, else ``edits/`` in a run or beside a file, else
    ``own_folder``.

    Raises:
        UserError: the chosen folder, or every other one, cannot be written.
    """
    usual = source / "edits" if source.is_dir() else source.parent / "edits"
    candidates = [chosen] if chosen is not None else [usual, own_folder("edits", source)]
    problem: OSError | None = None
    for folder in candidates:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            probe = folder / f".{NAME}.probe"
            probe.write_bytes(b"")
            probe.unlink()
        except OSError as error:
            problem = error
            continue
        return folder
    why = "" if problem is None else f" ({problem.strerror})"
    raise UserError(f"{candidates[-1]}: cannot be written{why}; give another --folder")


class Autosave:
    """Keeper of one session's edit in a file, which no other editor may keep at the same time.

    Args:
        session: session whose edit is kept.
        folder: folder of edits, which exists.
        stem: name of the run or file, which tells its edits from those of other files beside it; "" for a run.

    Attributes: ``path`` (the file), ``choice`` (what is chosen; at first what was when the editor ended, None: not
    known), ``said`` (what to tell the user at the start; may be empty), ``problem`` (why the latest change could not be
    saved; None if it was).

    Raises:
        UserError: another editor keeps this edit.
    """

    def __init__(self, session: EditSession, folder: Path, stem: str = "") -> None:
        self._session = session
        self.path = folder / (f"{stem}.{NAME}.json" if stem else f"{NAME}.json")
        try:
            self._lock: int | None = lock_file(folder / f".{self.path.name}.lock")
        except AlreadyLocked:
            raise UserError(
                f"{self.path}: another editor is open on this scene; end it, or give another --folder"
            ) from None
        except OSError as error:
            raise UserError(f"{folder}: cannot be written ({error.strerror}); give another --folder") from None
        self._choice_path = self.path.with_name(f".{self.path.stem}.choice.json")
        self.choice: str | None = None
        self._wanted_choice: str | None = None
        self.said = ""
        self.done: Callable[[], None] = lambda: None
        """Called on another thread after each attempt to save."""
        self.problem: str | None = None
        self._saved: Edit | None = None
        self._wanted: Edit | None = None
        self._failed: Edit | None = None
        """Edit that could not be saved, which is tried again."""
        self._writing = False
        self._condition = threading.Condition()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="autosave", daemon=True)

    def start(self, *, restore: bool) -> None:
        """Restore the edit that was kept, as a step that can be undone, and begin to keep changes.

        Args:
            restore: False: begin with the session's present edit; the one that was kept moves aside.
        """
        if restore:
            with suppress(OSError, ValueError, UserError):
                self.choice = read_text(self._choice_path, MAX_CHOICE)
        moved = None
        if self.path.is_file():
            if restore:
                self._restore()
            else:
                moved = self._move_aside(PREVIOUS)
        self._saved = self._session.edit if self.said else Edit()
        if moved is not None:
            self.said = f"the edit that was kept is now {moved.name}"
        addresses.start(self._thread)
        self.note(self._session.edit)

    def _restore(self) -> None:
        try:
            self._session.load(self.path)
        except UserError as error:
            aside = self._move_aside(DAMAGED)
            self.said = f"the edit that was kept cannot be used: {one_line(error)}; it is now {aside.name}"
            return
        self.said = f"restored the edit that was kept in {self.path.name}; undo returns to the unedited scene"

    def _move_aside(self, suffix: str) -> Path:
        """Move the kept edit to a name that no other edit has."""
        aside = unused_path(self.path.with_name(f"{self.path.stem}.{suffix}.json"))
        with suppress(OSError):
            os.replace(self.path, aside)
        return aside

    def note(self, edit: Edit, choice: str | None = None) -> None:
        """Save an edit soon, and what is chosen; later ones replace them while they wait."""
        with self._condition:
            self._wanted = edit
            if choice is not None and choice != self.choice:
                self.choice = self._wanted_choice = choice
            self._condition.notify_all()

    def saved(self, edit: Edit) -> bool:
        """Return whether an edit is what the file holds."""
        with self._condition:
            return edit == self._saved and self.problem is None

    def _run(self) -> None:
        while True:
            with self._condition:
                while not self._due() and self._wanted_choice is None:
                    if self._stopped:
                        return
                    if not self._condition.wait(None if self.problem is None else AGAIN) and self._wanted is None:
                        self._wanted = self._failed
                edit = self._wanted if self._due() else None
                self._wanted = None
                choice, self._wanted_choice = self._wanted_choice, None
                self._writing = True
            problem = self.problem if edit is None else self._write(edit)
            if choice is not None:
                with suppress(UserError):  # the edit has the same problem, and its is shown
                    write_atomically(self._choice_path, choice.encode())
            with self._condition:
                self.problem, self._writing = problem, False
                if edit is not None:
                    self._failed = edit if problem else None
                    self._saved = self._saved if problem else edit
                self._condition.notify_all()
            if edit is not None:
                self.done()

    def _due(self) -> bool:
        return self._wanted is not None and (self._wanted != self._saved or self.problem is not None)

    def _write(self, edit: Edit) -> str | None:
        try:
            write_atomically(self.path, edit_file.to_json(edit, self._session.engine).encode())
        except UserError as error:
            return one_line(error)
        return None

    def flush(self, seconds: float = 10.0) -> bool:
        """Wait until everything is saved; return whether it is."""
        with self._condition:
            self._condition.wait_for(
                lambda: not self._writing and not self._due() and self._wanted_choice is None, seconds
            )
            return self.problem is None

    def stop(self) -> None:
        """Save the session's edit, and let other editors keep it."""
        self.note(self._session.edit)
        with self._condition:
            self._stopped = True
            self._condition.notify_all()
        if self._thread.is_alive():
            self._thread.join(30)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
