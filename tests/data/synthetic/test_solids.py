"""Meshes of solids and sheets: closed, facing outward, of the right size."""

from __future__ import annotations

import numpy as np
import pytest

from scgs_warp.data.synthetic.sheets import grid, sheet, sheet_faces
from scgs_warp.data.synthetic.solids import capsule, disc, lathe, rounded_box, slab, torus, vertex_normals

RING = np.array([(0.2, 0.0), (0.3, 0.0), (0.35, 0.4), (0.2, 0.3)])


def wave(rows: int = 9, columns: int = 7) -> np.ndarray:
    u, v = grid(np.linspace(0, 1, rows), np.linspace(0, 0.6, columns))
    return np.stack([u, v, 0.1 * np.sin(5 * u + 2 * v)], -1)


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return float(np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize(
    "mesh",
    [
        rounded_box((0.3, 0.2, 0.4), 0.1),
        rounded_box((0.2, 0.2, 0.2), 0.2, 12),
        torus(0.4, 0.1, 24),
        capsule(0.5, 0.1, 0.07),
        slab((0.3, 0.2, 0.1), 0.07),
        disc(0.5, 0.05, 0.06),
        lathe(RING, 24),
        sheet(wave(), 0.01),
    ],
)
def test_solids_are_closed_and_face_outward(mesh):
    vertices, faces = mesh
    places, weld = np.unique(np.round(vertices, 9), axis=0, return_inverse=True)
    welded = weld.reshape(-1)[faces]
    edges = np.concatenate([welded[:, [0, 1]], welded[:, [1, 2]], welded[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)  # each directed edge once ...
    assert {tuple(edge) for edge in edges} == {tuple(edge[::-1]) for edge in edges}  # ... and once the other way
    assert volume(vertices, faces) > 0 and len(places) <= len(vertices) == faces.max() + 1
    assert np.abs(np.linalg.norm(vertex_normals(vertices, faces), axis=1) - 1).max() < 1e-9


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (rounded_box((0.2, 0.2, 0.2), 0.2, 12), 4 / 3 * np.pi * 0.2**3),
        (capsule(0.5, 0.1, 0.1, 40), np.pi * 0.1**2 * 0.5 + 4 / 3 * np.pi * 0.1**3),
        (slab((0.3, 0.2, 0.1), 0.07), 0.6 * 0.4 * 0.2),
        (disc(0.5, 0.05, 0.02), np.pi * 0.5**2 * 0.1),
        (lathe(RING, 200), 0.0425 * 2 * np.pi * 0.26569),
    ],
)
def test_solids_have_their_volume(mesh, expected):
    """The ring's profile has the area 0.0425 and its centroid at radius 0.26569 (Pappus)."""
    assert volume(*mesh) == pytest.approx(expected, rel=0.025)


def test_ball_is_round():
    vertices, _ = rounded_box((0.2, 0.2, 0.2), 0.2, 12)
    assert np.abs(np.linalg.norm(vertices, axis=1) - 0.2).max() < 1e-12


@pytest.mark.parametrize("sides", [6, 10])
def test_rods_are_as_wide_as_asked_on_average(sides):
    vertices, _ = capsule(0.5, 0.1, 0.07, sides)
    angles = np.linspace(0, np.pi, 400, endpoint=False)
    across = vertices[:, :2] @ np.stack([np.cos(angles), np.sin(angles)])
    assert (across.max(0) - across.min(0)).mean() == pytest.approx(0.2, rel=1e-3)
    assert vertices[:, 2].max() == pytest.approx(0.35, rel=0.03)


def test_sides_of_a_sheet():
    middle = wave()
    vertices, faces = sheet(middle, 0.01)
    again, sides = sheet_faces(*middle.shape[:2])
    assert (faces == again).all() and set(sides) == {0, 1, 2}
    normals = vertex_normals(vertices, faces)
    count = middle.shape[0] * middle.shape[1]
    assert normals[:count, 2].min() > 0.5 and normals[count : 2 * count, 2].max() < -0.5
    assert np.abs(vertices[:count] + vertices[count : 2 * count] - 2 * middle.reshape(-1, 3)).max() < 1e-12
    assert np.allclose(np.linalg.norm(vertices[:count] - vertices[count : 2 * count], axis=1), 0.02)
    outward = normals[2 * count :] @ [0, 0, 1.0]
    assert np.abs(outward).max() < 0.8  # the rim looks sideways
