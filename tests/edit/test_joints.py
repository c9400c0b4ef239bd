"""The point of a joint where the motion tells it, and where small turns would put it beside the body."""

from __future__ import annotations

import numpy as np
import pytest

from scgs_warp.edit.joints import Joint, find_joints
from scgs_warp.edit.patches import make_patches
from scgs_warp.edit.rotations import from_axis, rotate


def bent_rod(across: float, beside: float) -> Joint:
    """Return the joint of a rod along x, 0.3 wide, whose second half swings by 40 degrees about y, and at other times
    by ``across`` degrees about z, where it turns about a line that passes ``beside`` the rod's middle, along y."""
    random = np.random.default_rng(0)
    rest = random.random((1200, 3)) * [2.0, 0.3, 0.3] - [0.0, 0.15, 0.15]
    second, tracks = rest[:, 0] > 1.0, []
    for time in np.linspace(0.0, 1.0, 24):
        points = rest.copy()
        swing, other = 40.0 * np.sin(2.0 * np.pi * time), across * np.cos(2.0 * np.pi * time)
        hinge, line = np.array([1.0, 0.0, 0.0]), np.array([1.0, beside, 0.0])
        turned = rotate(from_axis((0, 0, 1), other), rest[second] - line) + line
        points[second] = rotate(from_axis((0, 1, 0), swing), turned - hinge) + hinge
        tracks.append(points)
    at = (rest[:, 0] * 10.0 - 0.5).clip(0.0, 19.0)
    low = np.floor(at).clip(0, 18)
    share = at - low
    indices = np.stack([low, low + 1], 1).astype(np.int64)
    patches = make_patches(np.stack(tracks), indices, np.stack([1.0 - share, share], 1))
    (joint,) = [joint for joint in find_joints(patches, np.arange(20) // 10) if joint.parent >= 0]
    return joint


def test_turns_about_two_axes_determine_the_point():
    joint = bent_rod(across=25.0, beside=0.1)
    np.testing.assert_allclose(joint.point, [1.0, 0.1, 0.0], atol=0.03)
    assert joint.confidence > 0.9


@pytest.mark.parametrize("beside", [0.6, -0.6])
def test_small_turns_do_not_put_a_hinge_beside_the_body(beside):
    joint = bent_rod(across=4.0, beside=beside)
    assert abs(joint.point[1]) < 0.02 and abs(joint.point[0] - 1.0) < 0.06
    assert joint.confidence > 0.9, "the motion determines the point across the hinge's axis"


def test_turns_of_the_size_of_mistakes_hardly_move_a_point_along_the_axis():
    assert abs(bent_rod(across=0.5, beside=0.09).point[1]) < 0.025
    assert bent_rod(across=8.0, beside=0.09).point[1] > 0.07
