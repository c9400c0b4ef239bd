"""What the program that exports says: mistakes in one line, and what was written."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from helpers.edit_scenes import bar_scene
from helpers.export_runs import export, moving_run, save, still_scene
from scgs_warp.apps import export as app
from scgs_warp.config.presets import from_dict
from scgs_warp.edit import EditSession
from scgs_warp.errors import UserError
from scgs_warp.export.still import write_edited
from scgs_warp.motion import Static, build_motion
from scgs_warp.runtime import memory
from scgs_warp.scene.from_gaussians import with_control_points
from scgs_warp.scene.scene import Scene


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    return moving_run(tmp_path_factory.mktemp("runs") / "run")


def test_mistakes_are_one_line_and_leave_nothing(run, tmp_path, capsys):
    (tmp_path / "folder.ply").mkdir()
    still = save(still_scene(), tmp_path / "still")
    cases = [
        (["--output", "a.ply"], "--run and --ply"),
        (["--run", run, "--output", "a.xyz"], "--format"),
        (["--run", run, "--output", "a.ply", "--format", "glb"], ".glb"),
        (["--run", run, "--output", "folder.ply"], "folder"),
        (["--run", run, "--output", "a.ply", "--time", 1.5], "--time 1.5"),
        (["--run", run, "--output", "a.npz", "--time", 0.5], "--time 0.5"),
        (["--run", run, "--output", "a.ply", "--at", 0.5], "--edit"),
        (["--run", run, "--output", "a.npz", "--frames", 0], "--frames 0"),
        (["--run", run, "--output", "a.npz", "--fps", 0], "--fps 0"),
        (["--ply", "a.ply", "--output", "b.spz", "--time", 0.5], "--time 0.5: a file of Gaussians has no times"),
        (["--run", run, "--output", "b.spz", "--frames", 9], "--frames: "),
        (["--run", run, "--output", "b.glb", "--time", 0.2, "--frames", 10], "leave out --time"),
        (["--ply", "a.ply", "--output", "b.glb", "--fps", 10], "--fps: "),
        (["--run", run, "--output", "b.html", "--frames", 9], "--frames: --format html has no frames"),
        (["--run", run, "--output", "b.glb", "--edit", "e.json", "--frames", 9], "--frames: the film of an edit"),
        (["--run", run, "--output", "b.glb", "--edit", "e.json", "--fps", 9], "change film.fps in e.json"),
        (["--run", run, "--output", "b.htm", "--fps", 9], "--fps: --format html has no frames"),
        (["--run", run, "--output", "b.json", "--fps", 9], "--fps: --format cameras has no frames"),
        (["--run", run, "--output", "b", "--format", "ply-sequence", "--fps", 9], "--fps: a ply-sequence"),
        (["--run", run, "--output", "b.npz", "--skeleton", "parts"], "--skeleton parts: "),
        (["--run", run, "--output", "b.glb", "--skeleton", "parts", "--time", 0.1], "leave out --time"),
        (["--run", run, "--output", "b.npz", "--points", 3], "--points 3: belongs to tracks"),
        (["--run", run, "--output", "b.csv", "--points", 0], "--points 0: give 1 to"),
        (["--run", run, "--output", "b.csv", "--points", tmp_path / "none.csv"], "none.csv"),
        (["--run", run, "--output", "b.obj", "--format", "tracks"], ".csv or .npz or .glb for"),
        (["--run", run, "--output", "b.4dgs", "--frames", 1], "--frames 2"),
        (["--run", still, "--output", "b.4dgs"], "stands still"),
        (["--run", run, "--output", "b.npz", "--title", "x"], "--title: belongs to a page"),
        (["--run", run, "--output", "b.glb", "--max-mib", 3], "--max-mib: belongs to a page"),
        (["--run", run, "--output", "b.html", "--max-mib", 0.001], "0.001 MiB of --max-mib"),
        (["--run", run, "--output", Path.cwd(), "--format", "ply-sequence"], "is the current folder"),
        (["--run", tmp_path / "nowhere", "--output", "a.ply"], "nowhere"),
        (["--ply", "a.ply", "--output", "b.spz"], "no such file"),
        (["--ply", "a.ply", "--output", "b.npz"], "--run"),
        (["--ply", "a.ply", "--output", "b.html", "--edit", "e.json"], "no such file"),
        (["--ply", "a.ply", "--output", "b.json"], "a file of Gaussians has no cameras"),
        (["--run", still, "--output", "b.npz"], "stands still"),
        (["--run", still, "--output", "b.glb", "--skeleton", "parts"], "--skeleton parts: "),
        (["--run", still, "--output", "b.glb", "--frames", 9], "--frames: "),
        (["--run", still, "--output", "b.glb", "--fps", 9], "--fps: "),
        (["--run", run, "--format", "cameras", "--output", "b.json"], "data.folder"),
    ]
    before = sorted(path.name for path in tmp_path.iterdir())
    for arguments, words in cases:
        output = arguments.index("--output") + 1
        arguments = [tmp_path / a if i == output or a == "a.ply" else a for i, a in enumerate(arguments)]
        assert app.cli([*map(str, arguments), "--device", "cpu"]) == 2, arguments
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1 and words in lines[0], lines
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.parametrize("output", ["a.npz", "a.glb"])
@pytest.mark.parametrize("more", [[], ["--skeleton", "parts"]])
def test_motion_that_does_not_fit_into_memory_is_refused(output, more, run, tmp_path, monkeypatch, capsys):
    if more and output == "a.npz":
        pytest.skip("has no such skeleton")
    monkeypatch.setattr(memory, "fits", lambda need, device="cpu": need < 2**20)
    arguments = ["--run", str(run), "--output", str(tmp_path / output), "--frames", "1000", *more, "--device", "cpu"]
    assert app.cli(arguments) == 2
    said = capsys.readouterr().err
    assert "1,000 instants needs" in said and "give fewer --frames, or a shorter film" in said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("model", ["hexplane", "per-gaussian"])
@pytest.mark.parametrize(("name", "kind"), [("a.npz", "npz"), ("a.glb", "glb"), ("a.glb", "graph")])
def test_motion_without_control_points_names_what_can_be_written(model, name, kind, tmp_path, capsys):
    like, config = bar_scene(nodes=8, gaussians=20), from_dict({"motion": {"model": model, "layers": 3, "skip": 2}})
    scene = Scene(like.gaussians, build_motion(model, config), like.normalisation, config, like.overview)
    folder = save(scene, tmp_path / "run")
    arguments = ["--run", str(folder), "--output", str(tmp_path / name), "--format", kind, "--device", "cpu"]
    assert app.cli(arguments) == 2
    said = capsys.readouterr().err
    assert f"--format {kind}: holds the motion of control points, and that of {folder} has none ({model})" in said
    assert ("a still (--time), or " in said) is (kind == "glb") and "--format ply-sequence, 4dgs or tracks" in said


def test_what_is_said_counts_what_is_written(run, tmp_path, capsys):
    scene = still_scene()
    with torch.no_grad():
        scene.gaussians.opacity_logits[0] = -9.0
        scene.gaussians.opacity_logits[1] = -9.0
        scene.gaussians.sh_rest.clamp_(-0.9, 0.9)[2, 4, 1] = 1.5
        scene.gaussians.log_scales[3] = -20.0
    still = save(scene, tmp_path / "still")
    for arguments, words in (
        (["--run", still, "--output", tmp_path / "a.htm"], "a.htm: 18 Gaussians that stand still,"),
        (["--run", run, "--output", tmp_path / "a.html"], "a.html: 120 Gaussians and their motion,"),
        (["--run", still, "--output", tmp_path / "f", "--frames", 2], "f: 2 frames of 20 Gaussians,"),
        (["--run", still, "--output", tmp_path / "a.spz"], "20 Gaussians at rest (4 values clipped to what .spz can"),
        (["--run", run, "--output", tmp_path / "b.spz"], "b.spz: 120 Gaussians at rest"),
    ):
        export(*arguments)
        assert words in capsys.readouterr().out


@pytest.mark.parametrize(("name", "words"), [("a.csv", "surface to follow"), ("a.obj", "no surface")])
def test_a_scene_without_surface_is_named_with_its_remedy(name, words, tmp_path, capsys):
    like = bar_scene(nodes=8, gaussians=20)
    with torch.no_grad():
        like.gaussians.opacity_logits.fill_(-5.0)
    still = Scene(like.gaussians, Static(), like.normalisation, like.config, like.overview)
    folder, file = save(still, tmp_path / "run"), tmp_path / "faint.ply"
    export("--run", folder, "--output", file)
    (tmp_path / "edit.json").write_text(json.dumps({"format": "scgs-warp edit", "version": 1}))
    sources = [(["--run", folder], "train for more steps"), (["--ply", file], "give another file")]
    for source, remedy in sources:
        edit = ["--edit", tmp_path / "edit.json"] if name == "a.csv" else []
        capsys.readouterr()
        assert app.cli([*map(str, [*source, "--output", tmp_path / name, *edit]), "--device", "cpu"]) == 2
        said = capsys.readouterr().err
        assert f"error: {source[1]}: no Gaussian is opaque to " in said and f"{words}; {remedy}, " in said, said
        assert said.endswith(f"; {remedy}, or look at it with apps/view.py {source[0]} {source[1]}\n"), said


def test_positions_beyond_spz_are_refused_before_gaussians_are_fitted(tmp_path, monkeypatch, capsys):
    def fit(*_):
        raise AssertionError("fitted before the check")

    scene = still_scene()
    with torch.no_grad():
        scene.gaussians.means[0] = 1e9
    run = save(scene, tmp_path / "run")
    monkeypatch.setattr("scgs_warp.export.run.plain_scene", fit)
    monkeypatch.setattr("scgs_warp.export.still.plain_scene", fit)
    for more in ([], ["--time", "0.5"]):
        assert app.cli(["--run", str(run), "--output", str(tmp_path / "a.spz"), *more, "--device", "cpu"]) == 2
        said = capsys.readouterr().err
        assert f"error: {tmp_path / 'a.spz'}: a Gaussian lies 5e+08 from the origin" in said and "write a .ply" in said
    with pytest.raises(UserError, match=r"b\.spz: a Gaussian lies"):
        write_edited(tmp_path / "b.spz", EditSession(with_control_points(scene, 8)), 0.0, 0.0)
