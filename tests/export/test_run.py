"""Exports of a run, an edit, or a file of Gaussians, from the request to the bytes."""

from __future__ import annotations

import copy
import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData

from helpers.edit_scenes import bar_scene
from helpers.export_files import columns, documented_player, gltf_arrays, picture, ply_columns
from helpers.export_runs import export, moving_run
from helpers.node_packages import gltf_errors, splat_transform
from helpers.page_reader import read_page
from helpers.tiny import write_dnerf
from scgs_warp.apps import edit as edit_app
from scgs_warp.apps import export as app
from scgs_warp.apps import view as view_app
from scgs_warp.edit import EditSession
from scgs_warp.edit.rotations import from_axis, unit
from scgs_warp.export.control_graph import write_graph
from scgs_warp.export.moments import at_rest, even_moments
from scgs_warp.export.skeleton import build_skeleton
from scgs_warp.export.still import write_still
from scgs_warp.scene.from_gaussians import open_gaussians
from scgs_warp.scene.scene import Scene
from scgs_warp.types import Gaussians


def bent(scene: Scene) -> EditSession:
    session = EditSession(scene)
    x = session.node_positions(0.0)[:, 0]
    session.add_handle(np.flatnonzero(x > np.quantile(x, 0.8)), 0.0, "end")
    session.pin(np.flatnonzero(x < np.quantile(x, 0.4)))
    session.move("end", [0, 0, 0.3], from_axis([0, 1, 0], 40))
    return session


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    return moving_run(tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture(scope="module")
def masked_run(tmp_path_factory) -> Path:
    return moving_run(tmp_path_factory.mktemp("runs") / "masked", masked=True)


@pytest.mark.parametrize("name", ["run", "masked_run"])
def test_npz_is_played_by_the_script_in_the_documentation(name, request, tmp_path):
    path, run = tmp_path / "a.npz", request.getfixturevalue(name)
    export("--run", run, "--output", path, "--frames", 5, "--fps", 4)
    scene, data = Scene.load(run), dict(np.load(path))
    assert str(data["format"]) == "scgs-warp motion" and {"shading", "node_tints", "correctives"} <= data.keys()
    assert ("share" in data) == (name == "masked_run")
    means, quats, scales, sh_dc = (None,) * 4
    for seconds, time in ((0.0, 0.0), (0.5, 0.5), (1.0, 1.0)):
        means, quats, scales, sh_dc = documented_player()["play"](data, seconds)
        truth = scene.gaussians_at(time)
        np.testing.assert_allclose(means, truth.means, atol=2e-6)
        np.testing.assert_allclose(np.abs((unit(quats) * unit(truth.quats.numpy())).sum(1)), 1.0, atol=1e-6)
        np.testing.assert_allclose(sh_dc, truth.sh_dc, atol=2e-5)
        parts = means, quats, scales, data["opacities"], sh_dc, data["sh_rest"]
        again = Gaussians(*(torch.from_numpy(np.asarray(part)).float() for part in parts))
        assert float((picture(again) - picture(truth)).abs().max()) < 2e-5
    assert np.abs(means - data["means"]).max() > 1e-2
    between = documented_player()["play"](data, 0.6)[0]
    assert np.isfinite(between).all() and not np.array_equal(between, means)
    before = path.read_bytes()
    export("--run", run, "--output", path, "--frames", 5, "--fps", 4)
    assert path.read_bytes() == before


def test_moving_glb_is_valid_and_bound(run, tmp_path):
    path = tmp_path / "a.glb"
    export("--run", run, "--output", path, "--frames", 7)
    scene = Scene.load(run)
    found, seen = gltf_arrays(path)
    gltf = seen["gltf"]
    assert len(gltf.skins[0].joints) == 24 and len(gltf.animations[0].channels) == 48
    np.testing.assert_array_equal(found["POSITION"], at_rest(scene).means.double().numpy())
    mean = torch.stack([scene.gaussians_at(frame / 6).sh_dc for frame in range(7)]).mean(0)
    np.testing.assert_allclose(found["KHR_gaussian_splatting:SH_DEGREE_0_COEF_0"], mean, atol=1e-5)
    issues = gltf_errors(path)
    codes = {issue["code"] for issue in issues if "KHR_gaussian_splatting" not in issue["pointer"]}
    assert codes == {"NODE_SKINNED_MESH_LOCAL_TRANSFORMS"}  # for programs that leave points unbound
    assert {i["code"] for i in issues if i["severity"] == 0} == {"MESH_PRIMITIVE_INVALID_ATTRIBUTE"}


def test_a_still_at_rest_has_the_mean_colours(run, tmp_path):
    """Base colours and tints may drift apart in training, so base colours alone belong to no instant."""
    export("--run", run, "--output", tmp_path / "a.ply")
    scene = Scene.load(run)
    found = ply_columns(tmp_path / "a.ply")
    mean = torch.stack([scene.gaussians_at(frame / 59).sh_dc.double() for frame in range(60)]).mean(0)
    np.testing.assert_allclose(columns(found, "f_dc", 3), mean, atol=1e-5)
    assert not np.allclose(mean, scene.gaussians.sh_dc.detach(), atol=1e-2)


def test_a_rig_of_the_parts_of_the_run(run, tmp_path, capsys):
    session = EditSession(Scene.load(run))
    names = session.skeleton.names
    session.rename_part(names[-1], "left arm")
    session.save_skeleton()
    export("--run", run, "--output", tmp_path / "a.glb", "--skeleton", "parts", "--frames", 3)
    said = capsys.readouterr().out
    assert f"120 Gaussians, {len(names)} joints at 3 instants (blending parts is off by" in said
    gltf = gltf_arrays(tmp_path / "a.glb")[1]["gltf"]
    assert {gltf.nodes[joint].name for joint in gltf.skins[0].joints} == {*names[:-1], "left arm"}
    (run / "skeleton.json").unlink()


def test_tracks_and_segments_of_a_run(run, tmp_path, capsys):
    scene = Scene.load(run)
    (tmp_path / "p.csv").write_text("x,y,z\n0.5,-1,0.25\n")
    for arguments, words in (
        (["--output", tmp_path / "a.csv", "--points", 5], "tracks of 5 points at 3 instants"),
        (["--output", tmp_path / "b.npz", "--format", "tracks"], "tracks of 120 points at 3 instants"),
        (["--output", tmp_path / "c.glb", "--format", "tracks", "--points", tmp_path / "p.csv"], "tracks of 1 points"),
        (["--output", tmp_path / "d.4dgs"], "120 Gaussians in "),
    ):
        export("--run", run, *arguments, "--frames", 3)
        assert words in capsys.readouterr().out
    with np.load(tmp_path / "b.npz", allow_pickle=False) as found:
        np.testing.assert_array_equal(found["points"][2], scene.gaussians_at(1.0).means[found["gaussians"]])
    edit = tmp_path / "edit.json"
    session = bent(scene)
    session.save(edit)
    written = json.loads(edit.read_text())
    written["film"] |= {"seconds": 0.2, "fps": 20}
    edit.write_text(json.dumps(written))
    session.load(edit)
    export("--run", run, "--edit", edit, "--format", "tracks", "--output", tmp_path / "e.npz")
    with np.load(tmp_path / "e.npz", allow_pickle=False) as found:
        truth = session.gaussians_at(session.scene_time(0.1), 0.1).means
        np.testing.assert_array_equal(found["points"][2], truth[found["gaussians"]])


def test_the_graph_of_an_edit_is_written_with_a_mask_and_its_gaussians_are_refused(masked_run, tmp_path, capsys):
    bent(Scene.load(masked_run)).save(tmp_path / "edit.json")
    how = ["--run", masked_run, "--edit", tmp_path / "edit.json", "--output", tmp_path / "a.glb"]
    export(*how, "--format", "graph")
    assert "24 control points at 120 instants" in capsys.readouterr().out
    assert app.cli([str(argument) for argument in how]) == 2
    assert "write a film, html, ply-sequence, 4dgs, tracks or graph" in capsys.readouterr().err


def test_the_cameras_of_the_data_set_are_not_written_over(run, tmp_path, capsys):
    copy, data = shutil.copytree(run, tmp_path / "run"), write_dnerf(tmp_path / "data", 16)
    settings = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps({**settings, "data": {"folder": str(data)}}))
    kept = (data / "transforms_train.json").read_bytes()
    asked = ["--run", str(copy), "--format", "cameras", "--output"]
    assert app.cli([*asked, str(data / "transforms_train.json")]) == 2
    assert "transforms_train.json: would overwrite a file of the data set; give another" in capsys.readouterr().err
    assert (data / "transforms_train.json").read_bytes() == kept
    export(*asked, data / "transforms.json")
    assert len(json.loads((data / "transforms.json").read_text())["frames"]) == 11


def test_graph_is_valid(run, tmp_path):
    export("--run", run, "--format", "graph", "--output", tmp_path / "g.glb", "--frames", 4)
    assert gltf_errors(tmp_path / "g.glb") == []
    session = EditSession(Scene.load(run))
    found, _ = gltf_arrays(tmp_path / "g.glb")
    assert len(found["POSITION"]) == 6 * (24 + len(session.graph.edges))
    np.testing.assert_allclose(found["POSITION"][:144].reshape(24, 6, 3).mean(1),
                               session.engine.to_world(session.engine.rig.positions.detach().double().numpy()),
                               atol=1e-6)  # fmt: skip
    lone = build_skeleton(EditSession(bar_scene(nodes=4, gaussians=20)), even_moments(2, 2.0))
    write_graph(tmp_path / "lone.glb", lone, np.zeros((0, 2), int), (0.0, 0.0, 1.0))
    assert gltf_errors(tmp_path / "lone.glb") == []


def test_a_sequence_has_a_frame_an_instant(run, tmp_path):
    folder = tmp_path / "frames"
    for frames in (4, 3):
        export("--run", run, "--output", folder, "--frames", frames)
        assert len(list(folder.iterdir())) == frames
    scene = Scene.load(run)
    for frame in range(3):
        data = PlyData.read(str(folder / f"frame_{frame:05d}.ply"))["vertex"].data
        truth = scene.gaussians_at(frame / 2)
        np.testing.assert_array_equal(np.stack([data["x"], data["y"], data["z"]], 1), truth.means)
        np.testing.assert_array_equal(data["f_dc_1"], truth.sh_dc[:, 1])
    (folder / "mine.txt").write_text("keep me")
    assert app.cli(["--run", str(run), "--output", str(folder), "--frames", "2"]) == 2
    assert len(list(folder.iterdir())) == 4 and sorted(p.name for p in tmp_path.iterdir()) == ["frames"]


def test_a_sequence_of_sog_is_read_by_splat_transform(run, tmp_path):
    folder = tmp_path / "frames"
    export("--run", run, "--output", folder, "--format", "sog-sequence", "--frames", 3)
    assert sorted(path.name for path in folder.iterdir()) == [f"frame_{i:05d}.sog" for i in range(3)]
    scene = Scene.load(run)
    for frame in (0, 2):
        found = ply_columns(splat_transform(folder / f"frame_{frame:05d}.sog", tmp_path / f"{frame}.ply"))
        means = np.stack([found[axis] for axis in "xyz"], 1)
        truth = scene.gaussians_at(frame / 2).means.double().numpy()
        away = np.linalg.norm(means[:, None] - truth[None], axis=2)
        assert len(means) == 120 and away.min(axis=0).max() < 1e-3 and away.min(axis=1).max() < 1e-3
    export("--run", run, "--output", folder, "--frames", 2, "--format", "ply-sequence")
    assert len(list(folder.iterdir())) == 2


def test_stills_and_conversions(run, tmp_path):
    scene = Scene.load(run)
    for name, arguments, truth in (
        ("rest.ply", (), at_rest(scene)),
        ("posed.ply", ("--time", 0.3), scene.gaussians_at(0.3)),
    ):
        export("--run", run, "--output", tmp_path / name, *arguments)
        data = PlyData.read(str(tmp_path / name))["vertex"].data
        np.testing.assert_array_equal(data["x"], truth.means[:, 0])
        if name == "posed.ply":  # at rest, colours are means over time
            np.testing.assert_array_equal(data["f_dc_0"], truth.sh_dc[:, 0].detach())
    export("--run", run, "--time", 0.3, "--output", tmp_path / "posed.glb")
    found, seen = gltf_arrays(tmp_path / "posed.glb")
    assert not seen["gltf"].animations
    np.testing.assert_array_equal(found["POSITION"], scene.gaussians_at(0.3).means)
    for source, target in (("posed.ply", "a.spz"), ("a.spz", "b.splat"), ("b.splat", "c.ply"), ("c.ply", "d.glb")):
        export("--ply", tmp_path / source, "--output", tmp_path / target)
    found, _ = gltf_arrays(tmp_path / "d.glb")
    expected = scene.gaussians_at(0.3).means.double().numpy()
    away = np.linalg.norm(found["POSITION"][:, None] - expected[None], axis=2)
    assert away.min(axis=1).max() < 2e-5 and len(found["POSITION"]) == 120


def test_an_edit_is_exported(run, tmp_path):
    scene = Scene.load(run)
    session = bent(scene)
    session.add_keyframe(0.0)
    session.move("end", [0, 0, -0.2])
    session.add_keyframe(0.2)
    content = tmp_path / "edit.json"
    session.save(content)
    written = json.loads(content.read_text())
    written["film"] |= {"seconds": 0.2, "fps": 20}
    content.write_text(json.dumps(written))
    session.load(content)
    export("--run", run, "--edit", content, "--at", 0.1, "--output", tmp_path / "a.ply")
    data = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    truth = session.gaussians_at(session.scene_time(0.1), 0.1)
    np.testing.assert_array_equal(data["z"], truth.means[:, 2])
    assert np.abs(data["z"] - scene.gaussians_at(session.scene_time(0.1)).means[:, 2].numpy()).max() > 0.02
    export("--run", run, "--edit", content, "--output", tmp_path / "a.npz")
    played = dict(np.load(tmp_path / "a.npz"))
    assert len(played["seconds"]) == 4 and {"shading", "correctives", "node_own_rotations"} <= played.keys()
    for second in (0.0, 0.1):
        truth = session.gaussians_at(session.scene_time(second), second)
        means, _, _, sh_dc = documented_player()["play"](played, second)
        np.testing.assert_allclose(means, truth.means, atol=2e-6)
        np.testing.assert_allclose(sh_dc, truth.sh_dc, atol=2e-5)


def test_an_edit_poses_the_parts_of_the_run_in_every_format(run, tmp_path, monkeypatch):
    """Gaussians in place of sharp ones have other opacities, by which parts and neighbours would be others."""
    folder = tmp_path / "run"
    shutil.copytree(run, folder)

    def plain(scene: Scene) -> Scene:
        made = copy.deepcopy(scene.gaussians)
        with torch.no_grad():
            made.opacity_logits[::2] = -6.0
        return Scene(made, scene.motion, scene.normalisation, scene.config, scene.overview)

    monkeypatch.setattr("scgs_warp.export.run.plain_scene", plain)
    scene = Scene.load(folder)
    session = EditSession(scene)
    own = session.parts()[-1].name
    session.rename_part(own, "left")
    session.save_skeleton()
    session.turn("left", 50, axis=(0, 1, 0))
    session.save(tmp_path / "edit.json")
    written = json.loads((tmp_path / "edit.json").read_text())
    del written["skeleton"]
    (tmp_path / "edit.json").write_text(json.dumps(written))
    truth = session.gaussians_at(session.scene_time(0.5), 0.5).means.numpy()
    assert np.abs(truth - scene.gaussians_at(session.scene_time(0.5)).means.numpy()).max() > 0.1
    export("--run", folder, "--edit", tmp_path / "edit.json", "--at", 0.5, "--output", tmp_path / "a.ply")
    data = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    np.testing.assert_array_equal(np.stack([data[axis] for axis in "xyz"], axis=1), truth)
    assert (np.sort(data["opacity"])[: len(truth) // 2] < -5).all(), "the Gaussians are those in place of sharp ones"
    session.edit = dataclasses.replace(session.edit, skin="nodes")
    export("--run", folder, "--edit", tmp_path / "edit.json", "--output", tmp_path / "a.npz")
    played = dict(np.load(tmp_path / "a.npz"))
    second = float(played["seconds"][len(played["seconds"]) // 2])
    means = documented_player()["play"](played, second)[0]
    expected = session.gaussians_at(session.scene_time(second), second).means
    np.testing.assert_allclose(means, expected, atol=1e-4)


def test_an_edit_of_a_scene_at_rest_keeps_its_control_points(run, tmp_path):
    """``export.py`` has no --nodes: the edit says how many there were."""
    source = tmp_path / "a.ply"
    write_still(source, Scene.load(run).gaussians_at(0.0))
    session = EditSession(open_gaussians(source, "cpu", 9))
    session.add_handle([0, 1], 0.0, "end")
    session.move("end", [0, 0, 0.3])
    session.save(tmp_path / "edit.json")
    export("--ply", source, "--edit", tmp_path / "edit.json", "--output", tmp_path / "b.ply")
    data = PlyData.read(str(tmp_path / "b.ply"))["vertex"].data
    np.testing.assert_allclose(data["z"], session.gaussians_at(0.0, 0.0).means[:, 2], atol=1e-6)


@pytest.mark.parametrize("name", ["a.spz", "a.compressed.ply", "a.sog", "loose/meta.json", "loose"])
def test_files_are_filmed_edited_and_put_on_a_page(run, tmp_path, name, capsys):
    source = tmp_path / name
    write_still(source / "meta.json" if name == "loose" else source, Scene.load(run).gaussians_at(0.0))
    film = tmp_path / "film"
    arguments = ["--ply", source, "--frames", 1, "--size", 32, "--mode", "turntable", "--output", film]
    assert view_app.cli([*map(str, arguments), "--device", "cpu"]) == 0
    assert len(list(film.iterdir())) == 1
    arguments = ["--ply", source, "--nodes", 10, "--export", tmp_path / "b.ply", "--device", "cpu"]
    assert edit_app.cli([*map(str, arguments)]) == 0
    assert len(PlyData.read(str(tmp_path / "b.ply"))["vertex"].data) == 120
    export("--ply", source, "--output", tmp_path / "b.html")
    assert "b.html: 120 Gaussians that stand still," in capsys.readouterr().out
    facts, _ = read_page(tmp_path / "b.html")
    assert facts["gaussians"] == 120 and f"<title>{source.name}</title>" in (tmp_path / "b.html").read_text()
