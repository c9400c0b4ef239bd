"""Gaussians in glTF."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
import trimesh

from helpers.export_files import cloud, gltf_arrays, ordered, picture
from helpers.node_packages import gltf_errors, splat_transform
from scgs_warp.edit.rotations import rotate
from scgs_warp.export.still import write_still
from scgs_warp.types import Gaussians


def test_glb_holds_the_gaussians_and_renders_the_same(tmp_path):
    truth = ordered(cloud())
    path = tmp_path / "a.glb"
    write_still(path, truth, up=(0.0, 0.0, 1.0))
    found, seen = gltf_arrays(path)
    e = "KHR_gaussian_splatting:"
    extension = seen["gltf"].meshes[0].primitives[0].extensions["KHR_gaussian_splatting"]
    assert extension["kernel"] == "ellipse" and extension["colorSpace"] == "srgb_rec709_display"
    rest = [found[f"{e}SH_DEGREE_{l}_COEF_{n}"] for l in (1, 2, 3) for n in range(2 * l + 1)]
    again = Gaussians(
        *(torch.from_numpy(values).float() for values in (
            found["POSITION"], found[e + "ROTATION"][:, [3, 0, 1, 2]], found[e + "SCALE"], found[e + "OPACITY"][:, 0],
            found[e + "SH_DEGREE_0_COEF_0"], np.stack(rest, 1),
        ))
    )  # fmt: skip
    assert torch.equal(again.means, truth.means) and torch.equal(again.sh_rest, truth.sh_rest)
    assert float((picture(again) - picture(truth)).abs().max()) < 1e-5
    np.testing.assert_allclose(np.linalg.norm(found[e + "ROTATION"], axis=1), 1.0, atol=1e-6)
    scene = trimesh.load(path)
    turned = np.concatenate([item.vertices for item in scene.dump()])
    means = truth.means.double().numpy()
    np.testing.assert_allclose(turned, np.stack([means[:, 0], means[:, 2], -means[:, 1]], 1), atol=1e-6)


def test_glb_is_what_splat_transform_writes_of_the_same_gaussians(tmp_path):
    """It turns the data by half a turn about z; we turn them by the node, about x: half a turn about y apart."""
    truth = ordered(cloud())
    write_still(tmp_path / "a.ply", truth)
    write_still(tmp_path / "a.glb", truth)
    ours, seen = gltf_arrays(tmp_path / "a.glb")
    theirs, _ = gltf_arrays(splat_transform(tmp_path / "a.ply", tmp_path / "b.glb"))
    assert ours.keys() == theirs.keys()
    turned = rotate(np.array(seen["node"].rotation)[[3, 0, 1, 2]], ours["POSITION"])
    np.testing.assert_allclose(turned * (-1, 1, -1), theirs["POSITION"], atol=1e-6)
    for name in ours:
        if "SCALE" in name or "OPACITY" in name or "DEGREE" in name:
            # harmonics of odd order m change sign in half a turn about z
            place = re.search(r"DEGREE_(\d)_COEF_(\d)", name)
            sign = (-1.0) ** (int(place[2]) - int(place[1])) if place else 1.0
            np.testing.assert_allclose(sign * ours[name], theirs[name], atol=2e-6, err_msg=name)


@pytest.mark.parametrize("degree", [0, 3])
def test_glb_is_valid(tmp_path, degree):
    write_still(tmp_path / "a.glb", cloud(degree=degree))
    issues = gltf_errors(tmp_path / "a.glb")
    assert len(issues) == 4 + (degree + 1) ** 2 - 1
    for issue in issues:
        assert issue["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" and "KHR_gaussian_splatting" in issue["pointer"]
