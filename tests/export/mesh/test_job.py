"""Meshes from a scene to a file: of a run, an edit and a file of Gaussians."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from helpers.edit_scenes import bar_scene, figure_scene
from helpers.mesh_scenes import ball_gaussians
from helpers.node_packages import gltf_errors
from scgs_warp.apps import export as app
from scgs_warp.data.gltf.scene import read_scene
from scgs_warp.data.synthetic.builtin import FigureSubject
from scgs_warp.edit import EditSession
from scgs_warp.export.mesh import colors, surface
from scgs_warp.export.mesh.binding import clearest_frame
from scgs_warp.export.mesh.job import MeshJob, MeshSettings
from scgs_warp.export.moments import even_moments
from scgs_warp.export.skeleton import build_skeleton
from scgs_warp.formats.gaussian_ply import write_gaussian_ply
from scgs_warp.storage import checkpoint

SMALL = ("--resolution", "40", "--faces", "1500", "--device", "cpu")


@pytest.fixture(autouse=True)
def few_views(monkeypatch):
    monkeypatch.setattr(surface, "VIEWS", 14)
    monkeypatch.setattr(colors, "VIEWS", 8)
    monkeypatch.setattr(colors, "SIZE", 96)


def distances(true: trimesh.Trimesh, made: trimesh.Trimesh) -> np.ndarray:
    """Distance of points on the mesh from the nearest of many points on the true surface."""
    from scipy.spatial import cKDTree

    points = trimesh.sample.sample_surface(true, 60_000, seed=1)[0]
    return cKDTree(points).query(trimesh.sample.sample_surface(made, 4_000, seed=2)[0])[0]


def figure_at(time: float) -> trimesh.Trimesh:
    subject = FigureSubject()
    return trimesh.Trimesh(subject.surface.posed(time)[0], subject.surface.faces, process=False)


def test_the_moving_mesh_of_the_figure_follows_its_true_surface(tmp_path):
    scene, _, _ = figure_scene(nodes=200, points=9000)
    scene.gaussians.log_scales.data.sub_(0.3)  # less thick than the spacing of the points
    session, moments = EditSession(scene), even_moments(5, 4.0)
    frame = clearest_frame(build_skeleton(session, moments))
    text = MeshJob(scene, session, MeshSettings(4000, 80)).write_moving(tmp_path / "a.glb", moments)
    assert text.startswith("closed mesh of 4,000 triangles") and "moved by 200 control points at 5 instants" in text
    found = read_scene(tmp_path / "a.glb", None)
    faces, height = found.triangles.faces, 2.35
    for at in {0, 2, 4, frame}:
        made = trimesh.Trimesh(found.posed(moments[at].seconds).positions, faces, process=False)
        assert made.is_watertight
        error = distances(figure_at(moments[at].time), made) / height
        assert error.mean() < 0.022 and np.quantile(error, 0.95) < 0.04, (at, error.mean(), np.quantile(error, 0.95))
    assert gltf_errors(tmp_path / "a.glb") == []


def export(*arguments: object) -> int:
    return app.cli([*map(str, arguments), *SMALL])


@pytest.fixture(scope="module")
def ball(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("ball") / "ball.ply"
    write_gaussian_ply(path, ball_gaussians(count=800).activate())
    return path


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "glb"])
def test_a_file_of_gaussians_becomes_a_mesh(tmp_path, ball, suffix, capsys):
    target = tmp_path / f"a.{suffix}"
    assert export("--ply", ball, "--format", "mesh", "--output", target) == 0
    assert "closed mesh of 1,500 triangles" in capsys.readouterr().out
    mesh = trimesh.load(target, force="mesh")
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(radius - 0.5).max() < 0.06 and mesh.is_watertight


def test_the_suffix_alone_selects_a_mesh_only_where_nothing_else_has_it(tmp_path, ball):
    assert export("--ply", ball, "--output", tmp_path / "a.obj") == 0
    assert app.cli(["--ply", str(ball), "--output", str(tmp_path / "a.ply"), "--device", "cpu"]) == 0
    assert b"f_dc_0" in (tmp_path / "a.ply").read_bytes()[:2000]


def test_the_same_request_gives_the_same_bytes(tmp_path, ball):
    for name in ("a.glb", "b.glb"):
        assert export("--ply", ball, "--format", "mesh", "--output", tmp_path / name) == 0
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()


def test_an_edit_moves_the_mesh_of_a_file(tmp_path, ball):
    session = EditSession(app_scene(ball))
    session.add_handle(range(len(session)), 0.0, "all")
    session.move("all", [0.0, 0.0, 1.0])
    session.add_keyframe(0.0)
    session.move("all", [0.0, 0.0, 2.0])
    session.add_keyframe(1.0)
    session.save(tmp_path / "e.json")
    edit = ("--ply", ball, "--edit", tmp_path / "e.json", "--format", "mesh")
    assert export(*edit, "--at", 1.0, "--output", tmp_path / "a.ply") == 0
    mesh = trimesh.load(tmp_path / "a.ply", force="mesh")
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), [0, 0, 2], atol=0.02)
    assert export(*edit, "--sequence", "--output", tmp_path / "a.glb") == 0
    found = read_scene(tmp_path / "a.glb", None)
    first, last = (found.posed(at).positions.mean(axis=0) for at in (found.clip.start, found.clip.end))
    assert np.linalg.norm(last - first) == pytest.approx(1.0, abs=0.02)


def app_scene(path: Path):
    from scgs_warp.scene.from_gaussians import open_gaussians

    return open_gaussians(path)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--run", "BALL", "--format", "mesh", "--sequence", "--output", "a.obj"), "a moving mesh is a .glb"),
        (("--format", "mesh", "--sequence", "--output", "a.glb"), "give one of --run and --ply"),
        (("--ply", "BALL", "--format", "mesh", "--sequence", "--output", "a.glb"), "needs --run, or an --edit"),
        (("--ply", "BALL", "--faces", "500", "--output", "a.spz"), "--faces: belongs to a mesh"),
        (("--ply", "BALL", "--resolution", "0", "--output", "a.spz"), "--resolution: belongs to a mesh"),
        (("--ply", "BALL", "--sequence", "--output", "a.glb"), "--sequence: belongs to a mesh"),
        (("--ply", "BALL", "--format", "mesh", "--faces", "3", "--output", "a.obj"), "--faces 3: give 100 to"),
        (("--ply", "BALL", "--format", "mesh", "--resolution", "9999", "--output", "a.obj"), "--resolution 9999: give"),
        (("--ply", "BALL", "--format", "mesh", "--frames", "9", "--output", "a.glb"), "or give --sequence"),
        (("--ply", "BALL", "--format", "mesh", "--time", "0.5", "--output", "a.glb"), "has no times"),
        (("--ply", "BALL", "--format", "mesh", "--output", "a.fbx"), "end the name in .obj or .stl or .ply or .glb"),
        (("--ply", "BALL", "--format", "mesh", "--spz-version", "3", "--output", "a.obj"), "--spz-version"),
    ],
)
def test_requests_that_cannot_work_are_refused_in_one_line(tmp_path, ball, arguments, words, capsys):
    named = [str(tmp_path / word) if word.startswith("a.") else word.replace("BALL", str(ball)) for word in arguments]
    assert app.cli([*named, "--device", "cpu"]) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1 and list(tmp_path.iterdir()) == []


def test_scenes_without_control_points_are_refused_as_sequences(tmp_path, capsys):
    from scgs_warp.config.presets import from_dict
    from scgs_warp.motion import build_motion

    scene = bar_scene(nodes=10, gaussians=60)
    config = from_dict({"motion": {"layers": 2, "width": 32, "skip": 1}, "sharpness": 0.0})
    scene.config, scene.motion = config, build_motion("per-gaussian", config)
    checkpoint.write(tmp_path, scene.tensors(), {**scene.metadata(), "stage": "main"})
    (tmp_path / "config.json").write_text(json.dumps(scene.settings))
    mesh = ("--run", tmp_path, "--format", "mesh")
    assert export(*mesh, "--sequence", "--output", tmp_path / "a.glb") == 2
    assert "has no control points, which move a mesh" in capsys.readouterr().err
    assert export(*mesh, "--time", 0.5, "--output", tmp_path / "a.obj") == 0


def test_a_run_that_stands_still_is_no_sequence(tmp_path, ball, capsys):
    from scgs_warp.motion import build_motion

    scene = app_scene(ball)
    scene.motion = build_motion("static", scene.config)
    checkpoint.write(tmp_path, scene.tensors(), {**scene.metadata(), "stage": "main"})
    (tmp_path / "config.json").write_text(json.dumps(scene.settings))
    assert export("--run", tmp_path, "--format", "mesh", "--sequence", "--output", tmp_path / "a.glb") == 2
    assert "stands still; leave --sequence out" in capsys.readouterr().err
    assert export("--run", tmp_path, "--format", "mesh", "--output", tmp_path / "a.stl") == 0
