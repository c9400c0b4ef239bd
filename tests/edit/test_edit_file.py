"""Edits as files and the app: what is wrong is said in one line; what a script films is what a session shows."""

from __future__ import annotations

import copy
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from helpers.edit_scenes import bar_scene, dress
from scgs_warp.apps import edit as app
from scgs_warp.edit import Edit, EditSession, Film, film_camera, render_film
from scgs_warp.edit.edit_file import parse, read
from scgs_warp.edit.rotations import from_axis
from scgs_warp.errors import UserError
from scgs_warp.formats.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from scgs_warp.scene.from_gaussians import open_gaussians
from scgs_warp.visualization.figures import to_bytes

SCRIPT = {
    "format": "scgs-warp edit",
    "version": 1,
    "comment": "the right end is raised and lowered",
    "handles": [
        {"name": "right", "nodes": {"point": [1.1, -1, 0.25], "rings": 1}, "time": 0.0, "pivot": [0.8, -1, 0.25]},
        {"name": "tip", "nodes": {"sphere": [1.1, -1, 0.25], "radius": 0.1}, "stiffness": 0.5, "lasts": "fade"},
    ],
    "pins": {"beyond": 2},
    "targets": {"tip": {"translation": [0, 0.02, 0]}},
    "keyframes": [
        {"at": 0.0, "easing": "ease", "targets": {"right": {}}},
        {"at": 0.5, "targets": {"right": {"axis": [0, 0, 1], "degrees": 60}}},
    ],
    "playback": {"speed": -1.0, "repeat": "swing"},
    "hold": [{"nodes": {"box": [[-1, -2, -1], [0, 2, 1]]}, "time": 0.3}],
    "exaggerate": {"factor": 1.2},
    "film": {
        "seconds": 0.5,
        "fps": 8,
        "size": 40,
        "background": [1, 1, 1],
        "shot": {"kind": "orbit", "views": [{"at": 0, "azimuth": 10}, {"at": 0.5, "azimuth": 70, "distance": 3}]},
    },
}


@pytest.fixture(scope="module")
def session() -> EditSession:
    return EditSession(bar_scene())


def test_a_script_is_read(session):
    edit = parse(SCRIPT, "edit.json", session)
    right, tip = edit.handles
    assert right.name == "right" and len(right.nodes) > 2 and right.pivot == (0.8, -1.0, 0.25)
    assert tip.stiffness == 0.5 and tip.lasts == "fade"
    assert edit.pins and not set(edit.pins) & set(session.ring(right.nodes, 2))
    assert edit.keyframes[1].targets["right"].rotation == tuple(from_axis([0, 0, 1], 60).tolist())
    assert edit.holds[0].nodes and edit.exaggerate is not None and edit.film.shot.views[1].distance == 3.0


def changed(path: str, value: object) -> dict:
    """The script with one field replaced (...: removed); ``path``: keys and indices between dots."""
    script = copy.deepcopy(SCRIPT)
    inner: object = script
    *outer, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    for part in outer:
        inner = inner[part]  # type: ignore[index]
    if value is ...:
        del inner[last]  # type: ignore[attr-defined]
    else:
        inner[last] = value  # type: ignore[index]
    return script


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("format", "gif", "format"),
        ("version", 2, "version"),
        ("handles", {}, "handles"),
        ("handles.0", 3, r"handles\[0\]"),
        ("handles.0.name", "", r"handles\[0\].name"),
        ("handles.0.name", "tip", "taken"),
        ("handles.0.nodes", [1, 2.5], "2.5"),
        ("handles.0.nodes", [1, 99999], "99999"),
        ("handles.0.nodes", [True], "true"),
        ("handles.0.nodes", [], "empty"),
        ("handles.0.nodes", ..., "nodes"),
        ("handles.0.nodes", {"point": [0, 0]}, "point"),
        ("handles.0.nodes", {"sphere": [99, 99, 99], "radius": 1}, "no control point"),
        ("handles.0.nodes", {"somewhere": 1}, "somewhere"),
        ("handles.0.nodes", {}, "no place"),
        ("handles.0.time", 1.5, "time"),
        ("handles.0.pivot", [0, 0, "x"], "pivot"),
        ("handles.0.lasts", "forever", "motion, frame, fade"),
        ("handles.0.colour", "red", "colour"),
        ("handles.1.stiffness", 0, "stiffness"),
        ("pins", [-1], "-1"),
        ("targets", {"nobody": {}}, "nobody"),
        ("targets.tip", None, "tip"),
        ("targets.tip.rotation", [0, 0, 0, 0], "tip"),
        ("targets.tip.axis", [0, 0, 1], "degrees"),
        ("targets.tip", {"axis": [1e-200, 0, 0], "degrees": 9}, "axis"),
        ("targets.tip.translation", [1e300, 0, 0], "translation"),
        ("keyframes.1.at", 0.0, "two at 0"),
        ("keyframes.1.at", ..., "at is missing"),
        ("keyframes.0.easing", "bouncy", "smooth, linear"),
        ("keyframes.0.targets", [], "targets"),
        ("playback.speed", "fast", "speed"),
        ("playback.map", [[0, 0], [0, 1]], r"map\[1\]"),
        ("playback.map", [[0, 2]], r"map\[0\]"),
        ("hold.0.frame", "moon", "body, world"),
        ("exaggerate.factor", 1e6, "factor"),
        ("film.fps", 0, "fps"),
        ("film.size", 4.5, "size"),
        ("film.background", [0, 0, 2], "background"),
        ("film.shot.kind", "drone", "turntable"),
        ("film.shot.views.1.at", 0, "two at one moment"),
        ("film.shot.up", [0, 0, 0], "up"),
        ("film.shot.up", [1e-200, 0, 0], "up"),
        ("scene", {"control_points": 5}, "control_points"),
        ("scene", {"fingerprint": "00000000"}, "fingerprint"),
        ("nonsense", 1, "nonsense"),
    ],
)
def test_every_mistake_names_its_field(session, path, value, words):
    with pytest.raises(UserError, match=words) as caught:
        parse(changed(path, value), "edit.json", session)
    message = str(caught.value)
    assert message.startswith("edit.json: ") and "\n" not in message and "; " in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "line 1"),
        ("[]", "object"),
        ('{"format": NaN}', "NaN"),
        ('{"a": 1, "a": 2}', "twice"),
        ("[" * 100_000, "nested|JSON"),
        ('{"format": "scgs-warp edit", "version": 1, "film": {"seconds": 1e999}}', "seconds"),
        ("\ufffe", "JSON"),
    ],
)
def test_files_that_are_no_edit(session, tmp_path, text, words):
    path = tmp_path / "edit.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UserError, match=words) as caught:
        read(path, session)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(UserError, match="no such file"):
        read(tmp_path / "missing.json", session)


def nested(levels: int) -> list:
    found: list = []
    for _ in range(levels):
        found = [found]
    return found


@pytest.mark.parametrize("value", ["a\nb" * 100_000, nested(3000), {"a\nb" * 100_000: {"x": 1}}, ["a\nb" * 100_000]])
@pytest.mark.parametrize(
    "path",
    "format version scene handles handles.0.name handles.0.nodes pins targets targets.tip keyframes.0.targets "
    "playback.map film hold.0.nodes".split(),
)
def test_whatever_stands_there_the_message_is_one_line(session, path, value):
    with pytest.raises(UserError) as caught:
        parse(changed(path, value), "edit.json", session)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 500


def test_names_that_nobody_knows_are_cut_and_on_one_line(session):
    for inner in ({"a\n" * 1000: 1}, {"targets": {"b\n" * 1000: {"axis": 1}}}, {"film": {"\ud800" * 999: 1}}):
        with pytest.raises(UserError) as caught:
            parse({**SCRIPT, **inner}, "edit.json", session)
        assert str(caught.value).isprintable() and len(str(caught.value)) < 500
    many = [{"name": f"a handle that is called number {i}", "nodes": [1]} for i in range(900)]
    with pytest.raises(UserError, match="names no handle") as caught:
        parse({**SCRIPT, "handles": many}, "edit.json", session)
    assert len(str(caught.value)) < 500


def test_another_count_of_control_points_says_how_to_ask_for_it(session, ply):
    script = {"format": "scgs-warp edit", "version": 1, "scene": {"control_points": 33}}
    with pytest.raises(UserError, match="--nodes 33"):
        parse(script, "edit.json", EditSession(open_gaussians(ply, nodes=20)))
    with pytest.raises(UserError) as caught:
        parse(script, "edit.json", session)
    assert "--nodes" not in str(caught.value)


def test_what_is_saved_can_be_loaded(tmp_path):
    """What no file may say is refused at once, and at the latest when it is saved."""
    own = EditSession(bar_scene())
    own.add_handle([1], 0.0, "a")
    before = own.edit
    for make, words in [
        (lambda: own.move("a", [2e9, 0, 0]), "translation"),
        (lambda: own.move("a", [0, 0, 1e150]), "translation"),
        (lambda: own.add_keyframe(4000.0), "at"),
        (lambda: own.add_keyframe(-1.0), "at"),
        (lambda: own.add_keyframe(1.0, "bouncy"), "easing"),
        (lambda: own.resize_film(10_000), "size"),
        (lambda: own.add_handle([2], 0.0, "b", pivot=(2e9, 0.0, 0.0)), "pivot"),
    ]:
        with pytest.raises(UserError, match=words):
            make()
        assert own.edit == before
    own.apply(Edit(film=Film(fps=1e6)))
    with pytest.raises(UserError, match="fps"):
        own.save(tmp_path / "edit.json")
    assert list(tmp_path.iterdir()) == []


def test_a_film_shows_what_the_session_shows(tmp_path):
    session = EditSession(bar_scene())
    session.apply(parse(SCRIPT, "edit.json", session))
    session.save(tmp_path / "edit.json")
    assert render_film(session, tmp_path / "film") == 4
    other = EditSession(bar_scene())
    other.load(tmp_path / "edit.json")
    frames = [cv2.imread(str(path))[..., ::-1] for path in sorted((tmp_path / "film").iterdir())]
    for index in (2, 0, 3):
        at = index / 8
        image = other.render(film_camera(other, at), other.scene_time(at), at, (1.0, 1.0, 1.0), frame=1e-3)
        np.testing.assert_array_equal(frames[index], to_bytes(image.rgb))
    assert not np.array_equal(frames[0], frames[3])


def test_cameras(session):
    own = EditSession(session.scene)
    for shot, azimuths in [
        ({"kind": "turntable", "turns": 0.5}, (0.0, 90.0, 157.5)),
        ({"kind": "fixed", "views": [{"azimuth": 33}]}, (33.0, 33.0, 33.0)),
        ({"kind": "orbit", "views": [{"at": 0, "azimuth": 0}, {"at": 4, "azimuth": 60}]}, (0.0, 30.0, 57.4)),
    ]:
        own.apply(parse({**changed("film.shot", shot), "film": {"seconds": 4, "shot": shot}}, "x", own))
        for at, azimuth in zip((0.0, 2.0, 3.5), azimuths):
            x, y, _ = film_camera(own, at).position.tolist()
            assert np.degrees(np.arctan2(y, x)) == pytest.approx(azimuth, abs=0.5)
    shot = {"kind": "fixed", "fov": 20, "up": [0, 2, 0], "views": [{"distance": 7, "target": [1, 2, 3]}]}
    own.apply(parse(changed("film.shot", shot), "x", own))
    camera = film_camera(own, 0.0)
    assert float((camera.position - torch.tensor([1.0, 2.0, 3.0])).norm()) == pytest.approx(7, rel=1e-5)


@pytest.fixture
def ply(tmp_path) -> Path:
    path = tmp_path / "scene.ply"
    generator = torch.Generator().manual_seed(0)
    write_gaussian_ply(path, dress(torch.randn(300, 3, generator=generator), degree=1).activate())
    return path


def test_the_app_films_and_exports(tmp_path, ply, capsys):
    script = {k: SCRIPT[k] for k in ("format", "version", "film")}
    script["handles"] = [{"name": "a", "nodes": {"point": [2, 0, 0], "rings": 1}}]
    script["keyframes"] = [{"at": 0, "targets": {"a": {}}}, {"at": 0.5, "targets": {"a": {"translation": [1, 0, 0]}}}]
    (tmp_path / "edit.json").write_text(json.dumps(script))
    arguments = ["--ply", str(ply), "--script", str(tmp_path / "edit.json"), "--nodes", "40", "--size", "32"]
    output, export = str(tmp_path / "film.mp4"), str(tmp_path / "out.ply")
    assert app.cli([*arguments, "--output", output, "--export", export, "--at", "0.5"]) == 0
    assert "4 frames of 32 x 32" in capsys.readouterr().out and Path(output).stat().st_size > 500
    moved = (read_gaussian_ply(export).means - read_gaussian_ply(ply).means).norm(dim=1)
    assert float(moved.max()) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "one of --run and --ply"),
        (["--run", "a", "--ply", "b"], "one of --run and --ply"),
        (["--ply", "missing.ply", "--script", "x", "--output", "film.mp4"], "missing.ply"),
        (["--run", "missing", "--script", "x", "--output", "film.mp4"], "missing"),
        (["--run", "a", "--output", "film.mp4"], "--script"),
        (["--run", "a", "--port", "-1"], "--port -1"),
        (["--run", "a", "--script", "x", "--output", "film.avi"], "film.avi"),
        (["--run", "a", "--script", "x", "--export", "out.obj"], "out.obj"),
        (["--run", "a", "--nodes", "0"], "--nodes 0"),
        (["--run", "a", "--size", "5"], "--size 5"),
        (["--run", "a", "--at", "-1"], "--at -1"),
    ],
)
def test_mistakes_are_one_line_and_status_2(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert app.cli(arguments) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_script_stops_the_app(ply, tmp_path, capsys):
    (tmp_path / "edit.json").write_text('{"format": "scgs-warp edit", "version": 1, "film": {"fps": -1}}')
    arguments = ["--ply", str(ply), "--script", str(tmp_path / "edit.json"), "--output", str(tmp_path / "film.mp4")]
    assert app.cli(arguments) == 2
    assert "film.fps" in capsys.readouterr().err and not (tmp_path / "film.mp4").exists()
    assert open_gaussians(ply).gaussian_count == 300


def test_without_viser_the_editor_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert app.cli(["--run", str(tmp_path)]) == 2
    assert "pip install 'scgs_warp[edit]'" in capsys.readouterr().err
