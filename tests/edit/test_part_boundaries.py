"""Boundaries of parts: how wide they are, and what follows for joints."""

from __future__ import annotations

import math

import numpy as np
import pytest

from helpers.jointed_rods import TIMES, chain, plain_width, same_partition
from scgs_warp.edit import parts
from scgs_warp.edit.joints import find_joints
from scgs_warp.edit.parts import LEAST_TURN, find_parts
from scgs_warp.edit.patches import make_patches
from scgs_warp.edit.rotations import from_axis, rotate


def grid_edges(rows: int, columns: int) -> np.ndarray:
    """Edges of a surface of rows x columns patches, each with six neighbours but at its ends; rows are closed, as
    around a limb."""
    at = np.arange(rows * columns).reshape(rows, columns)
    beside = np.roll(at, -1, axis=1)
    pairs = [(at, beside), (at[:-1], at[1:]), (at[:-1], beside[1:])]
    return np.concatenate([np.stack([first.ravel(), second.ravel()], 1) for first, second in pairs])


@pytest.mark.parametrize("length", [4, 12, 40])
def test_boundaries_are_as_wide_as_they_are_long_for_their_parts(length):
    """Around a limb of 8 patches, a boundary is as long as the root of the ratio of girth and length, relative to the
    root of the smaller part's area."""
    labels = np.repeat([0, 1], [8 * length, 8 * 60])
    edges = grid_edges(length + 60, 8)
    (width,) = parts._widths(edges, labels, np.array([[0, 1]]))
    assert width == pytest.approx(plain_width(edges, labels, np.array([0, 1])))
    assert width * parts.USUAL_WIDTH == pytest.approx(math.sqrt(8 / length), rel=0.02)


def test_widths_are_those_of_each_pair():
    """Three rings of a tube: the third and the first do not touch; the order of an edge's ends does not matter."""
    edges, labels = grid_edges(12, 5), np.repeat([2, 0, 1], [10, 20, 30])
    pairs = np.array([[0, 1], [0, 2], [1, 2]])
    expected = [plain_width(edges, labels, pair) for pair in pairs]
    np.testing.assert_allclose(parts._widths(edges, labels, pairs), expected)
    np.testing.assert_allclose(parts._widths(edges[:, ::-1], labels, pairs), expected)
    assert expected[0] > 0.0 and expected[2] == 0.0


def two_halves(degrees: float, waist: int) -> np.ndarray:
    """Labels found in a sheet of 8 x 24 patches whose halves, 4 x 24 each, turn against each other. Of the 24 patches
    along their boundary, ``waist`` are joined across it."""
    rest = np.random.default_rng(0).random((192 * 25, 3)) * [8.0, 24.0, 0.0]
    nearest = rest[:, 0].astype(np.int64) * 24 + rest[:, 1].astype(np.int64)
    pivot, tracks = np.array([4.0, 12.0, 0.0]), []
    for time in TIMES:
        turn = from_axis((0, 0, 1), degrees * 0.5 * (1.0 - math.cos(2.0 * math.pi * time)))
        tracks.append(np.where(rest[:, :1] > 4.0, rotate(turn, rest - pivot) + pivot, rest))
    patches = make_patches(np.stack(tracks), nearest[:, None], np.ones((len(rest), 1)))
    at = np.arange(192).reshape(8, 24)
    edges = [np.stack([at[:, :-1].ravel(), at[:, 1:].ravel()], 1), np.stack([at[3, :waist], at[4, :waist]], 1)]
    edges += [np.stack([half[:-1].ravel(), half[1:].ravel()], 1) for half in (at[:4], at[4:])]
    return find_parts(patches._replace(edges=np.concatenate(edges)))


def test_narrow_boundaries_are_joints_at_smaller_angles():
    assert two_halves(12.5, waist=2).max() == 1
    assert two_halves(12.5, waist=24).max() == 0
    assert two_halves(9.0, waist=2).max() == 0
    patches, _, _ = chain([9.0, 30.0])
    assert find_parts(patches).max() == 1
    patches, _, _ = chain([3.0, 2.0])
    assert find_parts(patches).max() == 0
    assert math.degrees(LEAST_TURN) == pytest.approx(15)


def test_a_joint_at_a_small_angle_is_a_joint_like_any_other():
    patches, segment, joints = chain([13.0])
    labels = find_parts(patches)
    assert same_partition(labels, segment)
    (joint,) = [joint for joint in find_joints(patches, labels) if joint.parent >= 0]
    assert np.linalg.norm((joint.point - joints[0])[[0, 2]]) < 0.03 and joint.confidence > 0.5
    assert joint.axis is not None and abs(joint.axis[1]) > math.cos(math.radians(10))


def test_the_doubt_of_a_wide_boundary_is_limited(monkeypatch):
    """Two rows of patches lie side by side."""
    asked: list[float] = []

    def shared(moments, labels, motions, pairs, doubt, fit):
        asked.extend(doubt.tolist())

    monkeypatch.setattr(parts, "find_shared", shared)
    monkeypatch.setattr(parts, "relative_turns", lambda *args: np.radians([60.0]))
    nearest = np.repeat(np.arange(160), 9)
    rest = np.stack([nearest // 80, nearest % 80, 0 * nearest], 1) + np.random.default_rng(0).random((1440, 3))
    patches = make_patches(np.stack([rest] * len(TIMES)), nearest[:, None], np.ones((len(rest), 1)))
    at = np.arange(160).reshape(2, 80)
    edges = [np.stack([at[:, :-1].ravel(), at[:, 1:].ravel()], 1), at.T]
    patches = patches._replace(edges=np.concatenate(edges))
    labels = np.repeat([0, 1], 80)
    monkeypatch.setattr(parts, "_merge_by_cost", lambda patches, count: labels)
    monkeypatch.setattr(parts, "_refined", lambda patches, labels, fits: labels)
    find_parts(patches)
    width = parts._widths(patches.edges, labels, np.array([[0, 1]]))[0]
    assert width > parts.MOST_DOUBT and asked == [parts.MOST_DOUBT]


def test_each_pair_has_the_doubt_of_its_own_boundary(monkeypatch):
    """Three pieces of a sheet: between the first two, which turn far, one edge is left."""
    asked: list[tuple[list[int], float]] = []

    def shared(moments, labels, motions, pairs, doubt, fit):
        asked.extend(zip(pairs.tolist(), doubt.tolist()))

    monkeypatch.setattr(parts, "find_shared", shared)
    monkeypatch.setattr(parts, "find_band", lambda *args: None)
    monkeypatch.setattr(parts, "relative_turns", lambda *args: np.radians([120.0, 60.0]))
    nearest = np.repeat(np.arange(240), 9)
    rest = np.stack([nearest // 80, nearest % 80, 0 * nearest], 1) + np.random.default_rng(0).random((2160, 3))
    patches = make_patches(np.stack([rest] * len(TIMES)), nearest[:, None], np.ones((len(rest), 1)))
    at = np.arange(240).reshape(3, 80)
    edges = [np.stack([at[:, :-1].ravel(), at[:, 1:].ravel()], 1), at[:2, :1].T, at[1:].T]
    patches = patches._replace(edges=np.concatenate(edges))
    labels = np.repeat([0, 1, 2], 80)
    monkeypatch.setattr(parts, "_merge_by_cost", lambda patches, count: labels)
    monkeypatch.setattr(parts, "_refined", lambda patches, labels, fits: labels)
    find_parts(patches)
    narrow, wide = parts._widths(patches.edges, labels, np.array([[0, 1], [1, 2]]))
    assert narrow < 1.0 < wide and asked == [([1, 2], min(wide, parts.MOST_DOUBT))]
