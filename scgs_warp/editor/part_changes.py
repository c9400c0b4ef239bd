"""Changes of the parts themselves that pages ask for: other names, two parts as one, one part as two,
another parent."""

from __future__ import annotations

from typing import Any

from ..edit import EditSession
from ..edit.field_reader import FieldReader, show_value
from ..errors import UserError
from ..export.page_parts import part_facts
from .actions import short_text
from .host import Host


def parts_message(session: EditSession) -> dict[str, Any]:
    """Return what pages know of the parts: ``list`` as in exported pages, ``owner`` (the row of each control point's
    part), and ``chains`` (the rows that turn when a part is pulled)."""
    skeleton = session.skeleton
    rows = {name: row for row, name in enumerate(skeleton.names)}
    return {
        "list": part_facts(skeleton, session.scene.normalisation),
        "owner": skeleton.owners().tolist(),
        "chains": [[rows[name] for name in skeleton.chain(part)] for part in skeleton.names],
    }


def rename_part(editor: Host, fields: FieldReader) -> None:
    model = editor.model
    with model.changing() as session:
        names = [handle.name for handle in session.edit.handles]
        session.rename_part(short_text(fields, "name"), _new_name(fields))
        if model.active is not None:  # its handle may be called after the part
            model.active = session.edit.handles[names.index(model.active)].name


def rename_handle(editor: Host, fields: FieldReader) -> None:
    model, old, new = editor.model, short_text(fields, "name"), _new_name(fields)
    with model.changing() as session:
        session.rename_handle(old, new)
        if model.active == old:
            model.active = new


def merge_parts(editor: Host, fields: FieldReader) -> None:
    """Unite a part with a neighbour, under the name of the first, and choose the whole."""
    first = short_text(fields, "name")
    with editor.model.changing() as session:
        session.merge_parts(first, short_text(fields, "other"))
    editor.parts.choose(first)


def split_part(editor: Host, fields: FieldReader) -> None:
    """Make the selected control points of a part a part of their own, and choose it."""
    with editor.model.changing() as session:
        nodes = editor.model.selection
        if not nodes:
            raise UserError("nothing is chosen; choose some control points of one part (key 3)")
        skeleton = session.skeleton
        owners = sorted(set(skeleton.owners()[list(nodes)].tolist()))
        if len(owners) > 1:
            names = ", ".join(repr(skeleton.names[row]) for row in owners[:3])
            more = "" if len(owners) <= 3 else f" and {len(owners) - 3} more"
            raise UserError(f"the chosen control points belong to {names}{more}; choose points of one part")
        made = session.split_part(skeleton.names[owners[0]], nodes, _new_name(fields) if "to" in fields else None)
    editor.parts.choose(made)


def attach_part(editor: Host, fields: FieldReader) -> None:
    """Make a part hang on another one, or without one on none, and choose it."""
    name = short_text(fields, "name")
    with editor.model.changing() as session:
        session.attach_part(name, short_text(fields, "other") if "other" in fields else None)
    editor.parts.choose(name)


def _new_name(fields: FieldReader) -> str:
    """Return the name that a page gives, without spaces around it.

    Raises:
        UserError: it is empty, too long, or cannot be shown.
    """
    value = fields.raw("to")
    name = value.strip() if isinstance(value, str) else value
    try:
        return FieldReader({"name": name}, "the page").text("name")
    except UserError:
        raise UserError(f"{show_value(name)} is no name; give 1 to 100 letters") from None


PART_CHANGES = {
    action.__name__: action for action in (rename_part, rename_handle, merge_parts, split_part, attach_part)
}
