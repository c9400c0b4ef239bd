"""Pictures of a client: edited, original, side by side, split."""

from __future__ import annotations

import pytest

from helpers.editor_models import chosen, client, new_model
from scgs_warp.edit import Target
from scgs_warp.edit.handles import STAY
from scgs_warp.editor.frame_image import take_picture
from scgs_warp.editor.model import EditorModel


@pytest.fixture
def model() -> EditorModel:
    return new_model()


def test_side_by_side_and_split(model):
    model.select(chosen(model))
    model.grab(STAY)
    model.drag(Target((0.0, 0.3, 0.4)))
    model.release()
    session, camera = model.session, client(model.session)
    pictures = {}
    for show in ("edited", "original", "side by side", "split"):
        model.set(show=show)
        pictures[show] = take_picture(session, model.moment(), camera, 96).rgb.astype(int)
        assert pictures[show].shape == pictures["edited"].shape
    middle = camera.width // 2
    assert (pictures["edited"] != pictures["original"]).any()
    assert (pictures["split"][:, :middle] == pictures["original"][:, :middle]).all()
    assert (pictures["split"][:, middle + 1 :] == pictures["edited"][:, middle + 1 :]).all()
    assert (pictures["side by side"][:, middle] == 128).all()
