"""Cameras that record pictures of one size, with one lens or with lenses of their own."""

from __future__ import annotations

import pytest

from helpers import textured_corner as corner
from scgs_warp.capture import features
from scgs_warp.capture.rig import cameras
from scgs_warp.capture.rig.own_lenses import describe_lenses, prefer_own_lenses


@pytest.mark.parametrize("zoom", [1.0, 1.4])
def test_lenses_are_told_apart(tmp_path, zoom):
    true = corner.true_cameras(angles=(-18.0, -6.0, 6.0, 18.0))
    true[1] = true[1]._replace(params=(zoom * corner.FOCAL, *true[1].params[1:]))
    files = corner.stills(tmp_path, true)
    database, model = tmp_path / "database.db", tmp_path / "model"
    features.begin(database, files, "SIMPLE_RADIAL", None)
    features.extract(database, files, 700, lambda: None)
    features.match(database, files, cameras.pairs_of(4), 0, "cpu", lambda: None)
    cameras.solve(database, files, model, 0)
    prefer_own_lenses(database, files, model, "SIMPLE_RADIAL", None, 0, "cpu")
    solved = cameras.read_solution(model, files.names)
    assert solved is not None and len(solved.cameras) == 4
    focals = [camera.params[0] for camera in solved.cameras.values()]
    assert focals == pytest.approx([camera.params[0] for camera in true.values()], rel=0.05)
    assert len(describe_lenses(solved)) == (zoom > 1.0) and (len(set(focals)) == 1) == (zoom == 1.0)
    assert {path.name for path in tmp_path.iterdir()} == {"stills", "masks", "database.db", "model"}
