"""Files of the editor: edits saved and loaded; films, Gaussians and pages exported to a folder and the browser."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..edit import EditSession, edit_file
from ..edit.field_reader import MAX_BYTES, FieldReader, parse_object
from ..edit.filming import render_film
from ..errors import UserError
from . import files
from .actions import short_text
from .host import Host

if TYPE_CHECKING:
    from ..export.page_scene import PageMotion

Advance = Callable[[], None]


def _path(editor: Host, fields: FieldReader, suffix: str) -> Path:
    """Return the path of a new file; a number is added to a name that exists, unless it is to be replaced."""
    path = files.output_path(editor.folder, short_text(fields, "name"), suffix)
    return path if fields.boolean("replace") else files.unused_path(path)


def _forked(editor: Host) -> EditSession:
    with editor.model.lock:
        return editor.session.fork()


def save(editor: Host, fields: FieldReader) -> str:
    path = _path(editor, fields, ".json")
    with editor.model.lock:
        editor.session.save(path)
    return path.name


def load(editor: Host, fields: FieldReader) -> None:
    """Load a saved edit of the folder."""
    path = files.output_path(editor.folder, short_text(fields, "name"), ".json")
    _take(editor, edit_file.read(path, editor.session.engine, lambda: editor.session.skeleton))


def upload(editor: Host, fields: FieldReader) -> None:
    """Load an edit that the page sends."""
    text = short_text(fields, "text", MAX_BYTES)
    content = parse_object(text, "the file")
    _take(editor, edit_file.parse(content, "the file", editor.session.engine, lambda: editor.session.skeleton))


def _take(editor: Host, edit: Any) -> None:
    with editor.model.changing() as session:
        session.apply(edit)


def export_film(editor: Host, fields: FieldReader) -> str:
    """Start to write the film of the edit as it is now; later changes do not affect it."""
    path = _path(editor, fields, fields.choice("format", (".mp4", ".gif"), ".mp4"))
    session = _forked(editor)

    def work(advance: Advance) -> Path:
        render_film(session, path, advance, lambda draw: editor.worker.call(draw, patient=True))
        return path

    editor.jobs.start(f"Film {path.name}", session.edit.film.frames, work)
    return path.name


def export_ply(editor: Host, fields: FieldReader) -> str:
    """Start to write the edited Gaussians at the moment shown, as ``edit.py --export`` does."""
    from ..export.plain import pieces_of
    from ..export.still import write_edited

    path, moment, session = _path(editor, fields, ".ply"), editor.model.moment(), _forked(editor)

    def work(advance: Advance) -> Path:
        def compute(action: Callable[[], Any]) -> Any:
            result = editor.worker.call(action, patient=True)
            advance()
            return result

        write_edited(path, session, moment.time, moment.at, compute)
        return path

    editor.jobs.start(f"Gaussians {path.name}", pieces_of(session.scene) + 1, work)
    return path.name


def export_page(editor: Host, fields: FieldReader) -> str:
    """Start to write a web page that plays the edit, with parts to pull if the page asks for them."""
    from ..export.page import PageOptions, write_page
    from ..export.page_edit import edited_motion, film_times
    from ..export.page_pose import posable
    from ..export.poster import edited_poster

    path, posed, session = _path(editor, fields, ".html"), bool(fields.boolean("pose")), _forked(editor)
    title = short_text(fields, "title") if "title" in fields else editor.title

    def finish(motion: PageMotion) -> Path:
        motion = posable(session, motion) if posed else motion
        picture = functools.partial(edited_poster, session)
        write_page(session.scene, path, PageOptions(title, motion=motion, picture=picture))
        return path

    def work(advance: Advance) -> Path:
        motion = edited_motion(session, advance, lambda pose: editor.worker.call(pose, patient=True))
        return editor.worker.call(lambda: finish(motion), patient=True)

    editor.jobs.start(f"Page {path.name}", len(film_times(session)), work)
    return path.name


def stop_job(editor: Host, fields: FieldReader) -> None:
    editor.jobs.cancel()


EXPORTS = {action.__name__: action for action in (save, load, upload, export_film, export_ply, export_page, stop_job)}


def downloadable(folder: Path, name: str) -> Path:
    """Return the path of a file that a page may fetch.

    Raises:
        UserError: the name leads elsewhere, or there is no such file.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in (".json", ".mp4", ".gif", ".ply", ".html", ".png"):
        raise UserError(f"file {name[:100]!r}: is none of the editor's")
    path = files.output_path(folder, name, suffix)
    if not path.is_file():
        raise UserError(f"file {name[:100]!r}: there is none")
    return path
