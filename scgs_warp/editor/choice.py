"""What is chosen in the editor, and how its tools are set, as a text that outlives the server."""

from __future__ import annotations

import dataclasses
import json
from typing import get_args

from ..edit import edit_file
from ..edit.field_reader import FieldReader, parse_object
from ..edit.handles import Lasting
from ..errors import UserError
from .model import Combine, EditorModel, Region
from .parts_tool import PartsTool

FORMAT = "scgs-warp editor choice"
MAX_RADIUS = 1e6


def to_json(model: EditorModel, parts: PartsTool) -> str:
    """Return the text from which ``restore`` chooses the same again."""
    with model.lock:
        content = {
            "format": FORMAT,
            "scene": edit_file.scene_of(model.session.engine),
            "selection": list(model.selection),
            "part": parts.part,
            "active": model.active,
            "parts_first": parts.on,
            "region": dataclasses.asdict(model.region),
            "pin_rings": model.pin_rings,
            "combine": model.combine,
            "lasts": model.lasts,
            "window": model.window,
            "stiffness": model.stiffness,
        }
    return json.dumps(content)


def restore(text: str, model: EditorModel, parts: PartsTool) -> None:
    """Choose what a text says. One that is damaged, or of other control points, changes nothing: the edit counts, and
    what was chosen is a convenience."""
    try:
        fields = FieldReader(parse_object(text, "the choice"), "the choice")
        if fields.raw("format") != FORMAT or fields.raw("scene") != edit_file.scene_of(model.session.engine):
            return
        _take(fields, model, parts)
    except UserError:
        return


def _take(fields: FieldReader, model: EditorModel, parts: PartsTool) -> None:
    part, active, count = fields.text_or_none("part"), fields.text_or_none("active"), len(model.session)
    nodes = tuple(node for node in fields.items("selection") if isinstance(node, int) and 0 <= node < count)
    rings = None if fields.raw("pin_rings") is None else fields.integer("pin_rings", 3, 0, 20)
    own = fields.child("region") or FieldReader({}, "the choice")
    region = Region(
        own.choice("kind", ("rings", "brush"), "rings"),
        own.integer("rings", 2, 0, 12),
        own.number("radius", model.region.radius, 0.0, MAX_RADIUS),
    )
    settings = {
        "region": region,
        "pin_rings": rings,
        "combine": fields.choice("combine", get_args(Combine), "replace"),
        "lasts": fields.choice("lasts", get_args(Lasting), "motion"),
        "window": fields.number("window", 0.1, 1e-3, 10.0),
        "stiffness": fields.number("stiffness", None, 0.0, MAX_RADIUS),
    }
    parts.set(fields.boolean("parts_first") is not False)
    model.set(**settings)
    if part is not None and part in model.session.skeleton.names:
        parts.choose(part)
    else:
        model.select(nodes)
    if active is not None and model.session.edit.handle(active) is not None:
        with model.lock:
            model.active = active
