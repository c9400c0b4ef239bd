"""The graph of control points: its edges, its gaps, and strays."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from helpers.edit_scenes import bar_scene
from helpers.edit_sessions import TURN, cloud, graph_of, motion, part
from scgs_warp.edit import EditSession, build_graph

X, Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def test_the_graph_is_symmetric_and_parts_that_move_apart_are_not_tied():
    left, right = cloud(12, 40, (0.3, 1, 1)), cloud(13, 40, (0.3, 1, 1)) + 0.5 * X
    still = np.concatenate([left, right])
    apart = np.concatenate([left, right + 20 * X])
    tied = graph_of(still)
    assert (tied.matrix != tied.matrix.T).nnz == 0
    assert any((a < 40) != (b < 40) for a, b in tied.edges)
    free = build_graph(torch.from_numpy(np.stack([still, apart])).float())
    assert not any((a < 40) != (b < 40) for a, b in free.edges)
    assert set(tied.ring([0], 1)) == {0, *tied.neighbors[tied.begin[0] : tied.begin[1]].tolist()}
    assert tied.ring([0], 0) == (0,) and tied.ring([], 3) == ()


def test_a_gap_stays_a_gap_where_nothing_moves():
    """Two plates face each other, about as far apart as their control points: Gaussians say that they are two."""
    grid = np.stack(np.meshgrid(np.arange(8), np.arange(8), [0.0]), -1).reshape(-1, 3)
    plates = np.concatenate([grid, grid + 1.2 * Z])
    fine = np.stack(np.meshgrid(np.linspace(0, 7, 50), np.linspace(0, 7, 50), [0.0, 1.2]), -1).reshape(-1, 3)
    shared = np.argsort(np.linalg.norm(fine[:, None] - plates[None], axis=-1), axis=1)[:, :2]
    near = build_graph(torch.from_numpy(plates).float()[None])
    apart = build_graph(torch.from_numpy(plates).float()[None], shared=shared)
    crossing = [sum((a < 64) != (b < 64) for a, b in graph.edges) for graph in (near, apart)]
    assert crossing[0] > 50 and crossing[1] == 0


def test_strays_follow_their_nearest_neighbour():
    rest = np.concatenate([cloud(14, 60), [[9.0, 0, 0]], [[500.0, 0, 0]]])
    graph = graph_of(rest)
    assert graph.stray[60] in range(60) and graph.stray[61] == 61 and (graph.stray[:60] == -1).all()


STRAY = (2.2, 0.0, 0.0)


@pytest.fixture
def straying() -> EditSession:
    session = EditSession(bar_scene(stray=STRAY))
    assert session.graph.stray[60] in part(session, 0.8, 1.0) and len(session.graph.led) == 1
    return session


def test_a_stray_that_is_pinned_or_held_stays(straying):
    right, rest = part(straying, 0.8, 1.0), motion(straying, 0.0)
    straying.add_handle(right, 0.0, "right")
    straying.move("right", [0.0, 0.1, 0.0], TURN)
    assert np.abs(straying.node_positions(0.0) - rest)[60].max() > 0.2, "left alone it goes along"
    straying.pin([60])
    np.testing.assert_array_equal(straying.node_positions(0.0)[60], rest[60])
    straying.unpin()
    straying.add_handle([60], 0.0, "stray")
    np.testing.assert_array_equal(straying.node_positions(0.0)[60], rest[60])
    straying.move("stray", [0.3, 0.0, 0.0])
    np.testing.assert_allclose(straying.node_positions(0.0)[60], rest[60] + [0.3, 0.0, 0.0], atol=1e-9)


def test_pinning_the_rest_leaves_no_stray_behind(straying):
    straying.add_handle(part(straying, 0.8, 1.0), 0.0, "right")
    straying.pin_rest(1)
    assert 60 not in straying.edit.pins and len(straying.edit.pins) > 20
    straying.reset()
    straying.add_handle(part(straying, 0.0, 0.2), 0.0, "left")
    straying.pin_rest(1)
    assert 60 in straying.edit.pins
    straying.move("left", [0.0, 0.1, 0.0])
    np.testing.assert_array_equal(straying.node_positions(0.3)[60], motion(straying, 0.3)[60])
