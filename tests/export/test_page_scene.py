"""A scene as a page's columns: what is kept, how poses are sampled."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from helpers.edit_scenes import bar_scene, figure_scene, rich_scene
from helpers.page_reader import gaussians_of
from scgs_warp.edit import EditSession
from scgs_warp.errors import UserError
from scgs_warp.export import page, page_scene
from scgs_warp.export.page_data import pack, unpack
from scgs_warp.export.page_scene import gaussian_columns
from scgs_warp.gaussians import gaussians_from_points
from scgs_warp.geometry.normalisation import Normalisation
from scgs_warp.motion import build_motion
from scgs_warp.types import Pose


def test_what_cannot_be_seen_is_left_out():
    scene = bar_scene(nodes=12, gaussians=50)
    with torch.no_grad():
        scene.gaussians.opacity_logits[3] = -7.0
        scene.gaussians.means[5, 1] = float("nan")
        scene.gaussians.quats[8] = 0.0
    content = page_scene.page_scene(scene, 0)
    assert content.facts["gaussians"] == 47
    made = gaussians_of(*unpack(pack(content.facts, content.columns)))
    assert made.opacities().min() > 1 / 255 and made.means.isfinite().all()
    with torch.no_grad():
        scene.gaussians.opacity_logits.fill_(-9.0)
    with pytest.raises(UserError, match="no Gaussian that can be seen"):
        page_scene.page_scene(scene, 0)


def test_one_outlier_does_not_coarsen_the_others():
    plain, spoilt = (bar_scene(nodes=12, gaussians=3000) for _ in range(2))
    with torch.no_grad():
        spoilt.gaussians.sh_rest[7] = 80.0
        spoilt.gaussians.means[11] = torch.tensor([4e5, -1e7, 3.0])
    contents = [page_scene.page_scene(scene, 1) for scene in (plain, spoilt)]
    assert contents[0].facts["gaussians"] == 3000 and contents[1].facts["gaussians"] == 2999  # a stray is left out
    steps = [{column.name: column.step for column in content.columns} for content in contents]
    for name, step in steps[0].items():
        if name.startswith(("mean", "sh")):
            assert steps[1][name] < 1.7 * step and steps[1][name] <= 1.01 * page_scene.STEPS["sh_rest"], name
    made = gaussians_of(*unpack(pack(contents[1].facts, contents[1].columns)))
    assert 0.9 < made.sh_rest.max() < 1.7  # the outlier, clipped
    with torch.no_grad():
        spoilt.gaussians.means.add_(1e6)  # all are far: one is a stray
    assert page_scene.page_scene(spoilt, 0).facts["gaussians"] == 2999


def test_quick_motions_are_sampled_more_often():
    slow, quick = bar_scene(), bar_scene()
    swing = quick.motion.poses
    quick.motion.poses = lambda times: swing(0.5 + 0.5 * torch.sin(40 * times))  # type: ignore[method-assign]
    few, many = (page_scene.sample_poses(scene.motion)["translation"] for scene in (slow, quick))
    assert len(few) < len(many) == page_scene.MAX_SAMPLES
    exact = swing(0.5 + 0.5 * torch.sin(40 * torch.tensor([100 / 256])))[0].translations
    assert np.allclose(many[100], exact, atol=1e-6)


def test_rotations_do_not_turn_over_between_samples():
    scene = rich_scene()
    plain = scene.motion.poses

    def flipping(times: torch.Tensor) -> list[Pose]:
        return [
            Pose(pose.translations, pose.rotations * (-1.0) ** round(97 * time), pose.shape_rotations, pose.log_scales)
            for time, pose in zip(times.tolist(), plain(times))
        ]

    scene.motion.poses = flipping  # type: ignore[method-assign]
    found = page_scene.sample_poses(scene.motion)["rotation"]
    assert ((found[1:] * found[:-1]).sum(axis=2) > 0.5).all()


def test_parts_and_joints_are_on_the_page():
    scene, _, _ = figure_scene(nodes=96, points=3000)
    scene.normalisation = Normalisation(np.array([0.3, -0.2, 0.5]), 0.5)
    skeleton = EditSession(scene).skeleton
    content = page_scene.page_scene(scene, 0)
    facts, columns = unpack(pack(content.facts, content.columns))
    assert 4 <= len(facts["parts"]) == len(skeleton.parts)
    for row, (found, part) in enumerate(zip(facts["parts"], skeleton.parts)):
        assert found["name"] == part.name
        np.testing.assert_array_equal(np.flatnonzero(columns["part"] == row), part.nodes)
        above = facts["parts"][found["parent"]]["name"] if found["parent"] >= 0 else None
        assert above == part.parent
        np.testing.assert_allclose(np.array(found["joint"]) / 0.5 + [0.3, -0.2, 0.5], part.joint, atol=1e-12)
        assert found["axis"] == (None if part.axis is None else list(part.axis))


@pytest.mark.parametrize("name", ["hexplane", "per-gaussian"])
def test_motions_without_control_points_are_refused(name, tmp_path):
    scene = bar_scene(nodes=12, gaussians=20)
    scene.motion = build_motion(name, scene.config)
    with pytest.raises(UserError, match=f"{name} has no control points"):
        page.write_page(scene, tmp_path / "page.html")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_quaternions_of_either_sign_are_the_same_rotations(sign):
    """Three components are stored, and the reader takes the fourth, the largest, for positive."""
    count = 40
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    gaussians = gaussians_from_points(points, None, sh_degree=0, hyper_columns=0)
    quats = torch.randn(count, 4, generator=torch.Generator().manual_seed(1))
    gaussians.quats.data[:] = sign * quats
    _, values = unpack(pack({}, gaussian_columns(gaussians, torch.arange(count), 0)))
    others = np.stack([values[f"quat{k}"] for k in range(3)], axis=1)
    found = np.zeros((count, 4))
    for row, largest in enumerate(values["quat_largest"].astype(int)):
        found[row, largest] = np.sqrt(1.0 - (others[row] ** 2).sum())
        found[row, [(largest + 1 + k) % 4 for k in range(3)]] = others[row]
    expected = torch.nn.functional.normalize(quats, dim=1).numpy()
    np.testing.assert_allclose(np.abs((found * expected).sum(1)), 1.0, atol=1e-4)
