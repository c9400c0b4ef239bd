"""Motion as plain arrays."""

from __future__ import annotations

import numpy as np

from helpers.edit_scenes import bar_scene
from scgs_warp.edit import EditSession
from scgs_warp.export.moments import at_rest, even_moments
from scgs_warp.export.npz import FORMAT, VERSION, write_npz
from scgs_warp.export.skeleton import build_skeleton


def test_arrays_are_those_of_the_skeleton_and_the_same_every_time(tmp_path):
    scene = bar_scene(shaded=True)
    skeleton = build_skeleton(EditSession(scene), even_moments(3, 2.0))
    shading = scene.gaussians.shading.detach().numpy()
    for name in ("a.npz", "b.npz"):
        write_npz(tmp_path / name, at_rest(scene), skeleton, shading=shading, up=(0.0, 1.0, 0.0))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with np.load(tmp_path / "a.npz") as arrays:
        assert str(arrays["format"]) == FORMAT and int(arrays["version"]) == VERSION
        assert {arrays[name].dtype.str for name in arrays.files if name not in ("format", "version", "indices")} == {
            "<f4"
        }
        assert arrays["indices"].dtype.str == "<i4" and arrays["shading"].shape == shading.shape
        np.testing.assert_allclose(arrays["node_positions"], skeleton.positions, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(arrays["quats"], axis=1), 1.0, atol=1e-6)
        np.testing.assert_array_equal(arrays["times"], [0.0, 0.5, 1.0])
        assert "node_log_scales" not in arrays.files or skeleton.log_scales is not None
