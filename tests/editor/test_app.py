"""The editor as a whole, without a browser."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from helpers.edit_scenes import bar_scene
from scgs_warp.edit import EditSession
from scgs_warp.editor.app import Editor
from scgs_warp.errors import UserError

pytest.importorskip("viser", reason="the editor needs viser: pip install 'scgs_warp[edit]'")


@pytest.fixture
def editor(tmp_path) -> Iterator[Editor]:
    made = Editor(EditSession(bar_scene()), tmp_path, port=0)
    yield made
    made.stop()


def test_a_picture_that_fails_says_so(editor, monkeypatch, capsys):
    said = []
    monkeypatch.setattr(editor, "say", lambda client, title, text, color="red": said.append((client, title, text)))
    monkeypatch.setattr(editor.server, "get_clients", lambda: {7: "a window"})
    for error, title in ((UserError("no room"), "The picture cannot be drawn"), (ValueError("odd"), "Internal error")):
        with pytest.raises(type(error)):
            try:
                raise error
            finally:
                editor.picture_failed(7, error)
        assert said[-1][:2] == ("a window", title) and str(error) in said[-1][2]
    editor.picture_failed(8, ValueError("a window that is gone"))
    assert len(said) == 2 and "odd" in capsys.readouterr().err
