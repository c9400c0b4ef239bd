"""Colours of vertices."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from helpers.mesh_scenes import ball_gaussians, still_scene
from scgs_warp.export.mesh import colors
from scgs_warp.export.mesh.colors import PosedMesh, paint, vertex_normals
from scgs_warp.export.mesh.views import surroundings_of

RED, BLUE = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


@pytest.fixture(autouse=True)
def small_views(monkeypatch):
    monkeypatch.setattr(colors, "SIZE", 256)


@torch.no_grad()
def painted(vertices: np.ndarray, faces: np.ndarray, seen: list[int]) -> np.ndarray:
    """Paint a mesh in normalised units by the ball of radius 0.5, red above and blue below."""
    scene = still_scene(ball_gaussians())
    gaussians = scene.motion.gaussians_at(scene.gaussians, 0.0)
    made = lambda: PosedMesh(vertices, gaussians)  # noqa: E731
    advance = lambda: seen.append(1)  # noqa: E731
    return paint(surroundings_of(scene, gaussians), [made, made, made], faces, advance)


def test_vertices_have_the_colours_of_the_gaussians_that_they_show():
    mesh, seen = trimesh.creation.icosphere(4, 0.503), []
    found = painted(mesh.vertices - (0.2, -0.1, 0.3), mesh.faces, seen)
    above, below = mesh.vertices[:, 2] > 0.1, mesh.vertices[:, 2] < -0.1
    assert np.abs(found[above] - RED).max() < 0.05 and np.abs(found[below] - BLUE).max() < 0.05
    assert len(seen) == 32


def test_hidden_vertices_take_the_colours_around_them():
    outer, inner = trimesh.creation.icosphere(3, 0.503), trimesh.creation.icosphere(1, 0.1)
    whole = trimesh.util.concatenate([outer, inner])
    faces = np.concatenate([whole.faces, [[0, len(outer.vertices), len(outer.vertices) + 1]]])  # ties them together
    found = painted(np.asarray(whole.vertices) - (0.2, -0.1, 0.3), faces, [])
    np.testing.assert_allclose(found[len(outer.vertices) + 2 :], found[0][None].repeat(40, 0), atol=0.3)


def test_normals_point_outwards():
    mesh = trimesh.creation.icosphere(2)
    np.testing.assert_allclose(vertex_normals(mesh.vertices, mesh.faces), mesh.vertices, atol=0.03)
    lonely = vertex_normals(np.zeros((4, 3)), np.array([[0, 1, 2]]))
    np.testing.assert_array_equal(lonely, np.tile((0.0, 0.0, 1.0), (4, 1)))
