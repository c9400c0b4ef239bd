"""Mesh files, read back by trimesh, by the project's glTF reader and by the Khronos validator."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from helpers.node_packages import gltf_errors
from scgs_warp.data.gltf.scene import read_scene
from scgs_warp.edit.rotations import from_axis
from scgs_warp.errors import UserError
from scgs_warp.export.mesh.binding import posed
from scgs_warp.export.mesh.files import write_mesh
from scgs_warp.export.mesh.surface import Surface
from scgs_warp.export.skeleton import Skeleton

UP = (0.0, 0.0, 1.0)


def sample() -> tuple[Surface, np.ndarray]:
    mesh = trimesh.creation.icosphere(2, 0.7)
    surface = Surface(np.asarray(mesh.vertices) + np.array([3.0, -1.0, 0.5]), np.asarray(mesh.faces, np.int32))
    return surface, np.random.default_rng(0).random((len(surface.vertices), 3))


def skeleton_of(surface: Surface) -> Skeleton:
    """Three joints that move and turn over four frames; vertices follow two of them each."""
    rng = np.random.default_rng(1)
    rest = np.array([[3.0, -1, 0], [3.0, -1, 1], [2.5, -0.5, 0.5]])
    positions = rest + 0.3 * rng.standard_normal((4, 3, 3))
    turns = np.stack([[from_axis(rng.standard_normal(3), 25 * frame) for _ in range(3)] for frame in range(4)])
    indices = rng.permuted(np.tile(np.arange(3), (len(surface.vertices), 1)), axis=1)[:, :2]
    share = rng.random((len(indices), 1))
    seconds = np.arange(4) / 4.0
    fields = (None, None, None, indices.astype(np.int32), np.concatenate([share, 1 - share], axis=1))
    return Skeleton(seconds, seconds / seconds[-1], rest, positions, turns, *fields)


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply", ".glb"])
def test_trimesh_reads_what_was_written(tmp_path, suffix):
    surface, colors = sample()
    path = tmp_path / f"a{suffix}"
    write_mesh(path, surface, colors, UP)
    found = trimesh.load(path, force="mesh", process=suffix == ".stl")
    assert isinstance(found, trimesh.Trimesh)
    expected = surface.vertices
    if suffix == ".glb":  # y is up
        expected = np.column_stack([expected[:, 0], expected[:, 2], -expected[:, 1]])
    if suffix == ".stl":
        assert found.is_watertight and found.volume > 0
        np.testing.assert_allclose(found.bounds, [expected.min(0), expected.max(0)], atol=1e-6)
        return
    np.testing.assert_allclose(found.vertices, expected, atol=1e-6)
    np.testing.assert_array_equal(found.faces, surface.faces)
    if suffix != ".glb":  # there, colours are linear
        np.testing.assert_allclose(found.visual.vertex_colors[:, :3] / 255.0, colors, atol=0.51 / 255)


@pytest.mark.parametrize("size", [1e-5, 1.0, 1e6])
def test_text_keeps_coordinates_of_any_size(tmp_path, size):
    surface, colors = sample()
    write_mesh(tmp_path / "a.obj", surface._replace(vertices=size * surface.vertices), colors, UP)
    found = trimesh.load(tmp_path / "a.obj", force="mesh", process=False)
    assert isinstance(found, trimesh.Trimesh)
    np.testing.assert_allclose(found.vertices, size * surface.vertices, atol=1e-7 * size)


def test_colours_of_a_glb_are_linear(tmp_path):
    surface, colors = sample()
    write_mesh(tmp_path / "a.glb", surface, colors, UP)
    scene = read_scene(tmp_path / "a.glb", None)
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(np.asarray(scene.triangles.colors)[:, :3], linear, atol=1e-4)
    assert scene.materials[scene.triangles.material[0]].unlit


def test_a_moving_mesh_is_posed_as_it_was_bound(tmp_path):
    surface, colors = sample()
    skeleton = skeleton_of(surface)
    write_mesh(tmp_path / "a.glb", surface, colors, UP, skeleton=skeleton, frame=2)
    scene = read_scene(tmp_path / "a.glb", None)
    assert scene.clip is not None and scene.clip.end == pytest.approx(0.75)
    for frame in range(4):
        found = scene.posed(float(skeleton.seconds[frame])).positions
        np.testing.assert_allclose(found, posed(surface.vertices, skeleton, 2, frame), atol=2e-6)
    np.testing.assert_allclose(scene.posed(0.5).positions, surface.vertices, atol=2e-6)


@pytest.mark.parametrize("moving", [False, True])
def test_the_khronos_validator_finds_nothing(tmp_path, moving):
    surface, colors = sample()
    skeleton = skeleton_of(surface) if moving else None
    write_mesh(tmp_path / "a.glb", surface, colors, UP, skeleton=skeleton, frame=2, closed=not moving)
    assert gltf_errors(tmp_path / "a.glb") == []


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path):
    surface, colors = sample()
    with pytest.raises(UserError, match="cannot be written"):
        write_mesh(tmp_path / "none" / "a.obj", surface, colors, UP)
