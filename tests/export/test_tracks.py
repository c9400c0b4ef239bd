"""Tracks of surface points: what is followed, and files read back by NumPy, the csv module and pygltflib."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import torch

from helpers.edit_scenes import bar_scene
from helpers.export_files import gltf_arrays
from helpers.node_packages import gltf_errors
from scgs_warp.edit.rotations import conjugate, multiply, rotate, unit
from scgs_warp.errors import UserError
from scgs_warp.export.moments import even_moments
from scgs_warp.export.tracks import POINT_BYTES, build_tracks, read_points, write_tracks
from scgs_warp.runtime import memory
from scgs_warp.scene.scene import Scene

UP = (0.0, 0.0, 1.0)
MOMENTS = even_moments(5, 4.0)


@pytest.fixture(scope="module")
def scene() -> Scene:
    made = bar_scene(nodes=24, gaussians=200)
    with torch.no_grad():
        made.gaussians.opacity_logits[::4] = -2.0
        made.gaussians.means[9, 0] = float("nan")
    return made


def test_all_opaque_gaussians_are_followed(scene):
    tracks = build_tracks(scene, None, MOMENTS)
    assert tracks.points.shape == (5, 149, 3) and not (tracks.gaussians % 4 == 0).any() and 9 not in tracks.gaussians
    for frame in range(5):
        truth = scene.gaussians_at(frame / 4).means.numpy()
        np.testing.assert_array_equal(tracks.points[frame], truth[tracks.gaussians])


def test_a_number_of_points_is_spread_over_the_surface(scene):
    few = build_tracks(scene, None, MOMENTS, 12)
    everything = build_tracks(scene, None, MOMENTS)
    assert few.points.shape[1] == len(set(few.gaussians.tolist())) == 12
    gap = np.linalg.norm(everything.points[0][:, None] - few.points[0][None], axis=2).min(1).max()
    assert gap < 0.2  # the bar is 1.2 long
    assert build_tracks(scene, None, MOMENTS, 10_000).points.shape[1] == 149


def test_chosen_points_keep_their_place_beside_the_surface(scene):
    start = scene.gaussians_at(0.0)
    surface = build_tracks(scene, None, MOMENTS).gaussians
    row = int(surface[start.means.numpy()[surface, 0].argmax()])  # at the end that swings
    place = start.means[row].double().numpy()
    chosen = np.stack([np.add(place, (0.0, 0.0, 0.002)), place])
    tracks = build_tracks(scene, None, MOMENTS, chosen)
    assert tracks.gaussians.tolist() == [row, row]
    np.testing.assert_allclose(tracks.points[0], chosen, atol=1e-6)
    end = scene.gaussians_at(1.0)
    quat = lambda g: unit(g.quats[row].double().numpy())  # noqa: E731
    turned = rotate(multiply(quat(end), conjugate(quat(start))), np.array([0.0, 0.0, 0.002]))
    np.testing.assert_allclose(tracks.points[-1, 0] - tracks.points[-1, 1], turned, atol=1e-6)
    assert np.linalg.norm(turned - [0.0, 0.0, 0.002]) > 5e-4


def test_npz_and_csv(scene, tmp_path):
    tracks = build_tracks(scene, None, MOMENTS, 7)
    for name in ("a.npz", "b.npz", "a.csv"):
        write_tracks(tmp_path / name, tracks, UP)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with np.load(tmp_path / "a.npz", allow_pickle=False) as found:
        assert str(found["format"]) == "scgs-warp tracks" and int(found["version"]) == 1
        np.testing.assert_array_equal(found["points"], tracks.points)
        np.testing.assert_array_equal(found["gaussians"], tracks.gaussians)
        np.testing.assert_allclose(found["times"], np.linspace(0, 1, 5))
        assert found["colors"].dtype == np.uint8 and found["up"].tolist() == [0, 0, 1]
    with (tmp_path / "a.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 35
    for row in rows:
        point = [np.float32(row[axis]) for axis in "xyz"]
        np.testing.assert_array_equal(point, tracks.points[int(row["frame"]), int(row["point"])])
        assert float(row["seconds"]) == int(row["frame"]) / 4
        assert [int(row[c]) for c in ("red", "green", "blue")] == tracks.colors[int(row["point"])].tolist()


def test_an_animated_point_cloud(scene, tmp_path):
    tracks = build_tracks(scene, None, MOMENTS, 30)
    write_tracks(tmp_path / "a.glb", tracks, UP)
    assert gltf_errors(tmp_path / "a.glb") == []
    found, seen = gltf_arrays(tmp_path / "a.glb")
    gltf = seen["gltf"]
    primitive, blob = gltf.meshes[0].primitives[0], gltf.binary_blob()
    assert primitive.mode == 0 and len(primitive.targets) == 4

    def values(index: int) -> np.ndarray:
        accessor = gltf.accessors[index]
        start = gltf.bufferViews[accessor.bufferView].byteOffset or 0
        return np.frombuffer(blob, "<f4", accessor.count * {"SCALAR": 1, "VEC3": 3}[accessor.type], start)

    sampler = gltf.animations[0].samplers[0]
    seconds, weights = values(sampler.input), values(sampler.output).reshape(5, 4)
    np.testing.assert_allclose(seconds, tracks.seconds)
    moves = np.stack([values(target["POSITION"]).reshape(-1, 3) for target in primitive.targets])
    played = found["POSITION"] + np.einsum("tk,kpi->tpi", weights, moves)
    np.testing.assert_allclose(played, tracks.points, atol=1e-6)
    write_tracks(tmp_path / "one.glb", build_tracks(scene, None, MOMENTS[:1], 3), UP)
    assert gltf_errors(tmp_path / "one.glb") == []


def test_points_of_a_file(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("x,y,z\n1,2,3\n\n-4e-1, 5 ,6\n")
    np.testing.assert_array_equal(read_points(path), [[1, 2, 3], [-0.4, 5, 6]])
    for text, words in (
        ("1,2\n", "line 1 is no point"), ("1,2,3\nx,y,z\n", "line 2 is no point"), ("1,2,nan\n", "line 1"),
        ("", "holds no point"), ("1,2,1e30\n", "line 1"), ('"' * 200_000, "line 1"),
    ):  # fmt: skip
        path.write_text(text)
        with pytest.raises(UserError, match=words):
            read_points(path)
    with pytest.raises(UserError, match=r"no\.csv"):
        read_points(tmp_path / "no.csv")


def test_points_of_a_spreadsheet_begin_with_a_byte_order_mark(tmp_path):
    path = tmp_path / "points.csv"
    for text in ("x,y,z\n1,2,3\n", "1,2,3\n"):
        path.write_text(text, encoding="utf-8-sig")
        assert read_points(path).tolist() == [[1.0, 2.0, 3.0]]


@pytest.mark.parametrize("suffix", [".npz", ".csv", ".glb"])
def test_tracks_that_do_not_fit_into_memory_are_refused(suffix, scene, monkeypatch):
    monkeypatch.setattr(memory, "fits", lambda need, device: need <= POINT_BYTES[suffix] * 149 * 5 + 500)
    build_tracks(scene, None, MOMENTS, suffix=suffix)
    with pytest.raises(memory.NotEnoughMemory, match=r"tracks of 149 points at 6 instants needs .*give fewer --frames"):
        build_tracks(scene, None, even_moments(6, 4.0), suffix=suffix)


def test_a_scene_without_surface_is_refused():
    faint = bar_scene(nodes=12, gaussians=20)
    with torch.no_grad():
        faint.gaussians.opacity_logits.fill_(-3.0)
    with pytest.raises(UserError, match="no surface"):
        build_tracks(faint, None, MOMENTS)
