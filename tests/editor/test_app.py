"""The editor's server without a browser: what pages ask for, what they are sent, and who may."""

from __future__ import annotations

import random
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator

import numpy as np
import pytest

from helpers.edit_scenes import bar_scene
from helpers.studios import Page, bar_editor
from helpers.web_clients import get, key, opens
from scgs_warp.edit import edit_file
from scgs_warp.edit.filming import film_view
from scgs_warp.edit.rotations import from_axis, rotate, to_matrix
from scgs_warp.editor import Editor
from scgs_warp.editor.app import MAX_WAITING
from scgs_warp.editor.state import CURVE
from scgs_warp.export import plain
from scgs_warp.export.page_data import unpack
from scgs_warp.export.still import write_edited
from scgs_warp.formats.gaussian_ply import write_gaussian_ply

pytest.importorskip("aiohttp", reason="the package aiohttp is not installed")


@pytest.fixture
def editor(tmp_path) -> Iterator[Editor]:
    made = bar_editor(tmp_path, nodes=60, gaussians=1500)
    yield made
    made.stop()


def places_of(editor: Editor, *moment: float) -> np.ndarray:
    """Control points, computed where the editor computes: two threads may not use one session."""
    return editor.worker.call(lambda: editor.session.node_positions(*moment))


def end_of_bar(editor: Editor) -> list[float]:
    places = places_of(editor, 0.0)
    return places[places[:, 0].argmin()].tolist()


def pull(editor: Editor, page: Page, shift=(0.0, 0.1, 0.3), at: float = 0.0) -> None:
    """Take the end of the bar and pull it, as a drag does."""
    page.ask("tool", parts_first=False)
    grip = end_of_bar(editor)
    page.ask("pick", point=grip, how="replace", at=at)
    assert "problem" not in page.ask("grab", at=at)
    for share in (0.3, 0.6, 1.0):
        page.send({"do": "drag", "grip": grip, "to": [g + share * s for g, s in zip(grip, shift)]})
    page.ask("release", at=at)


def test_a_drag_is_posed_kept_and_undone(editor, page, tmp_path):
    assert page.state["unedited"] and page.hello["title"] == "bar" and not page.state["undo"]
    pull(editor, page)
    state = page.state
    assert not state["unedited"] and not state["dragging"] and len(state["handles"]) == 1 and state["undo"]
    page.until(lambda: -1 in page.poses)
    page.until(lambda: editor.latency)  # noted just after the pose is sent
    assert editor.autosave.flush() and edit_file.read(tmp_path / "autosave.json", editor.session.engine) == (
        editor.session.edit
    )
    edit = editor.session.edit
    page.ask("undo")
    assert page.state["unedited"] and page.state["redo"]
    page.ask("redo")
    assert editor.session.edit == edit
    assert page.ask("redo")["problem"] == "there is nothing to redo"


def test_frames_are_those_of_the_session(editor, page):
    pull(editor, page)
    page.ask("key", at=0.0)
    pull(editor, page, (0.0, 0.0, -0.4), at=2.0)
    assert [frame["at"] for frame in page.state["keyframes"]] == [0.0, 2.0], "a drag keys itself once there are keys"
    version, film = page.state["version"], editor.session.edit.film
    page.poses.clear()
    page.send({"do": "frames", "version": version - 1, "frames": [3]})
    page.send({"do": "frames", "version": version, "frames": [0, 30, 45, -5, "x", 10**9]})
    page.until(lambda: {0, 30, 45} <= page.poses.keys())
    editor.worker.call(lambda: None)
    assert set(page.poses) - {-1} == {0, 30, 45}, "of another version, or none, nothing is sent"
    rest = editor.session.engine.rig.positions.detach().double().numpy()
    for frame in (0, 30, 45):
        at = frame / film.fps
        table = page.poses[frame].astype(np.float64)
        rows = table[:, :12].reshape(-1, 3, 4)
        places = np.einsum("mij,mj->mi", rows[:, :, :3], rest) + rows[:, :, 3]
        wanted = places_of(editor, editor.session.scene_time(at), at)
        np.testing.assert_allclose(editor.session.engine.to_world(places), wanted, atol=1e-5)
        if not editor.session.engine.motion_at(0.0).pose.shape_rotations:
            np.testing.assert_allclose(to_matrix(table[:, 12:16]), rows[:, :, :3], atol=1e-5)


def test_the_camera_of_the_film_and_curves(editor, page):
    pull(editor, page)
    assert page.state["curve"] == [] and page.state["film"]["views"] == []
    page.ask("put", degrees=[0.0, 0.0, 40.0], at=0.0)
    page.ask("key", at=0.0)
    page.ask("put", degrees=[0.0, 0.0, -20.0], at=4.0)
    page.ask("key", at=4.0)
    curve = np.array(page.state["curve"])
    assert curve.shape == (CURVE, 3)
    np.testing.assert_allclose(curve[[0, -1]], [[0, 0, 40], [0, 0, -20]], atol=0.1)
    cameras = [message["camera"] for message in page.heard if "camera" in message]
    assert len(cameras) == 1 and cameras[0]["path"][0][0] != cameras[0]["path"][30][0], "once round"

    views = {"elevation": 10.0, "distance": 4.0, "target": [0, 0, 0]}
    page.ask("shot", kind="orbit", azimuth=10.0, at=1.0, **views)
    page.ask("shot", kind="orbit", azimuth=70.0, at=3.0, **views)
    page.ask("change_view", what="move", to=2.0, **{"from": 3.0})
    assert page.state["film"]["views"] == [1.0, 2.0]
    path = [message["camera"] for message in page.heard if "camera" in message][-1]["path"]
    for row, (azimuth, *_) in enumerate(path):
        at = editor.session.edit.film.seconds * row / (len(path) - 1)
        assert abs(azimuth - film_view(editor.session, at)[1]) < 1e-5, "the film's own"
    page.ask("change_view", what="copy", to=3.5, **{"from": 1.0})
    assert page.state["film"]["views"] == [1.0, 2.0, 3.5]
    for at in (1.0, 3.5):
        page.ask("change_view", what="delete", **{"from": at})
    assert "needs a view" in page.ask("change_view", what="delete", **{"from": 2.0})["problem"]
    assert "no view at second 3" in page.ask("change_view", what="move", to=1.0, **{"from": 3.0})["problem"]


def test_a_handle_turns_about_the_point_that_a_page_gives(editor, page):
    tip = end_of_bar(editor)
    page.ask("tool", parts_first=False)
    page.ask("pick", point=tip, how="replace", at=0.0)
    nodes = page.state["selection"]
    before = places_of(editor, 0.0)[nodes].mean(0)
    quat, about = from_axis([0, 1, 0], 30), np.add(tip, (0.0, 0.3, 0.1))
    page.ask("grab", at=0.0)
    page.send({"do": "drag", "rotation": quat.tolist(), "about": about.tolist()})
    page.ask("release", at=0.0)
    target = editor.session.edit.targets[page.state["active"]]
    np.testing.assert_allclose(target.rotation, quat, atol=1e-9)
    np.testing.assert_allclose(before + target.translation, rotate(quat, before - about) + about, atol=1e-9)


def test_what_is_up_is_chosen_for_view_and_film(editor, page):
    assert page.state["film"]["up"] == "scene"
    page.ask("film", up="-z")
    assert page.state["film"]["up"] == "-z" and film_view(editor.session, 0.0)[0].up == (0.0, 0.0, -1.0)
    assert [m["camera"] for m in page.heard if "camera" in m][-1]["overview"]["up"] == [0.0, 0.0, -1.0]
    page.ask("shot", kind="fixed", azimuth=10.0, elevation=0.0, distance=4.0, target=[0, 0, 0])
    assert page.state["film"]["up"] == "-z", "another path keeps it"
    page.ask("film", up="scene")
    assert page.state["film"]["up"] == "scene" and editor.session.edit.film.shot.up is None


def test_one_page_drags_at_a_time(editor, page):
    """Another page cannot end a drag."""
    pull(editor, page)
    other = Page(editor)
    try:
        assert "problem" not in page.ask("grab", at=0.0)
        page.until(lambda: editor.model.dragging)
        for what in ("release", "cancel"):
            assert "problem" not in other.ask(what, at=0.0)
            assert editor.model.dragging, what
        assert "another page drags" in other.ask("grab", at=0.0)["problem"], "an answer: the page waits for it"
        assert editor.model.dragging
        page.ask("release", at=0.0)
        assert not editor.model.dragging
    finally:
        other.close()


def test_escape_restores_the_edit(editor, page):
    page.ask("tool", parts_first=False)
    grip = end_of_bar(editor)
    page.ask("pick", point=grip)
    page.ask("grab")
    page.send({"do": "drag", "grip": grip, "to": [0.0, 0.0, 2.0]})
    page.ask("cancel")
    assert page.state["unedited"] and not page.state["handles"] and not page.state["undo"]


def test_a_page_that_leaves_lets_go(editor, page):
    other = Page(editor)
    other.ask("tool", parts_first=False)
    other.ask("pick", point=end_of_bar(editor))
    other.ask("grab")
    page.until(lambda: page.state["dragging"])
    page.send({"do": "drag", "grip": [0, 0, 0], "to": [0, 0, 1]})  # not its drag
    other.close()
    page.until(lambda: not page.state["dragging"])
    assert page.state["unedited"]


REQUESTS = [
    ("pick", {"point": [1, 2]}, "point"), ("pick", {"point": [0, 0, float("inf")]}, None),
    ("choose_part", {"name": "nobody"}, "no part is called"), ("activate", {"name": 3}, "name"),
    ("grab", {}, "nothing is chosen"), ("handle", {"lasts": "never"}, "lasts"), ("handle", {"window": -1}, "window"),
    ("film", {"seconds": 1e9}, "seconds"), ("film", {"background": [1, 2]}, "background"),
    ("film", {"up": "w"}, "up"),
    ("film", {"size": 1e6}, "size"), ("playback", {"speed": "fast"}, "speed"), ("hold", {}, "nothing is chosen"),
    ("unhold", {"index": 7}, "index"), ("change_key", {"what": "move", "from": 1.0, "to": 2.0}, "no keyframe"),
    ("key", {}, "needs a handle"), ("load", {"name": "../x"}, "file name"), ("load", {"name": "none"}, "none.json"),
    ("upload", {"text": "{"}, "the file"), ("upload", {"text": 3}, "text"), ("save", {"name": "a/b"}, "file name"),
    ("put", {"degrees": ["a", 0, 0]}, "degrees"), ("remove", {}, "no handle"), ("pin", {"what": "rest"}, "no handle"),
    ("shot", {"kind": "fixed", "target": [1]}, "target"), ("pick_pixel", {"width": 10**9}, "width"),
    ("export_film", {"name": "x", "format": ".exe"}, "format"),
]  # fmt: skip


@pytest.mark.parametrize(("what", "fields", "words"), [row for row in REQUESTS if row[2]], ids=lambda v: str(v)[:20])
def test_wrong_requests_get_one_line_and_change_nothing(what, fields, words, editor, page):
    answer = page.ask(what, **fields)
    assert words in answer["problem"] and "\n" not in answer["problem"] and "internal" not in answer["problem"]
    assert page.state["unedited"] and not page.state["undo"] and editor.session.edit == type(editor.session.edit)()


def test_nonsense_is_ignored(editor, page, capfd):
    odd = ["[]", "{}", '{"do": 3}', '{"do": "__init__"}', '{"do": "drag", "to": [1, 2]}', "{" * 5000]
    odd += ['{"do": "frames", "version": {}, "frames": {}}', '{"do": "picture", "width": 0}', "text", ""]
    odd += [f'{{"do": "tool", "at": 1{"0" * 400}, "id": [{"0, " * 9}0]}}', '{"do": "undo", "at": NaN, "id": NaN}']
    for message in odd:
        page.send(message)
    assert "problem" not in page.ask("tool", rings=3)
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("kind", ["binary", "no UTF-8"])
def test_a_malformed_message_closes_its_connection_alone(editor, page, kind, capfd):
    """What a page sends is no reason for a traceback, and does not disturb other pages."""
    import aiohttp

    other = Page(editor)
    text = aiohttp.WSMsgType.BINARY if kind == "binary" else aiohttp.WSMsgType.TEXT
    other.send_frame(b"\x81\xa4type\xa4Nope\xff\xff", text)
    assert other.closed.wait(20)
    assert "problem" not in page.ask("tool", rings=3)
    said = capfd.readouterr()
    assert "Traceback" not in said.err + said.out and "Error" not in said.err + said.out


def test_requests_do_not_pile_up(editor, page):
    release = threading.Event()
    editor.worker.post(lambda: release.wait(60))
    for number in range(MAX_WAITING + 50):
        page.send({"do": "tool", "rings": 2, "id": 1000 + number})
    page.until(lambda: sum("too many" in message.get("problem", "") for message in page.heard) >= 40)
    release.set()
    page.until(lambda: sum(message.get("done") == "tool" for message in page.heard) == MAX_WAITING + 50)
    assert editor.worker.backlog < MAX_WAITING


def test_a_random_session_returns_to_the_same_bytes(editor, page):
    """Scrub, drag, key, unkey, undo and redo in any order: no keyframe is lost, and undo returns to the same bytes."""
    choose = random.Random(3)
    pull(editor, page)
    states = [edit_file.to_json(editor.session.edit, editor.session.engine)]
    for _ in range(40):
        at = choose.choice([0.0, 1.0, 2.0, 3.0])
        before = {frame.at: dict(frame.targets) for frame in editor.session.edit.keyframes}
        what = choose.choice(["pull", "key", "delete", "seek", "move"])
        if what == "pull":
            pull(editor, page, (0.0, 0.05 * choose.random(), 0.1), at)
        elif what == "key":
            page.ask("key", at=at)
        elif what == "delete":
            page.ask("change_key", what="delete", **{"from": at})
        elif what == "move":
            page.ask("change_key", what="copy", to=choose.choice([0.5, 1.5]), **{"from": at})
        else:
            page.ask("tool", rings=2, at=at)
        after = {frame.at: dict(frame.targets) for frame in editor.session.edit.keyframes}
        if what != "delete":
            assert before.keys() <= after.keys(), what
        if what == "seek":
            assert before == after
        states.append(edit_file.to_json(editor.session.edit, editor.session.engine))
    different = [state for row, state in enumerate(states) if row == 0 or state != states[row - 1]]
    for state in reversed(different[:-1]):
        page.ask("undo")
        assert edit_file.to_json(editor.session.edit, editor.session.engine) == state
    for state in different[1:]:
        page.ask("redo")
        assert edit_file.to_json(editor.session.edit, editor.session.engine) == state


def test_an_older_state_does_not_follow_a_newer(editor, page, tmp_path, monkeypatch):
    """Autosave and exports have threads of their own, but states are made and sent by one."""
    threads, state = set(), editor._state
    monkeypatch.setattr(editor, "_state", lambda: threads.add(threading.current_thread().name) or state())
    pull(editor, page)
    page.until(lambda: page.state["saved"])
    page.ask("export_ply", name="out")
    page.until(lambda: any(m.get("file") == "out.ply" for m in page.heard) and page.state["job"] is None)
    assert threads == {"editor"}


def test_files_are_written_offered_and_read(editor, page, tmp_path):
    pull(editor, page)
    edit = editor.session.edit
    answer = page.ask("save", name="mine")
    assert answer["name"] == "mine.json" and "mine.json" in answer["files"]
    page.ask("reset")
    page.ask("load", name="mine.json")
    assert editor.session.edit == edit
    page.ask("reset")
    page.ask("upload", text=(tmp_path / "mine.json").read_text())
    assert editor.session.edit == edit
    page.ask("film", seconds=0.2, fps=10, size=32)
    for what in ("export_film", "export_ply", "export_page"):
        name = page.ask(what, name="out", pose=True)["name"]
        page.until(lambda name=name: any(m.get("file") == name for m in page.heard))
        assert get(editor.server.port, f"/file/{name}").status == 403
        sent = get(editor.server.port, f"/file/{name}", Cookie=key(editor.server))
        assert sent.status == 200 and "attachment" in (sent.getheader("Content-Disposition") or "")
    for name in ("..%2Fx.json", "none.mp4", "x.py", ".autosave.json.lock"):
        assert get(editor.server.port, f"/file/{name}", Cookie=key(editor.server)).status == 404


def test_gaussians_are_fitted_to_sharp_ones_as_edit_py_does(editor, page, tmp_path, monkeypatch):
    monkeypatch.setattr(plain, "VIEWS", 2)
    monkeypatch.setattr(plain, "STEPS", 4)
    monkeypatch.setattr(editor.session.scene.gaussians, "sharpness", 0.25)
    pull(editor, page)
    page.ask("export_ply", name="fitted")
    page.until(lambda: any(m.get("file") == "fitted.ply" for m in page.heard) and page.state["job"] is None)
    moment, session = editor.model.moment(), editor.session.fork()
    editor.worker.call(lambda: write_edited(tmp_path / "same.ply", session, moment.time, moment.at))
    editor.worker.call(lambda: session.export_ply(tmp_path / "formula.ply", moment.time, moment.at))
    fitted, same, formula = ((tmp_path / f"{name}.ply").read_bytes() for name in ("fitted", "same", "formula"))
    assert fitted == same != formula


def test_the_scene_has_parts_and_its_motion(editor):
    raw = get(editor.server.port, "/scene", Cookie=key(editor.server))
    assert raw.status == 200
    facts, columns = unpack(editor._content or b"")
    assert facts["edited"] and facts["nodes"] == 60 and len(facts["pose"]["chains"]) == len(facts["parts"])
    assert len(columns["part"]) == 60 and get(editor.server.port, "/scene").status == 403


def test_only_its_own_pages_are_served(editor):
    assert get(editor.server.port).status == 403 and get(editor.server.port, Cookie=key(editor.server)).status == 200
    assert opens(editor.server, "own") and not opens(editor.server, "http://evil.example")


@pytest.mark.parametrize("share", [False, True])
def test_the_app_serves_until_it_is_interrupted(tmp_path, share):
    ply = tmp_path / "scene.ply"
    write_gaussian_ply(ply, bar_scene().gaussians_at(0.0))
    command = [sys.executable, "-m", "scgs_warp.apps.edit", "--ply", str(ply), "--nodes", "40", "--port", "0"]
    process = subprocess.Popen(
        [*command, *(["--share"] if share else [])], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        assert "scene.ply.autosave.json" in process.stdout.readline()
        said = re.search(r"http://127\.0\.0\.1:(\d+)/(\?token=\S+)", process.stdout.readline())
        assert said is not None
        port = int(said[1])
        assert get(port, "/").status == 403 and get(port, f"/{said[2]}").status == 303
        second = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        assert second.returncode == 2 and "another editor is open" in second.stderr
        assert len(second.stderr.strip().splitlines()) == 1
        process.send_signal(signal.SIGINT)
        assert "has ended" in process.communicate(timeout=60)[0] and process.returncode == 0
    finally:
        process.kill()
        process.wait()
