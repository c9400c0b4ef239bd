"""Models for tests of the editor: a bar."""

from __future__ import annotations

import functools

from helpers.edit_scenes import bar_scene
from scgs_warp.edit import EditSession
from scgs_warp.editor.model import EditorModel

LEFT, RIGHT = (-0.1, -1.0, 0.25), (1.1, -1.0, 0.25)


@functools.cache
def loaded() -> EditSession:
    return EditSession(bar_scene(gaussians=1500))


def new_model() -> EditorModel:
    """Return the editor's initial model, without automatic pins around handles."""
    made = EditorModel(loaded().fork())
    made.pin_rings = None
    return made


def chosen(model: EditorModel, point=RIGHT, rings: int = 1) -> tuple[int, ...]:
    return model.session.ring([model.session.nearest(point, model.time)], rings)
