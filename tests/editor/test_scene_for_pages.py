"""What a page gets to draw: the scene, or pictures of the server."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image

from helpers.studios import bar_editor
from helpers.web_clients import get, key
from scgs_warp.editor import Editor
from scgs_warp.errors import UserError
from scgs_warp.export.page_data import unpack
from scgs_warp.geometry.cameras import orbit_camera

pytest.importorskip("aiohttp", reason="the package aiohttp is not installed")


@pytest.fixture
def editor(tmp_path) -> Iterator[Editor]:
    made = bar_editor(tmp_path, nodes=60, gaussians=1500)
    yield made
    made.stop()


@pytest.fixture
def view(editor) -> dict[str, Any]:
    """A camera, as a page sends it."""
    camera = orbit_camera(editor.session.scene.overview, 40.0, 64)
    matrices = {"viewmat": camera.viewmat.tolist(), "K": camera.K.tolist()}
    return {**matrices, "width": camera.width, "height": camera.height}


def test_a_scene_with_a_mask_is_edited(tmp_path):
    editor = bar_editor(tmp_path, share=0.5)
    try:
        raw = get(editor.server.port, "/scene", Cookie=key(editor.server))
        assert raw.status == 200
        facts, columns = unpack(editor._content or b"")
        assert facts["masked"] and "share" in columns and len(columns["part"]) == facts["nodes"]
    finally:
        editor.stop()


def test_a_picture_that_fails_is_answered(page, view, monkeypatch, capfd):
    for error, said in ((UserError("no light"), "no light"), (RuntimeError("broken"), "internal error")):
        monkeypatch.setattr("scgs_warp.editor.app.scene_jpeg", lambda *_, error=error: (_ for _ in ()).throw(error))
        page.heard.clear()
        page.send({"do": "picture", "at": 0.0, **view})
        for word in (said, "undrawn"):
            page.until(lambda word=word: any(word in str(message) for message in page.heard))
    assert "broken" in capfd.readouterr().err


def test_pages_without_webgl_get_pictures(page, view):
    page.send({"do": "picture", "at": 0.0, **view})
    page.until(lambda: page.pictures)
    with Image.open(io.BytesIO(page.pictures[0])) as picture:
        assert picture.size == (view["width"], view["height"])
        bright = np.asarray(picture, np.float64).sum(2)
    row, column = np.unravel_index(bright.argmax(), bright.shape)
    page.ask("pick_pixel", pixel=[column + 0.5, row + 0.5], **view)
    assert page.state["selection"]
    page.ask("pick_pixel", pixel=[1.0, 1.0], **view)
    assert not page.state["selection"]
