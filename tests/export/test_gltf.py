"""The glTF container: orientation, influences, valid JSON."""

from __future__ import annotations

import numpy as np
import pytest

from scgs_warp.edit.rotations import rotate
from scgs_warp.errors import UserError
from scgs_warp.export.gltf import GltfDocument, add_skeleton, influences, upright
from scgs_warp.export.skeleton import Skeleton

UPS = [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.6, 0.0, -0.8)]


@pytest.mark.parametrize("up", UPS)
def test_upright_turns_up_to_y(up):
    turned = rotate(np.array(upright(up))[[3, 0, 1, 2]], np.array(up))
    np.testing.assert_allclose(turned, [0, 1, 0], atol=1e-12)


def test_influences_are_what_gltf_wants():
    weights = np.random.default_rng(0).dirichlet(np.ones(6), 500)
    weights[:10, 3:] = 0.0
    weights[:10] /= weights[:10].sum(1, keepdims=True)
    joints = np.tile(np.arange(1, 7), (500, 1))
    found = influences(joints, weights)
    assert len(found) == 2 and found[0][0].dtype == np.dtype("<u2")
    shares = np.concatenate([part for _, part in found], 1)
    owners = np.concatenate([part for part, _ in found], 1)
    assert np.abs(shares.sum(1, dtype=np.float64) - 1).max() < 2e-7 and (owners[shares == 0] == 0).all()
    dense = np.zeros((500, 7))
    for k in range(8):
        dense[np.arange(500), owners[:, k]] += shares[:, k]
    np.testing.assert_allclose(dense[:, 1:], weights, atol=1e-7)


def test_glb_is_never_json_that_is_not_json():
    document = GltfDocument()
    document.append("nodes", {"translation": [0.0, float("nan"), 0.0]})
    with pytest.raises(UserError, match="not finite"):
        document.content()


def test_vertices_at_rest_stay_where_they_are():
    """Each joint at rest, after its inverse bind matrix, is the identity; a joint that moved carries its vertices."""
    rest = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, 0.0]])
    still = np.tile(np.array([1.0, 0, 0, 0]), (2, 2, 1))
    times, positions = np.array([0.0, 1.0]), np.stack([rest, rest + np.array([0.0, 0.0, 1.0])])
    binding = np.array([[0], [1]]), np.ones((2, 1))
    skeleton = Skeleton(times, times, rest, positions, still, None, None, None, *binding)
    document = GltfDocument()
    index = add_skeleton(document, skeleton, (0.0, 1.0, 0.0))
    skin = document.json["skins"][index]
    accessor = document.json["accessors"][skin["inverseBindMatrices"]]
    view = document.json["bufferViews"][accessor["bufferView"]]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    blob = document.content()
    binary = blob[20 + int.from_bytes(blob[12:16], "little") + 8 :]
    inverse = np.frombuffer(binary, "<f4", 32, start).reshape(2, 4, 4).transpose(0, 2, 1)
    for k, joint in enumerate(skin["joints"]):
        place = np.eye(4)
        place[:3, 3] = document.json["nodes"][joint]["translation"]
        np.testing.assert_allclose(place @ inverse[k], np.eye(4), atol=1e-6)
