"""Decimation: sizes, shape, topology."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from scgs_warp.export.mesh.decimation import decimate
from scgs_warp.export.mesh.surface import Surface


def surface_of(mesh: trimesh.Trimesh) -> Surface:
    return Surface(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32))


@pytest.mark.parametrize(("name", "genus"), [("ball", 0), ("ring", 1), ("box", 0)])
def test_closed_surfaces_keep_their_topology_and_shape(name, genus):
    mesh = {
        "ball": lambda: trimesh.creation.icosphere(4),
        "ring": lambda: trimesh.creation.torus(1.0, 0.3, major_sections=64, minor_sections=32),
        "box": lambda: trimesh.creation.box((1, 2, 3)).subdivide().subdivide().subdivide().subdivide(),
    }[name]()
    seen: list[int] = []
    made = decimate(surface_of(mesh), 400, seen.append)
    small = trimesh.Trimesh(*made, process=False)
    assert len(made.faces) == 400 and seen == sorted(seen, reverse=True) and len(seen) > 2
    assert small.is_watertight and small.is_winding_consistent
    assert small.euler_number == 2 - 2 * genus and small.body_count == 1
    assert small.volume == pytest.approx(mesh.volume, rel=0.02 if name != "box" else 1e-3)
    assert (small.area_faces > 0).all()


def test_a_flat_sheet_keeps_its_border():
    x, y = np.meshgrid(np.linspace(0, 1, 21), np.linspace(0, 2, 41), indexing="ij")
    corner = (np.arange(20)[:, None] * 41 + np.arange(40)).ravel()
    faces = (corner[:, None, None] + np.array([[0, 41, 42], [0, 42, 1]])).reshape(-1, 3)
    sheet = Surface(np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]), faces.astype(np.int32))
    made = decimate(sheet, 60)
    small = trimesh.Trimesh(*made, process=False)
    assert len(made.faces) <= 60
    assert small.area == pytest.approx(2.0, rel=1e-3)
    np.testing.assert_allclose(small.bounds, [[0, 0, 0], [1, 2, 0]], atol=2e-3)
    assert (small.face_normals[:, 2] > 0.99).all()


def test_small_surfaces_are_returned_as_they_are():
    surface = surface_of(trimesh.creation.icosphere(1))
    assert decimate(surface, 80) is surface


def test_it_ends_where_topology_allows_no_further_collapse():
    made = decimate(surface_of(trimesh.creation.icosphere(2)), 1)
    assert 4 <= len(made.faces) <= 40
    assert trimesh.Trimesh(*made, process=False).is_watertight


def test_every_run_gives_the_same_bits():
    surface = surface_of(trimesh.creation.icosphere(3))
    first, second = decimate(surface, 300), decimate(surface, 300)
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.faces, second.faces)
