"""Skin of posed parts: what Gaussians follow, how they stretch, and what stays as it is."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch

from scgs_warp.edit.engine import Engine
from scgs_warp.edit.graph import build_graph
from scgs_warp.edit.part_skin import LITTLE, part_skin, stretches_of
from scgs_warp.edit.playback import Hold
from scgs_warp.edit.rotations import IDENTITY, from_axis, rotate
from scgs_warp.errors import UserError


def cloud(seed: int = 0, count: int = 60):
    points = torch.rand(1, count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return points[0].numpy(), build_graph(points)


def test_gaussians_follow_their_part_and_its_joints_but_nothing_across_a_gap():
    """Control points in a row, three parts of 4; 5 and 9 are the ends of an arm and a trunk that lie side by side."""
    points = torch.zeros(1, 12, 3)
    points[0, :, 0] = torch.arange(12.0)
    graph, owner = build_graph(points, neighbors=2), np.repeat([0, 1, 2], 4)
    indices = torch.tensor([[5, 9, 4, 6], [3, 4, 2, 5], [9, 5, 8, 10]]).int()
    weights = torch.tensor([[0.4, 0.3, 0.2, 0.1], [0.5, 0.3, 0.1, 0.1], [0.6, 0.4, 0.0, 0.0]])
    skin = part_skin((indices, weights), owner, graph, dual=False)
    kept = skin.weights.numpy()
    np.testing.assert_allclose(kept.sum(1), 1.0, atol=1e-6)
    np.testing.assert_allclose(kept[0], np.array([0.4, 0.0, 0.2, 0.1]) / 0.7, atol=1e-6)
    near = np.array([graph.matrix[3, 4] > 0, graph.matrix[3, 5] > 0])
    assert near.tolist() == [True, True] or near[0], "a neighbour across a joint"
    np.testing.assert_allclose(kept[1, :3] / kept[1, 0], [1.0, 0.6, 0.2], atol=1e-6)
    np.testing.assert_allclose(kept[2], [1.0, 0.0, 0.0, 0.0], atol=1e-6)


def test_a_gaussian_of_weight_zero_keeps_a_control_point_of_its_part():
    points = torch.rand(1, 6, 3, generator=torch.Generator().manual_seed(2))
    indices = torch.tensor([[1, 2]]).int()
    skin = part_skin((indices, torch.zeros(1, 2)), np.zeros(6, np.int64), build_graph(points), dual=True)
    assert skin.weights.tolist() == [[1.0, 0.0]] and skin.dual


def test_stretches_are_those_of_the_map():
    points, graph = cloud()
    turn = from_axis((0.3, 1.0, -0.4), 70)
    wide = np.diag([1.6, 1.0, 0.8])
    posed = rotate(turn, points @ wide) + 2.0
    found = stretches_of(graph, points, posed, np.tile(turn, (len(points), 1)))
    inside = np.diff(graph.begin) >= 6
    assert np.abs(found[inside] - wide).max() < 20 * LITTLE and inside.sum() > 20
    rigid = stretches_of(graph, points, rotate(turn, points) - 1.0, np.tile(turn, (len(points), 1)))
    np.testing.assert_allclose(rigid, np.tile(np.eye(3), (len(points), 1, 1)), atol=1e-12)
    still = stretches_of(graph, points, points, np.tile(IDENTITY, (len(points), 1)))
    assert (still == np.eye(3)).all()


def test_without_a_turn_nothing_changes_by_a_bit(session):
    plain = session.scene.gaussians_at(0.3)
    for skin in ("parts", "dual", "nodes"):
        session.edit = dataclasses.replace(session.edit, skin=skin)
        found = session.gaussians_at(0.3)
        assert all(getattr(found, name).equal(getattr(plain, name)) for name in ("means", "quats", "scales"))


@pytest.mark.parametrize("skin", ["parts", "dual"])
def test_a_posed_limb_moves_as_a_body_and_the_rest_keeps_its_bits(session, skin):
    session.edit = dataclasses.replace(session.edit, skin=skin)
    before = session.gaussians_at(0.0)
    session.turn("shoulder_left", 70, (0, -1, 0))
    after = session.gaussians_at(0.0)
    names, owner = list(session.skeleton.names), session.skeleton.owners()
    nodes = session.engine.binding[0].numpy()
    still = (before.means == after.means).all(1).numpy()
    assert still[(owner[nodes] == names.index("knee_right")).all(1)].all() and not still.all()
    for name in ("quats", "scales", "sh_rest"):
        assert getattr(before, name)[still].equal(getattr(after, name)[still])
    motion = session._motion_of(session.edit, "elbow_left", 0.0, None)[0]
    tip = (owner[nodes] == names.index("elbow_left")).all(1)
    centre, scale = session.engine.units
    held = (before.means[tip].double().numpy() - centre) * scale
    wanted = session.engine.to_world(motion.apply(held))
    assert np.median(np.linalg.norm(after.means[tip].double().numpy() - wanted, axis=1)) < 0.03
    grown = (after.scales / before.scales).max(1).values
    assert 1.1 < float(grown.max()) < 2.5, "Gaussians widen where the shoulder opens"


def test_gaussians_do_not_depend_on_what_was_shown_before(session):
    """The engine keeps Gaussians as they are before parts are posed: other times and holds replace them."""
    session.turn("shoulder_left", 70, (0, -1, 0))
    turned = session.edit
    held = dataclasses.replace(turned, holds=(Hold(session.skeleton.part("knee_right").nodes, 0.8),))
    shown = [(edit, time) for edit in (turned, held, turned) for time in (0.0, 0.4, 0.0)]
    one = session.engine
    kept = [one.normalised(time, one.bend(edit, time)) for edit, time in shown]
    for found, (edit, time) in zip(kept, shown):
        fresh = Engine(session.scene)
        wanted = fresh.normalised(time, fresh.bend(edit, time))
        assert all(
            getattr(found, name).equal(getattr(wanted, name)) for name in ("means", "quats", "scales", "sh_rest")
        )
    assert not kept[0].means.equal(kept[1].means) and not kept[0].means.equal(kept[3].means)


def test_the_skin_is_saved_and_checked(session, tmp_path):
    session.turn("shoulder_left", 30, (0, -1, 0))
    session.apply(dataclasses.replace(session.edit, skin="dual"))
    session.save(tmp_path / "edit.json")
    edit = session.edit
    session.reset()
    session.load(tmp_path / "edit.json")
    assert session.edit == edit
    content = json.loads((tmp_path / "edit.json").read_text())
    content["skin"] = "leather"
    (tmp_path / "edit.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match="skin"):
        session.load(tmp_path / "edit.json")
