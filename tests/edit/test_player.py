"""Holds and exaggeration of a scene's own motion."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from helpers.edit_scenes import bar_scene
from helpers.edit_sessions import motion, part
from scgs_warp.edit import Edit, EditSession, Exaggerate, Hold


def test_a_held_region_keeps_its_pose_while_the_rest_moves():
    scene = bar_scene()
    session = EditSession(scene)
    x = session.node_positions(0.0)[:, 0]
    right = tuple(np.flatnonzero(x > np.quantile(x, 0.75)).tolist())
    left = np.flatnonzero(x < np.quantile(x, 0.3))
    session.apply(Edit(holds=(Hold(right, 0.0, "world"),)))
    start = session.engine.to_world(session.engine.motion_at(0.0).positions)
    moved = session.engine.to_world(session.engine.motion_at(1.0).positions)
    assert np.abs(moved - start)[list(right)].max() > 0.2
    found = session.node_positions(1.0)
    np.testing.assert_allclose(found[list(right)], start[list(right)], atol=1e-9)
    np.testing.assert_array_equal(found[left], moved[left])
    assert torch.equal(session.gaussians_at(0.0).means, scene.gaussians_at(0.0).means), "at its own time it is no edit"
    # Gaussians that hang on held control points alone look as they did: same place, same shape, same colours
    own = torch.isin(session.engine.binding[0].long(), torch.tensor(right)).all(1)
    before, after = scene.gaussians_at(0.0), session.gaussians_at(1.0)
    torch.testing.assert_close(after.means[own], before.means[own], rtol=0, atol=1e-5)
    torch.testing.assert_close(after.quats[own].abs(), before.quats[own].abs(), rtol=0, atol=1e-5)
    torch.testing.assert_close(after.sh_rest[own], before.sh_rest[own], rtol=0, atol=1e-5)
    session.apply(Edit(holds=(Hold(right, 0.0, "body"),)))
    body = session.node_positions(1.0)
    assert np.abs(body - moved)[list(right)].max() > 0.01, "it does not bend on"
    assert np.abs(body - start)[list(right)].max() > 0.2, "it goes along with what it hangs on"
    lengths = [np.linalg.norm(p[list(right)] - p[right[0]], axis=1) for p in (start, body)]
    np.testing.assert_allclose(lengths[1], lengths[0], atol=1e-9)


def test_exaggeration_turns_further_and_keeps_lengths():
    scene = bar_scene()
    session = EditSession(scene)
    start = session.engine.to_world(session.engine.motion_at(0.0).positions)
    centre = np.array([0.5, -1.0, 0.25])
    far = np.flatnonzero(start[:, 0] > 0.9)

    def swing(factor: float, about: float | None = 0.0) -> float:
        session.apply(Edit(exaggerate=Exaggerate(factor, about)))
        moved = session.node_positions(1.0)[far] - centre
        return float(np.degrees(np.median(np.arctan2(-moved[:, 2], moved[:, 0]))))

    assert swing(1.5) == pytest.approx(90.0, abs=8.0)
    assert swing(0.5) == pytest.approx(30.0, abs=5.0)
    edges = session.graph.edges
    lengths = [np.linalg.norm(p[edges[:, 0]] - p[edges[:, 1]], axis=1) for p in (start, session.node_positions(1.0))]
    assert np.percentile(np.abs(lengths[1] / lengths[0] - 1), 95) < 0.25
    session.apply(Edit(exaggerate=Exaggerate(1.0)))
    assert torch.equal(session.gaussians_at(1.0).means, scene.gaussians_at(1.0).means)
    session.apply(Edit(exaggerate=Exaggerate(2.0, None, tuple(far.tolist()))))
    others = np.setdiff1d(np.arange(len(session)), far)
    moved = session.engine.to_world(session.engine.motion_at(1.0).positions)
    np.testing.assert_array_equal(session.node_positions(1.0)[others], moved[others])


def test_edits_compose_with_holds_and_exaggeration():
    session = EditSession(bar_scene())
    x = session.node_positions(0.0)[:, 0]
    right = np.flatnonzero(x > np.quantile(x, 0.8))
    session.apply(Edit(exaggerate=Exaggerate(1.5, 0.0), holds=(Hold((0, 1), 0.5),)))
    base = session.node_positions(0.7)
    session.add_handle(right, 0.7, "right")
    np.testing.assert_array_equal(session.node_positions(0.7), base)
    session.move("right", [0.0, 0.3, 0.0])
    np.testing.assert_allclose(session.node_positions(0.7)[right], base[right] + [0, 0.3, 0], atol=1e-9)


STRAY = (2.2, 0.0, 0.0)


@pytest.fixture
def straying() -> EditSession:
    session = EditSession(bar_scene(stray=STRAY))
    assert session.graph.stray[60] in part(session, 0.8, 1.0) and len(session.graph.led) == 1
    return session


def test_strays_follow_in_holds_and_exaggeration(straying):
    right = tuple(part(straying, 0.7, 1.0).tolist())
    straying.apply(Edit(holds=(Hold(right, 0.0, "world"),)))
    start, end = motion(straying, 0.0), motion(straying, 1.0)
    assert np.abs(end - start)[60].max() > 0.5
    np.testing.assert_allclose(straying.node_positions(1.0)[60], start[60], atol=1e-9)
    straying.apply(Edit(exaggerate=Exaggerate(1.5, 0.0)))
    leader = straying.graph.stray[60]
    bent = straying.engine.bend(straying.edit, 1.0)
    assert bent is not None
    np.testing.assert_allclose(bent.turns[60], bent.turns[leader])
    found = straying.node_positions(1.0)
    away = [np.linalg.norm(x[60] - x[leader]) for x in (start, found)]
    assert away[1] == pytest.approx(away[0], rel=1e-6)
    assert np.degrees(np.arctan2(-(found[60, 2] - 0.25), found[60, 0] - 0.5)) == pytest.approx(90, abs=10)
