"""The editor's latency as benchmark rows: complete, of the code that the editor runs, mistakes in one line."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from helpers.bench_rows import TINY, check_rows, rows_of
from helpers.edit_scenes import bar_scene
from scgs_warp.apps import bench as app
from scgs_warp.benchmark import editing
from scgs_warp.benchmark.scenes import synthetic_scene
from scgs_warp.edit import EditSession, Target
from scgs_warp.editor import pictures, poses
from scgs_warp.editor.model import EditorModel

pytestmark = pytest.mark.usefixtures("all_threads")


@pytest.mark.parametrize("what, first", [("edit", []), ("pull", ["kinematics"])])
def test_a_drag_in_the_editor(what, first, tmp_path, device, capsys, monkeypatch):
    tables, images = [], []
    pack, encode = poses.pose_message, pictures._jpeg
    monkeypatch.setattr(poses, "pose_message", lambda *a: (tables.append(a[0].copy()), pack(*a))[1])
    monkeypatch.setattr(pictures, "_jpeg", lambda rgb: (images.append(rgb.copy()), encode(rgb))[1])
    rows = rows_of(tmp_path, what, *TINY, "--device", device)
    check_rows(rows, device)
    drawn = ["project", "harmonics", "bin", "composite"]
    page, picture = ["compose", "pack"], ["skin", *drawn, "bytes", "encode"]
    stages = {f"{what}/drag": [*first, "solve", *page], f"{what}/picture": [*first, "solve", *picture]}
    expected = [
        name for whole, parts in stages.items() for name in (whole, *(f"{whole}/{p}" for p in [*parts, "rest"]))
    ]
    assert [row["name"] for row in rows] == expected, "every stage is in use"
    said = capsys.readouterr().out
    assert f"{what}/drag" in said and f"{what}/picture" in said
    assert {table.shape for table in tables} == {(12, poses.WIDTH)} and {image.shape for image in images} == {
        (48, 48, 3)
    }
    for sent in (tables, images):
        assert all((one != other).any() for one, other in itertools.pairwise(sent[1:])), "every drag differs"


def test_three_handles_are_held_and_one_is_in_hand():
    model = EditorModel(EditSession(bar_scene()))
    editing.hold(model)
    assert len(model.session.edit.handles) == editing.HANDLES == 3
    assert model.dragging and model.active == model.session.edit.handles[-1].name


def test_a_drag_moves_the_body_though_pieces_of_the_graph_lie_apart():
    """Of this figure, the control point furthest from all others has no neighbours."""
    session = EditSession(synthetic_scene("control-points", 3000, 1500, "cpu"))
    pieces = connected_components(session.graph.matrix, directed=False)[1]
    assert pieces.max() > 0, "the scene is one that can fail"
    model = EditorModel(session)
    model.pin_rings = None
    editing.hold(model)
    before = session.node_positions(0.0)
    model.drag(Target((0.0, session.graph.edge_length / session.engine.units[1], 0.0)))
    model.release()
    moved = np.linalg.norm(session.node_positions(0.0) - before, axis=1) > 1e-6
    assert moved[pieces == np.bincount(pieces).argmax()].all()


def test_what_cannot_be_dragged_is_said(tmp_path, capsys):
    assert app.cli(["edit", *TINY, "--motion", "hexplane"]) == 2
    assert "no control points" in capsys.readouterr().err
