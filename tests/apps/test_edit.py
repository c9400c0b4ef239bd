"""``apps/edit.py``: films and exports, and mistakes in one line."""

from __future__ import annotations

import contextlib
import copy
import json
import sys
from pathlib import Path

import pytest
import torch

from helpers.edit_scenes import bar_scene, dress
from helpers.edit_scripts import SCRIPT
from helpers.export_runs import still_scene
from scgs_warp.apps import edit as app
from scgs_warp.edit import Edit, EditSession
from scgs_warp.edit.skeleton_from_motion import other_count
from scgs_warp.formats.gaussian_files import read_gaussians
from scgs_warp.formats.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from scgs_warp.scene.from_gaussians import open_gaussians


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
    for name in ("out.sog", "loose/meta.json", "out.compressed.ply", "out.spz"):
        assert app.cli([*arguments[:-2], "--export", str(tmp_path / name), "--at", "0.5"]) == 0
        assert "300 Gaussians, 0.5 s into the film" in capsys.readouterr().out
        found = read_gaussians(tmp_path / name).means
        assert float(torch.cdist(read_gaussian_ply(export).means, found).min(dim=1).values.max()) < 0.01
    assert app.cli([*arguments[:-2], "--export", export, "--at", "99"]) == 0
    assert f"99 s into the film, after its end at {SCRIPT['film']['seconds']:g} s" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["out.ply", "out.glb", "out.compressed.ply", "out.splat", "out.spz", "out.sog"])
def test_the_folder_of_an_export_is_made(tmp_path, ply, name):
    assert app.cli(["--ply", str(ply), "--nodes", "40", "--export", str(tmp_path / "new" / "folder" / name)]) == 0
    assert (tmp_path / "new" / "folder" / name).stat().st_size > 500


@pytest.mark.parametrize("option", ["--export=file/x.glb", "--output=file/x.mp4"])
def test_a_folder_that_cannot_be_made_is_refused_before_the_scene_is_loaded(tmp_path, monkeypatch, capsys, option):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("a file")
    assert app.cli(["--ply", "missing.ply", "--script", "x", option]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "file: cannot be written" in error and "missing" not in error


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
        (["--run", "a", "--parts", "0"], "--parts 0"),
        (["--run", "a", "--motion", "nope"], "--motion nope: no such file or folder"),
        (["--run", "a", "--at", "1"], "--at 1: belongs to --export"),
        (["--run", "a", "--export", "x.ply", "--size", "64"], "--size 64: belongs to a film"),
        (["--run", "a", "--export", "x.ply", "--port", "8080"], "--port: belongs to the editor"),
        (["--run", "a", "--script", "x", "--output", "x.mp4", "--share"], "leave it or --output out"),
        (["--run", "a", "--skeleton", "--new"], "leave it or --skeleton out"),
        (["--run", "a", "--skeleton", "--folder", "b"], "--folder: belongs to the editor"),
        (["--run", "a", "--skeleton", "--export", "out.ply"], "--skeleton prints and ends"),
    ],
)
def test_mistakes_are_one_line_and_status_2(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    assert app.cli(arguments) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_export_does_not_replace_the_file_that_is_edited(ply, capsys):
    before = ply.read_bytes()
    assert app.cli(["--ply", str(ply), "--script", "x", "--export", str(ply)]) == 2
    assert f"--export {ply}: would be overwritten, and it is read; give another name" in capsys.readouterr().err
    assert ply.read_bytes() == before


def test_the_skeleton_is_printed(monkeypatch, capsys):
    from scgs_warp.edit import EditSession

    session = EditSession(bar_scene())
    monkeypatch.setattr(app, "open_session", lambda options, device: session)
    assert app.cli(["--run", "a", "--skeleton"]) == 0
    head, *lines = capsys.readouterr().out.splitlines()
    assert head.split() == ["part", "hangs", "on", "points", "joint", "axis", "turns", "by", "confidence"]
    assert [line.split()[0] for line in lines] == list(session.skeleton.names)
    hangs = next(part for part in session.parts() if part.parent)
    own = next(line for line in lines if line.startswith(hangs.name))
    assert f"{hangs.degrees:.0f} degrees" in own and f"{hangs.confidence:.2f}" in own and str(hangs.parent) in own


def test_a_number_of_parts_is_taken(ply, capsys):
    assert app.cli(["--ply", str(ply), "--nodes", "40", "--skeleton", "--parts", "1"]) == 0
    said = capsys.readouterr()
    assert len(said.out.splitlines()) >= 2 and said.err == ""


def test_another_number_of_parts_than_asked_for_is_said_with_its_reason(ply, tmp_path, monkeypatch, capsys):
    assert app.cli(["--ply", str(ply), "--nodes", "40", "--skeleton", "--parts", "1000"]) == 0
    said = capsys.readouterr()
    found = len(said.out.splitlines()) - 2  # a line says where the parts come from, and one is the table's head
    wanted = f"note: --parts 1000: gives {found}: what stands still is not cut into smaller pieces\n"
    assert 1 <= found < 40 and said.err == wanted
    gaussians = read_gaussian_ply(ply).activate()
    with torch.no_grad():
        gaussians.means[: len(gaussians.means) // 2] += 50.0
    write_gaussian_ply(tmp_path / "two.ply", gaussians)
    assert app.cli(["--ply", str(tmp_path / "two.ply"), "--nodes", "40", "--skeleton", "--parts", "1"]) == 0
    wanted = "note: --parts 1: gives 2: the scene falls into that many pieces, and no part spans two\n"
    assert capsys.readouterr().err == wanted
    moving = EditSession(bar_scene(nodes=20))
    moving.use_parts(500)
    told = other_count(moving.skeleton, 500)
    assert told == f"gives {len(moving.skeleton.parts)}: the motion tells no more apart"
    assert other_count(moving.skeleton, len(moving.skeleton.parts)) is None


def test_a_motion_in_which_nothing_moves_is_named(ply, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("scgs_warp.scene.scene.Scene.load", lambda *_, **__: still_scene())
    (tmp_path / "match.json").write_text('{"part-1": "part-1"}')
    command = ["--ply", str(ply), "--nodes", "40", "--motion", str(tmp_path), "--match", str(tmp_path / "match.json")]
    assert app.cli([*command, "--skeleton"]) == 0
    assert capsys.readouterr().err == f"note: {tmp_path}: nothing moves in it, so the scene takes one pose\n"


@pytest.mark.parametrize(
    ("match", "said"),
    [
        ('{"tail": "part-1"}', "no part is called 'tail'; there is part-1"),
        ('{"part-1": "tail"}', "has no part 'tail'"),
        ("{}", "no part of the motion is matched"),
        ("[]", 'must hold a JSON object; write {"part of the scene": "part of the motion", ...}'),
    ],
)
def test_a_wrong_match_is_named(ply, tmp_path, monkeypatch, capsys, match, said):
    monkeypatch.setattr("scgs_warp.scene.scene.Scene.load", lambda *_, **__: bar_scene())
    (tmp_path / "match.json").write_text(match)
    command = ["--ply", str(ply), "--nodes", "40", "--motion", str(tmp_path), "--match", str(tmp_path / "match.json")]
    assert app.cli([*command, "--skeleton"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {tmp_path / 'match.json'}: ") and said in error and error.count("\n") == 1


def test_a_wrong_script_stops_the_app(ply, tmp_path, capsys):
    (tmp_path / "edit.json").write_text('{"format": "scgs-warp edit", "version": 1, "film": {"fps": -1}}')
    arguments = ["--ply", str(ply), "--script", str(tmp_path / "edit.json"), "--output", str(tmp_path / "film.mp4")]
    assert app.cli(arguments) == 2
    assert "film.fps" in capsys.readouterr().err and not (tmp_path / "film.mp4").exists()
    assert open_gaussians(ply).gaussian_count == 300


def test_control_points_and_parts_that_would_be_ignored_are_refused(ply, tmp_path, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        patch.setattr("scgs_warp.scene.scene.Scene.load", lambda *_, **__: bar_scene())
        assert app.cli(["--run", "a", "--nodes", "40", "--skeleton"]) == 2
        error = capsys.readouterr().err
        assert "--nodes 40" in error and "--run a" in error and error.count("\n") == 1
    session = EditSession(open_gaussians(ply, "cpu", 40))
    session.rename_part(session.skeleton.names[0], "trunk")
    session.save(tmp_path / "edit.json")
    command = ["--ply", str(ply), "--nodes", "40", "--skeleton", "--script", str(tmp_path / "edit.json")]
    assert app.cli([*command, "--parts", "2"]) == 2
    error = capsys.readouterr().err
    assert "--parts 2: --script" in error and error.count("\n") == 1
    (tmp_path / "edit.json").write_text(json.dumps({k: SCRIPT[k] for k in ("format", "version", "film")}))
    assert app.cli([*command, "--parts", "2"]) == 0
    assert len(capsys.readouterr().out.strip().splitlines()) in (3, 4), "a script without parts takes those asked for"


def test_an_export_fits_sharp_gaussians(tmp_path, monkeypatch):
    fitted = []
    monkeypatch.setattr("scgs_warp.export.still.plain_scene", lambda scene, *_: fitted.append(scene) or scene)
    session = EditSession(bar_scene())
    monkeypatch.setattr(app, "open_session", lambda options, device: session)
    assert app.cli(["--run", "a", "--export", str(tmp_path / "x.ply")]) == 0
    assert fitted == [session.scene]


@pytest.fixture
def opened(monkeypatch) -> list[EditSession]:
    """Sessions that the app opens in the browser; each is edited, and ends at once."""
    seen: list[EditSession] = []

    class Shown:
        url = "shown"

        def __init__(self, session, folder, *, autosave, **_) -> None:
            self.autosave = autosave
            seen.append(copy.copy(session))
            session.add_handle([0, 1], 0.0, f"hand {len(seen)}")

        def stop(self) -> None:
            self.autosave.stop()

    class Ended:
        def wait(self) -> None:
            pass

    monkeypatch.setattr("scgs_warp.editor.Editor", Shown)
    monkeypatch.setattr("scgs_warp.runtime.stop_signals.stop_signals", lambda: contextlib.nullcontext(Ended()))
    return seen


def test_what_is_asked_for_begins_in_place_of_the_kept_edit(ply, opened, tmp_path):
    command = ["--ply", str(ply), "--nodes", "40"]
    (tmp_path / "edit.json").write_text(json.dumps({k: SCRIPT[k] for k in ("format", "version", "film")}))
    for further in ([], ["--size", "320"], ["--parts", "2"], ["--script", str(tmp_path / "edit.json")], ["--new"]):
        assert app.cli([*command, *further]) == 0
    first, sized, parted, scripted, new = (session.edit for session in opened)
    assert not first.handles and [handle.name for handle in sized.handles] == ["hand 1"] and sized.film.size == 320
    assert not parted.handles and parted.skeleton is not None and len(parted.skeleton.parts) == 2
    assert not scripted.handles and new == Edit()
    aside = sorted(file.name for file in (ply.parent / "edits").glob("*previous*"))
    assert len(aside) == 3, aside


def test_a_wrong_skeleton_is_refused_before_the_page_opens(opened, monkeypatch, tmp_path, capsys):
    scene = bar_scene()
    scene.folder = tmp_path
    (tmp_path / "skeleton.json").write_text('{"format": "scgs-warp skeleton", "version": 99}')
    monkeypatch.setattr(app, "open_session", lambda options, device: EditSession(scene))
    assert app.cli(["--run", str(tmp_path)]) == 2
    error = capsys.readouterr().err.strip()
    assert "skeleton.json: version is 99" in error and len(error.splitlines()) == 1 and not opened


def test_without_aiohttp_the_editor_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "aiohttp.web", None)
    assert app.cli(["--run", str(tmp_path)]) == 2
    assert "pip install 'scgs_warp[edit]'" in capsys.readouterr().err
