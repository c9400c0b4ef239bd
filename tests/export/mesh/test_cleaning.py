"""Cleaning of surfaces: islands, cavities, noise."""

from __future__ import annotations

import numpy as np
import trimesh

from scgs_warp.export.mesh.cleaning import clean, smooth, without_islands
from scgs_warp.export.mesh.surface import Surface


def ball(radius: float, centre=(0.0, 0.0, 0.0), detail: int = 3, inverted: bool = False) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(detail, radius)
    mesh.apply_translation(centre)
    if inverted:
        mesh.invert()
    return mesh


def joined(*meshes: trimesh.Trimesh) -> Surface:
    whole = trimesh.util.concatenate(meshes)
    return Surface(np.asarray(whole.vertices, np.float64), np.asarray(whole.faces, np.int32))


def test_islands_and_cavities_are_left_out_and_parts_are_kept():
    small, crumb, bubble = ball(0.2, (2, 0, 0)), ball(0.015, (0, 2, 0)), ball(0.3, inverted=True)
    surface = joined(ball(1.0), small, crumb, bubble)
    kept = trimesh.Trimesh(*without_islands(surface, closed=True), process=False)
    assert kept.body_count == 2 and kept.is_watertight
    assert kept.volume == ball(1.0).volume + small.volume
    opened = trimesh.Trimesh(*without_islands(surface, closed=False), process=False)
    assert opened.body_count == 3  # an open surface has no inside


def test_smoothing_removes_noise_and_keeps_the_volume():
    rng = np.random.default_rng(0)
    true = joined(ball(1.0, detail=4))
    rough = Surface(true.vertices * (1 + 0.01 * rng.standard_normal((len(true.vertices), 1))), true.faces)
    smoothed = smooth(rough)
    before, after = (np.abs(np.linalg.norm(s.vertices, axis=1) - 1).mean() for s in (rough, smoothed))
    assert after < 0.5 * before
    volumes = [trimesh.Trimesh(*s, process=False).volume for s in (true, smoothed)]
    assert abs(volumes[1] / volumes[0] - 1) < 0.005


def test_smoothing_leaves_open_borders_where_they_are():
    whole = ball(1.0)
    half = whole.submesh([np.flatnonzero(whole.triangles_center[:, 2] > 0)], append=True)
    surface = Surface(np.asarray(half.vertices), np.asarray(half.faces, np.int32))
    border = np.unique(half.edges_sorted[trimesh.grouping.group_rows(half.edges_sorted, require_count=1)])
    moved = smooth(surface)
    np.testing.assert_array_equal(moved.vertices[border], surface.vertices[border])
    assert np.abs(moved.vertices - surface.vertices).max() > 1e-4


def test_nothing_stays_nothing():
    empty = Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    assert clean(empty, True).faces.shape == (0, 3)
