"""Control points as joints, against the scene's own skinning."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.edit_scenes import bar_scene
from scgs_warp.edit import EditSession
from scgs_warp.edit.rotations import from_axis, rotate
from scgs_warp.errors import UserError
from scgs_warp.export.moments import at_rest, even_moments
from scgs_warp.export.skeleton import Skeleton, build_skeleton
from scgs_warp.scene.scene import Scene

TIMES = (0.0, 0.5, 1.0)


def skinned(skeleton: Skeleton, rest: np.ndarray, frame: int) -> np.ndarray:
    """[N, 3] linear blend skinning as glTF defines it."""
    arms = rest[:, None] - skeleton.rest[skeleton.indices]
    moved = rotate(skeleton.rotations[frame][skeleton.indices], arms) + skeleton.positions[frame][skeleton.indices]
    return (skeleton.weights[..., None] * moved).sum(1)


@pytest.mark.parametrize("share", [None, 0.7])
def test_the_skeleton_moves_gaussians_as_the_scene_does(share):
    scene = bar_scene(share=share)
    skeleton = build_skeleton(EditSession(scene), even_moments(3, 2.0))
    np.testing.assert_array_equal(skeleton.seconds, [0.0, 0.5, 1.0])
    np.testing.assert_allclose(skeleton.weights.sum(1), 1.0, atol=1e-12)
    rest = at_rest(scene).means.double().numpy()
    for frame, time in enumerate(TIMES):
        truth = scene.gaussians_at(time).means.double().numpy()
        assert np.abs(skinned(skeleton, rest, frame) - truth).max() < 2e-6
        nodes = scene.control_points_at(time).double().numpy()
        assert np.abs(skeleton.positions[frame, : len(nodes)] - nodes).max() < 1e-6
    assert np.abs(skinned(skeleton, rest, 0) - skinned(skeleton, rest, 2)).max() > 0.05


def bent(scene: Scene) -> EditSession:
    session = EditSession(scene)
    x = session.node_positions(0.0)[:, 0]
    session.add_handle(np.flatnonzero(x > np.quantile(x, 0.8)), 0.0, "end")
    session.pin(np.flatnonzero(x < np.quantile(x, 0.4)))
    session.move("end", [0, 0, 0.3], from_axis([0, 1, 0], 40))
    return session


def test_the_skeleton_follows_an_edit():
    session = bent(bar_scene())
    skeleton = build_skeleton(session, even_moments(3, 2.0))
    rest = at_rest(session.scene).means.double().numpy()
    for frame, time in enumerate(TIMES):
        truth = session.gaussians_at(time).means.double().numpy()
        assert np.abs(skinned(skeleton, rest, frame) - truth).max() < 2e-6
    with pytest.raises(UserError, match="mask"):
        build_skeleton(bent(bar_scene(share=0.5)), even_moments(2, 2.0))
