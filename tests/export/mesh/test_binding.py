"""Binding of meshes to control points."""

from __future__ import annotations

import numpy as np
import trimesh

from scgs_warp.edit.rotations import IDENTITY, from_axis, rotate
from scgs_warp.export.mesh.binding import bind, clearest_frame, posed, sample_frames
from scgs_warp.export.mesh.surface import Surface
from scgs_warp.export.skeleton import Skeleton

FRAMES = 5
REACHES = np.array([0.0, 30.0, 60.0, 90.0, 120.0])
"""Degrees by which the second part is turned about its own centre, which also moves away from the first part."""


def two_parts(gaussians: int = 600) -> tuple[Skeleton, np.ndarray]:
    """Two balls that touch at frame 0 and part; the second one turns. Returns the skeleton and tracks [T, N, 3]."""
    rng = np.random.default_rng(0)
    unit = rng.standard_normal((gaussians, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    second = np.arange(gaussians) >= gaussians // 2
    nodes = np.concatenate([0.5 * trimesh.creation.icosphere(1).vertices, 0.5 * trimesh.creation.icosphere(1).vertices])
    node_second = np.arange(len(nodes)) >= len(nodes) // 2
    positions, rotations, tracks = [], [], []
    for frame, degrees in enumerate(REACHES):
        turn = from_axis((0, 0, 1), degrees)
        away = np.array([1.02 + 0.4 * frame, 0, 0])
        move = lambda points, moved: np.where(moved[:, None], rotate(turn, points) + away, points)  # noqa: B023, E731
        positions.append(move(nodes, node_second))
        rotations.append(np.where(node_second[:, None], turn, IDENTITY))
        tracks.append(move(0.5 * unit, second))
    distance = np.linalg.norm(tracks[0][:, None] - positions[0][None], axis=2)
    near = np.argsort(distance + 9.0 * (second[:, None] != node_second), axis=1)[:, :4]
    rest = positions[0].copy()
    times = np.linspace(0, 1, FRAMES)
    fields = (None, None, None, near.astype(np.int32), np.full(near.shape, 0.25))
    return Skeleton(times, times, rest, np.stack(positions), np.stack(rotations), *fields), np.stack(tracks)


def surface_at(frame: int) -> Surface:
    balls = [trimesh.creation.icosphere(3, 0.5) for _ in range(2)]
    turned = rotate(from_axis((0, 0, 1), REACHES[frame]), balls[1].vertices)
    balls[1].vertices = turned + np.array([1.02 + 0.4 * frame, 0, 0])
    whole = trimesh.util.concatenate(balls)
    return Surface(np.asarray(whole.vertices), np.asarray(whole.faces, np.int32))


def test_a_frame_without_contacts_and_near_all_others_is_chosen():
    skeleton, _ = two_parts()
    assert clearest_frame(skeleton) == 2
    still = Skeleton(**{**vars(skeleton), "positions": np.repeat(skeleton.positions[:1], FRAMES, axis=0)})
    assert clearest_frame(still) == 0
    touching = skeleton.positions.copy()
    touching[2] = touching[0]
    assert clearest_frame(Skeleton(**{**vars(skeleton), "positions": touching})) in (1, 3)


def test_vertices_follow_their_part_even_where_parts_touch():
    skeleton, tracks = two_parts()
    surface = surface_at(0)
    bound = bind(surface, tracks, skeleton)
    np.testing.assert_allclose(bound.weights.sum(axis=1), 1.0, atol=1e-12)
    assert bound.indices.shape[1] == 4 and (bound.weights >= 0).all()
    np.testing.assert_allclose(posed(surface.vertices, bound, 0, 0), surface.vertices, atol=1e-12)
    for frame in range(1, FRAMES):
        true = surface_at(frame).vertices
        error = np.linalg.norm(posed(surface.vertices, bound, 0, frame) - true, axis=1)
        assert np.quantile(error, 0.99) < 0.01, frame  # where they touch, some vertices are nearer to the other part


def test_frames_are_spread_evenly():
    np.testing.assert_array_equal(sample_frames(5, 12), np.arange(5))
    np.testing.assert_array_equal(sample_frames(31, 4), [0, 10, 20, 30])
    np.testing.assert_array_equal(sample_frames(1, 4), [0])
