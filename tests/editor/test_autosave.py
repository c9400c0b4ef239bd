"""The edit that is kept: after changes, kills and damage, and by one editor at a time."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest

from helpers.edit_scenes import bar_scene
from helpers.paths import ROOT
from scgs_warp.edit import Edit, EditSession, edit_file
from scgs_warp.editor import autosave as module
from scgs_warp.editor.autosave import Autosave, folder_for
from scgs_warp.errors import UserError
from scgs_warp.storage.own_folder import own_folder

ACTIONS = 60
SESSION = """
import random, sys
from pathlib import Path
from helpers.edit_scenes import bar_scene
from scgs_warp.edit import EditSession
from scgs_warp.editor.autosave import Autosave
session = EditSession(bar_scene(nodes=12, gaussians=20))
keeper = Autosave(session, Path(sys.argv[1]))
keeper.start(restore=True)
session.add_handle([0, 1], 0.0, "hand")
print("ready", flush=True)
for number in range(int(sys.argv[2])):
    session.move("hand", (0.001 * (number + 1), 0.0, 0.0))
    keeper.note(session.edit)
    assert keeper.flush()
    print(number, flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def session() -> EditSession:
    return EditSession(bar_scene(nodes=12, gaussians=20))


def kept(folder: Path, session: EditSession) -> Edit:
    return edit_file.read(folder / "autosave.json", session.engine)


def test_every_change_is_kept_and_restored(session, tmp_path):
    keeper = Autosave(session, tmp_path)
    keeper.start(restore=True)
    assert keeper.said == "" and not (tmp_path / "autosave.json").exists(), "an empty edit leaves no file"
    session.add_handle([0, 1], 0.0, "hand")
    keeper.note(session.edit)
    assert keeper.flush() and keeper.saved(session.edit) and kept(tmp_path, session) == session.edit
    session.move("hand", (0.1, 0.0, 0.0))
    keeper.stop()
    assert kept(tmp_path, session) == session.edit, "stopping saves"

    other = EditSession(session.scene)
    again = Autosave(other, tmp_path)
    again.start(restore=True)
    assert other.edit == session.edit and "restored" in again.said
    assert other.undo() and other.edit == Edit(), "which can be undone"
    again.stop()
    assert kept(tmp_path, session) == Edit()


def test_a_new_edit_moves_the_old_one_aside(session, tmp_path):
    session.add_handle([0, 1], 0.0, "hand")
    session.save(tmp_path / "autosave.json")
    other = EditSession(session.scene)
    keeper = Autosave(other, tmp_path)
    keeper.start(restore=False)
    keeper.stop()
    assert other.edit == Edit() and edit_file.read(tmp_path / "autosave.previous.json", session.engine) == session.edit


def test_a_script_is_kept_at_once(session, tmp_path):
    session.add_handle([0, 1], 0.0, "hand")
    keeper = Autosave(session, tmp_path)
    keeper.start(restore=False)
    assert keeper.flush() and kept(tmp_path, session) == session.edit
    keeper.stop()


@pytest.mark.parametrize("content", [b"", b"{", b'{"format": "scgs-warp edit", "version": 1, "handles": 3}', b"\xff"])
def test_a_damaged_edit_is_put_aside_and_said(session, content, tmp_path):
    (tmp_path / "autosave.json").write_bytes(content)
    keeper = Autosave(session, tmp_path)
    keeper.start(restore=True)
    keeper.stop()
    assert "cannot be used" in keeper.said and "\n" not in keeper.said and session.edit == Edit()
    assert (tmp_path / "autosave.damaged.json").read_bytes() == content


def test_no_kept_edit_is_overwritten(tmp_path):
    """An edit of another number of control points is put aside beside the one that was put aside before."""
    for life, nodes in enumerate((12, 15, 12, 15)):
        session = EditSession(bar_scene(nodes=nodes, gaussians=20))
        keeper = Autosave(session, tmp_path)
        keeper.start(restore=True)
        assert ("cannot be used" in keeper.said) == (life > 0)
        session.add_handle([0, 1], 0.0, f"hand {life}")
        keeper.stop()
    for _ in range(2):
        keeper = Autosave(EditSession(bar_scene(nodes=15, gaussians=20)), tmp_path)
        keeper.start(restore=False)
        keeper._session.add_handle([0], 0.0, "new")
        keeper.stop()
    found = {file.name: "".join(file.read_text().split()) for file in tmp_path.glob("autosave*.json")}
    assert all(any(f'"hand{life}"' in text for text in found.values()) for life in range(4)), found.keys()
    assert len(found) == 6


def test_what_cannot_be_saved_is_said_and_tried_again(session, tmp_path, monkeypatch):
    keeper = Autosave(session, tmp_path)
    keeper.start(restore=True)
    write = module.write_atomically

    def full(path: Path, content: bytes) -> None:
        raise UserError(f"{path}: cannot be written (No space left on device)")

    monkeypatch.setattr(module, "write_atomically", full)
    session.add_handle([0, 1], 0.0, "hand")
    keeper.note(session.edit)
    assert not keeper.flush() and "No space" in (keeper.problem or "") and not keeper.saved(session.edit)
    monkeypatch.setattr(module, "write_atomically", write)
    keeper.note(session.edit)
    assert keeper.flush() and kept(tmp_path, session) == session.edit
    keeper.stop()


def test_what_could_not_be_saved_is_saved_when_the_folder_is_there_again(session, tmp_path, monkeypatch):
    """Without another change: nobody may come back to make one."""
    monkeypatch.setattr(module, "AGAIN", 0.05)
    folder = tmp_path / "edits"
    folder.mkdir()
    keeper = Autosave(session, folder)
    keeper.start(restore=True)
    folder.rename(tmp_path / "away")
    session.add_handle([0, 1], 0.0, "hand")
    keeper.note(session.edit, "{}")
    assert not keeper.flush() and "cannot be written" in (keeper.problem or "")
    (tmp_path / "away").rename(folder)
    end = time.monotonic() + 30
    while not keeper.saved(session.edit):
        assert time.monotonic() < end
        time.sleep(0.02)
    assert kept(folder, session) == session.edit
    keeper.stop()


def run(folder: Path, actions: int = ACTIONS) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", SESSION, str(folder), str(actions)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT / "tests")},
    )  # fmt: skip


def test_killed_at_any_moment_at_most_the_change_in_flight_is_lost(session, tmp_path):
    """One process a life: each is killed at a random action, and the next one goes on from what was kept."""
    choose = random.Random(5)
    for life in range(10):
        process = run(tmp_path)
        assert process.stdout is not None and process.stdin is not None
        last, end = -1, choose.randrange(ACTIONS)
        for line in process.stdout:
            if line.strip() == "ready":
                continue
            last = int(line)
            if last == end:
                break
            process.stdin.write("\n")
            process.stdin.flush()
        if life % 2:  # while the next change is on its way to the disk
            process.stdin.write("\n")
            process.stdin.flush()
        process.kill()
        process.wait()
        edit = kept(tmp_path, session)
        moved = edit.targets["hand"].translation[0]
        assert moved in (pytest.approx(0.001 * (last + 1)), pytest.approx(0.001 * (last + 2))), (life, last)


def test_two_editors_do_not_keep_one_edit(session, tmp_path):
    first = Autosave(session, tmp_path)
    with pytest.raises(UserError, match="another editor is open") as error:
        Autosave(EditSession(session.scene), tmp_path)
    assert "\n" not in str(error.value)
    other = Autosave(EditSession(session.scene), tmp_path, "scene.ply")
    assert other.path.name == "scene.ply.autosave.json", "files in one folder have edits of their own"
    other.stop()
    first.stop()
    Autosave(session, tmp_path).stop()


def test_the_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "home"))
    (tmp_path / "run").mkdir()
    (tmp_path / "scene.ply").write_bytes(b"")
    assert folder_for(tmp_path / "run") == tmp_path / "run" / "edits"
    assert folder_for(tmp_path / "scene.ply") == tmp_path / "edits"
    assert folder_for(tmp_path / "run", tmp_path / "mine") == tmp_path / "mine"
    (tmp_path / "sealed").mkdir()
    (tmp_path / "sealed" / "edits").write_text("a file is in the way, as in a folder that nobody may write to")
    found = folder_for(tmp_path / "sealed")
    assert (
        found == own_folder("edits", tmp_path / "sealed") and found.is_dir() and found.is_relative_to(tmp_path / "home")
    )
    assert list(found.iterdir()) == []
    with pytest.raises(UserError, match="--folder"):
        folder_for(tmp_path / "run", tmp_path / "scene.ply" / "x")
