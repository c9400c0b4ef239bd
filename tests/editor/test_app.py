"""The editor as a whole, without a browser."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from helpers.edit_scenes import bar_scene
from helpers.editor_models import canvas_camera
from scgs_warp.edit import EditSession
from scgs_warp.editor.app import Editor
from scgs_warp.errors import UserError

pytest.importorskip("viser", reason="the editor needs viser: pip install 'scgs_warp[edit]'")


@pytest.fixture
def editor(tmp_path) -> Iterator[Editor]:
    made = Editor(EditSession(bar_scene()), tmp_path, port=0)
    yield made
    made.stop()


def fail_to_draw(editor: Editor, monkeypatch: pytest.MonkeyPatch, client: int, error: Exception, said: list) -> None:
    """Have the editor's worker draw a picture for a client, which raises; wait until the client was told."""
    monkeypatch.setattr(editor.session, "render", lambda *_, **__: (_ for _ in ()).throw(error))
    before, end = len(said), time.monotonic() + 30
    with editor.worker.changing() as schedule:
        schedule.move(client, canvas_camera(), 0.0)
    while len(said) == before and time.monotonic() < end:
        time.sleep(0.01)
    with editor.worker.changing() as schedule:
        schedule.drop(client)


def test_a_picture_that_fails_says_so(editor, monkeypatch, capsys):
    said = []
    monkeypatch.setattr(editor, "say", lambda client, title, text, color="red": said.append((client, title, text)))
    monkeypatch.setattr(editor.server, "get_clients", lambda: {7: "a window"})
    for error, title in ((UserError("no room"), "The picture cannot be drawn"), (ValueError("odd"), "Internal error")):
        fail_to_draw(editor, monkeypatch, 7, error, said)
        assert said[-1][:2] == ("a window", title) and str(error) in said[-1][2]
    count = len(said)
    editor.picture_failed(8, ValueError("a window that is gone"))
    assert len(said) == count and "odd" in capsys.readouterr().err
