"""Names of the editor's files: inside one folder, nothing replaced."""

from __future__ import annotations

import pytest

from scgs_warp.editor import files
from scgs_warp.errors import UserError


@pytest.mark.parametrize(
    "name",
    ["", "..", "../a", "a/b", "/etc/passwd", "a\\b", ".hidden", "a\nb", "C:a", "a" * 200, "-rf", "a.", "caf\u00e9"],
)
def test_names_lead_nowhere_else(tmp_path, name):
    with pytest.raises(UserError, match="file name"):
        files.output_path(tmp_path / "edits", name, ".json")
    assert not (tmp_path / "edits").exists()


def test_names(tmp_path):
    folder = tmp_path / "edits"
    assert files.saved_edits(folder) == ()
    assert files.output_path(folder, " raise arm.v2 ", ".json") == folder / "raise arm.v2.json"
    path = files.output_path(folder, "raise.JSON", ".json")
    assert path == folder / "raise.json"
    path.write_text("{}")
    assert files.saved_edits(folder) == ("raise.json",)
    (folder / "link.json").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="link"):
        files.output_path(folder, "link", ".json")
    with pytest.raises(UserError, match="cannot be made"):
        files.output_path(path, "a", ".json")
    for name in ("-rf.json", "caf\u00e9.json", "a..json", f"{'a' * 120}.json"):
        (folder / name).write_text("{}")
    assert files.saved_edits(folder) == ("raise.json",), "what is listed can be loaded"


def test_names_that_are_taken_are_numbered(tmp_path):
    long = tmp_path / f"{'a' * 100}.mp4"
    assert files.unused_path(long) == long
    for path in (tmp_path / "film.mp4", tmp_path / "film 2.mp4", long):
        path.write_text("")
    assert files.unused_path(tmp_path / "film.mp4") == tmp_path / "film 3.mp4"
    found = files.unused_path(long)
    assert found != long and files.output_path(tmp_path, found.name, ".mp4") == found
    (tmp_path / "gone.ply").symlink_to(tmp_path / "nowhere")
    assert files.unused_path(tmp_path / "gone.ply").name == "gone 2.ply"
