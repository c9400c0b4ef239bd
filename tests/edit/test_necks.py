"""Parts of shapes that never moved."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from helpers.edit_scenes import bar_scene, figure_scene
from scgs_warp.edit import EditSession
from scgs_warp.edit.necks import find_necks
from scgs_warp.edit.parts import find_parts
from scgs_warp.edit.patches import make_patches
from scgs_warp.edit.skeleton_from_motion import find_skeleton, moves
from scgs_warp.runtime import environment
from scgs_warp.types import Pose


def grid(shape: tuple[int, int], away: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    return np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).reshape(-1, 2) + np.array(away)


def edges_of(points: np.ndarray) -> np.ndarray:
    near = np.linalg.norm(points[:, None] - points[None], axis=2) < 1.5
    first, second = np.nonzero(np.triu(near, 1))
    return np.stack([first, second], 1)


def dumbbell() -> tuple[np.ndarray, np.ndarray]:
    """Three squares of 64, 36 and 64 points in a row, with two bridges of one point each."""
    points = np.concatenate(
        [grid((8, 8)), [[8.0, 4.0]], grid((6, 6), (9.0, 1.0)), [[15.0, 4.0]], grid((8, 8), (16, 0))]
    )
    return points, np.repeat([0, 3, 1, 4, 2], [64, 1, 36, 1, 64])


def test_squares_on_bridges_fall_apart_at_the_bridges():
    points, square = dumbbell()
    labels = find_necks(edges_of(points), len(points))
    assert labels.max() == 2
    for row in range(3):
        assert len(set(labels[square == row].tolist())) == 1, "a square stays whole"
    assert len({int(labels[square == row][0]) for row in range(3)}) == 3
    assert (np.diff(np.bincount(labels)) <= 0).all(), "by decreasing size"


def test_a_shape_without_a_neck_is_one_piece():
    for shape in ((20, 6), (12, 12), (40, 3)):
        points = grid(shape).astype(float)
        assert find_necks(edges_of(points), len(points)).max() == 0
    assert find_necks(np.zeros((0, 2), np.int64), 1).tolist() == [0]


@pytest.mark.parametrize("count", [1, 2, 4])
def test_the_number_can_be_given(count):
    points, _ = dumbbell()
    assert find_necks(edges_of(points), len(points), count).max() + 1 == count


def test_components_stay_apart():
    points = np.concatenate([grid((5, 5)), grid((5, 5), (30.0, 0.0))])
    labels = find_necks(edges_of(points), len(points), 1)
    assert labels.tolist() == [0] * 25 + [1] * 25


def still(scene):
    """Return the scene with a motion that stays at time 0."""
    motion = scene.motion
    first = motion.poses(torch.zeros(1))[0]
    motion.poses = lambda times: [Pose(first.translations, first.rotations) for _ in times]
    return scene


def test_a_figure_that_stands_still_falls_into_limbs_and_says_why():
    scene, _, bones = figure_scene(256)
    session = EditSession(still(scene))
    skeleton = session.skeleton
    assert skeleton.source == "geometry" and 3 <= len(skeleton.parts) <= 12
    assert all(part.confidence == 0.0 and part.axis is None for part in skeleton.parts)
    found = session.gaussian_parts()
    own = {bone: np.bincount(found[bones == bone]) for bone in ("head", "knee_left", "knee_right")}
    best = {bone: int(counts.argmax()) for bone, counts in own.items()}
    assert len(set(best.values())) == 3, "head and feet are apart"
    assert all(counts.max() > 0.9 * counts.sum() for counts in own.values())
    assert len(session.parts(3)) == 3


def test_a_body_that_only_travels_does_not_move():
    scene = bar_scene()
    session = EditSession(scene)
    indices, weights = (x.numpy() for x in session.engine.binding)
    start = scene.gaussians_at(0.0).means.double().numpy()
    tracks = np.stack([start + time * np.array([1.0, 2.0, 0.5]) for time in np.linspace(0, 1, 5)])
    assert not moves(make_patches(tracks, indices, weights))
    assert find_skeleton(scene, (indices, weights)).source == "motion"


def test_bodies_that_travel_apart_move():
    start = np.random.default_rng(0).random((400, 3)) + np.repeat([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]], 200, axis=0)
    index = np.arange(400) // 20
    around = np.stack([index, index // 10 * 10 + (index + 1) % 10], 1)
    rise = np.outer(index >= 10, [0.0, 0.0, 1.0])
    patches = make_patches(np.stack([start, start + rise]), around, np.tile([0.6, 0.4], (400, 1)))
    assert moves(patches)
    assert np.array_equal(find_parts(patches), (np.arange(20) >= 10).astype(int))


def test_necks_do_not_depend_on_threads(all_threads):
    points, _ = dumbbell()
    found = []
    for threads in (1, 2):
        environment.configure(threads=threads)
        found.append(find_necks(edges_of(points), len(points)))
    assert np.array_equal(*found)
