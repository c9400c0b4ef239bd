"""The rig of a scene's parts, read back by pygltflib and played by forward kinematics written for the test."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from helpers.edit_scenes import figure_scene
from helpers.export_files import gltf_arrays
from helpers.node_packages import gltf_errors
from scgs_warp.edit import EditSession
from scgs_warp.edit.rotations import multiply, rotate
from scgs_warp.export.glb import write_glb
from scgs_warp.export.moments import even_moments, film_moments
from scgs_warp.export.part_rig import Rig, build_rig, part_weights
from scgs_warp.scene.scene import Scene

FRAMES = 5
UP = (0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def figure() -> tuple[Scene, EditSession]:
    scene, _, _ = figure_scene(nodes=128, points=4000)
    session = EditSession(scene)
    session.rename_part("part-1", "trunk")
    return scene, session


def everything(scene: Scene) -> np.ndarray:
    return np.ones(len(scene.gaussians), bool)


def made(session: EditSession, frames: int = FRAMES) -> Rig:
    return build_rig(session, session.skeleton, even_moments(frames, 4.0), everything(session.scene))


def played(path: Path, frame: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Points [N, 3] and joints by name at a key of the animation, in the space of the skeleton's root."""
    found, seen = gltf_arrays(path)
    gltf = seen["gltf"]
    blob, skin = gltf.binary_blob(), gltf.skins[0]

    def values(index: int) -> np.ndarray:
        accessor = gltf.accessors[index]
        view = gltf.bufferViews[accessor.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor.type]
        start = (view.byteOffset or 0) + (accessor.byteOffset or 0)
        return np.frombuffer(blob, "<f4", accessor.count * width, start).reshape(-1, width).astype(float)

    local: dict[int, dict[str, np.ndarray]] = {joint: {} for joint in skin.joints}
    for channel in gltf.animations[0].channels:
        sampler = gltf.animations[0].samplers[channel.sampler]
        local[channel.target.node][channel.target.path] = values(sampler.output)[frame]
    where: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def walk(nodes: list[int], turn: np.ndarray, place: np.ndarray) -> None:
        for node in nodes:
            own = local[node]["rotation"][[3, 0, 1, 2]]
            where[node] = multiply(turn, own), place + rotate(turn, local[node]["translation"])
            walk(gltf.nodes[node].children or [], *where[node])

    walk(gltf.nodes[skin.skeleton].children, np.array([1.0, 0, 0, 0]), np.zeros(3))
    assert sorted(where) == sorted(skin.joints)
    bind = values(skin.inverseBindMatrices).reshape(-1, 4, 4)
    points, rest = (
        np.zeros_like(found["POSITION"]),
        np.column_stack([found["POSITION"], np.ones(len(found["POSITION"]))]),
    )
    for slot, joint in enumerate(skin.joints):
        turn, place = where[joint]
        moved = rotate(turn, (rest @ bind[slot])[:, :3]) + place
        share = np.where(found["JOINTS_0"] == slot, found["WEIGHTS_0"], 0.0).sum(1)
        points += share[:, None] * moved
    return points, {gltf.nodes[joint].name: where[joint][1] for joint in skin.joints}


def test_the_file_moves_as_the_scene_but_for_the_stated_loss(figure, tmp_path):
    scene, session = figure
    rig = made(session)
    write_glb(tmp_path / "rig.glb", rig.gaussians, UP, rig.skeleton)
    low, high = np.quantile(rig.gaussians.means.numpy(), [0.01, 0.99], axis=0)
    extent, off = np.linalg.norm(high - low), []
    for frame in range(FRAMES):
        points, joints = played(tmp_path / "rig.glb", frame)
        truth = scene.gaussians_at(frame / (FRAMES - 1)).means.double().numpy()
        off.append(np.linalg.norm(points - truth, axis=1) / extent)
        assert set(joints) == set(session.skeleton.names) and "trunk" in joints
        if frame == 0:
            assert np.abs(off[0]).max() < 1e-3
            for part in session.skeleton.parts:
                np.testing.assert_allclose(joints[part.name], part.joint, atol=2e-3)
    assert np.isclose(np.mean(off), rig.loss.mean, atol=1e-5) and np.isclose(
        np.quantile(off, 0.95), rig.loss.most, atol=1e-5
    )
    assert rig.loss.mean < 0.01
    still = np.mean(
        [np.linalg.norm(scene.gaussians_at(f / 4).means - rig.gaussians.means, axis=1) for f in range(FRAMES)]
    )
    assert rig.loss.mean * extent < 0.2 * still


def test_the_tree_of_joints_is_the_skeleton(figure, tmp_path):
    _, session = figure
    rig = made(session, 2)
    write_glb(tmp_path / "rig.glb", rig.gaussians, UP, rig.skeleton)
    gltf = gltf_arrays(tmp_path / "rig.glb")[1]["gltf"]
    names = [node.name for node in gltf.nodes]
    for part in session.skeleton.parts:
        children = {names[child] for child in gltf.nodes[names.index(part.name)].children or []}
        assert children == set(session.skeleton.children(part.name))
    found = gltf_errors(tmp_path / "rig.glb")
    issues = {issue["code"] for issue in found if "KHR_gaussian_splatting:" not in issue["pointer"]}
    assert issues <= {"NODE_SKINNED_MESH_LOCAL_TRANSFORMS"}  # a warning; the transform is for programs without skins


def test_an_edit_moves_the_joints(figure):
    scene, session = figure
    edited = EditSession(scene, dataclasses.replace(session.edit))
    name = next(part.name for part in edited.skeleton.parts if part.axis is not None and part.parent is not None)
    edited.turn(name, 40.0)
    film = dataclasses.replace(edited.edit.film, seconds=0.2, fps=10)
    edited.apply(dataclasses.replace(edited.edit, film=film))
    moments = film_moments(edited)
    rig = build_rig(edited, edited.skeleton, moments, everything(scene))
    row = edited.skeleton.names.index(name)
    plain = build_rig(session, session.skeleton, moments, everything(scene))
    inner = np.abs((rig.skeleton.rotations[0, row] * plain.skeleton.rotations[0, row]).sum())
    assert 20.0 < np.degrees(2.0 * np.arccos(min(inner, 1.0))) < 60.0
    assert rig.loss.mean < 0.02


def test_weights_of_parts():
    indices = np.array([[0, 1, 2, 3, 4, 5], [5, 4, 3, 2, 1, 0]])
    weights = np.array([[0.3, 0.2, 0.2, 0.1, 0.15, 0.05], [1.0, 0, 0, 0, 0, 0]])
    parts, shares = part_weights(indices, weights, np.array([0, 0, 1, 2, 3, 4]))
    np.testing.assert_array_equal(parts[0], [0, 1, 3, 2])
    np.testing.assert_allclose(shares[0], np.array([0.5, 0.2, 0.15, 0.1]) / 0.95)
    assert parts[1, 0] == 4 and shares[1, 0] == 1.0 and shares.sum() == 2.0
