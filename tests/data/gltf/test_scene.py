"""glTF files: clips, hierarchy, skins, morph targets and odd encodings against float64."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers.gltf_files import BOX, BOX_FACES, Glb, bar, box, quad, quat_z
from reference import gltf as reference

pytest.importorskip("pygltflib")

from scgs_warp.data.gltf.animation import Sampler, interpolate, slerp
from scgs_warp.data.gltf.file import GltfFile
from scgs_warp.data.gltf.nodes import rotation_matrix
from scgs_warp.data.gltf.scene import UPRIGHT, GltfScene, read_scene
from scgs_warp.data.synthetic.from_mesh import describe
from scgs_warp.errors import UserError


def upright(points: np.ndarray) -> np.ndarray:
    """glTF's world to ours."""
    return points @ UPRIGHT[:3, :3].T


def read(glb: Glb, folder: Path, clip: str | None = None) -> GltfScene:
    return read_scene(glb.save(folder / "x.glb"), clip)


@pytest.mark.parametrize("seed", range(4))
def test_slerp(seed):
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(2, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    for share in (0.0, 0.2, 0.5, 0.9, 1.0):
        expected = reference.rotation_between(np.array([0.0, 1.0]), quats, share)
        assert np.abs(rotation_matrix(slerp(quats[0], quats[1], share)) - expected).max() < 1e-12
        assert np.abs(rotation_matrix(slerp(quats[0], -quats[1], share)) - expected).max() < 1e-12
    assert np.allclose(slerp(quats[0], quats[0], 0.3), quats[0])


@pytest.mark.parametrize("seed", range(3))
def test_samplers(seed):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.1, 1.0, 5))
    plain, tangents = rng.normal(size=(5, 3)), rng.normal(size=(5, 3, 3))
    quats = Rotation.random(5, rng=rng).as_quat()
    for seconds in [*np.linspace(times[0] - 0.5, times[-1] + 0.5, 23), *times]:
        seconds = float(seconds)
        k = int(np.clip(np.searchsorted(times, seconds, side="right") - 1, 0, 4))
        assert np.array_equal(interpolate(Sampler(times, plain, "STEP"), seconds), plain[k])
        expected = [np.interp(seconds, times, plain[:, c]) for c in range(3)]
        assert np.allclose(interpolate(Sampler(times, plain, "LINEAR"), seconds), expected, atol=1e-12)
        found = interpolate(Sampler(times, tangents, "CUBICSPLINE"), seconds)
        assert np.allclose(found, reference.cubic(times, tangents, seconds), atol=1e-12)
        turned = rotation_matrix(interpolate(Sampler(times, quats, "LINEAR"), seconds, rotation=True))
        assert np.allclose(turned, reference.rotation_between(times, quats, seconds), atol=1e-12)


def test_cubic_rotations_are_unit():
    values = np.random.default_rng(0).normal(size=(3, 3, 4))
    for seconds in np.linspace(0, 2, 9):
        found = interpolate(Sampler(np.arange(3.0), values, "CUBICSPLINE"), float(seconds), rotation=True)
        assert np.linalg.norm(found) == pytest.approx(1, abs=1e-12)


def test_a_rigid_box_moves_with_its_node(tmp_path):
    scene = read(box(), tmp_path)
    assert scene.clip is not None and (scene.clip.name, scene.clip.start, scene.clip.end) == ("Slide", 0.0, 1.0)
    for seconds in (0.0, 0.25, 0.7, 1.0, 5.0):
        share = min(seconds, 1.0)
        turn = Rotation.from_euler("z", 90 * share, degrees=True).as_matrix()
        expected = BOX @ turn.T + [3 * share, 1, 0]
        assert np.abs(scene.posed(seconds).positions - upright(expected)).max() < 1e-6


@pytest.mark.parametrize("seconds", [0.0, 0.3, 0.5, 0.8, 1.0])
def test_a_skinned_bar_matches_the_twin(tmp_path, seconds):
    glb, arrays = bar()
    scene = read(glb, tmp_path)
    nodes = json.loads(json.dumps(glb.document["nodes"]))
    keys = np.array([quat_z(0), quat_z(60), quat_z(90)])
    turn = reference.rotation_between(np.array([0.0, 0.5, 1.0]), keys, seconds)
    nodes[2]["rotation"] = Rotation.from_matrix(turn).as_quat().tolist()
    world = np.stack([reference.node_world(nodes, index) for index in (1, 2)])
    expected = reference.skinned(
        arrays["positions"], arrays["joints"], arrays["weights"].astype(np.float32), arrays["inverse"], world
    )
    assert np.abs(scene.posed(seconds).positions - upright(expected)).max() < 1e-6


def test_what_a_joint_owns_moves_rigidly(tmp_path):
    """Analytic: above the bend the bar is turned about (0, 1, 0), below nothing moves."""
    glb, arrays = bar()
    found = read(glb, tmp_path).posed(1.0).positions
    low, high = arrays["positions"][:, 1] <= 0.75, arrays["positions"][:, 1] >= 1.25
    assert np.abs(found[low] - upright(arrays["positions"][low])).max() < 1e-7
    x, y, z = arrays["positions"][high].T
    assert np.abs(found[high] - upright(np.stack([1 - y, 1 + x, z], 1))).max() < 1e-6


def test_unnormalised_weights_are_normalised_and_idle_vertices_follow_the_first_joint(tmp_path):
    glb, arrays = bar()
    weights = 3.0 * arrays["weights"]
    weights[-1] = 0.0
    glb.document["meshes"][0]["primitives"][0]["attributes"]["WEIGHTS_0"] = glb.array(weights)
    found = read(glb, tmp_path).posed(1.0).positions
    plain = read(bar()[0], tmp_path).posed(1.0).positions
    assert np.abs(found[:-1] - plain[:-1]).max() < 1e-6
    assert np.abs(found[-1] - upright(arrays["positions"][-1:])).max() < 1e-6


@pytest.mark.filterwarnings("error")
def test_a_signalling_nan_is_refused_without_a_warning(tmp_path):
    glb, arrays = bar()
    weights = arrays["weights"].astype(np.float32)
    weights.view(np.uint32)[0, 0] = 0x7FA00000
    glb.document["meshes"][0]["primitives"][0]["attributes"]["WEIGHTS_0"] = glb.array(weights)
    with pytest.raises(UserError, match=r"WEIGHTS_0\) holds values that are not finite"):
        read(glb, tmp_path)


@pytest.mark.parametrize("normals", ["given", "none"])
def test_normals_follow(tmp_path, normals):
    glb = Glb()
    rows = BOX / np.sqrt(3)
    more = {"NORMAL": glb.array(rows)} if normals == "given" else {}
    glb.add("meshes", primitives=[glb.primitive(BOX, BOX_FACES, **more)])
    glb.document["nodes"] = [{"mesh": 0, "rotation": quat_z(90), "scale": [1, 2, -4]}]
    found = read(glb, tmp_path).posed(0.0).normals
    expected = rows @ np.diag([1, 0.5, -0.25]) @ Rotation.from_quat(quat_z(90)).as_matrix().T
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    assert np.allclose(found, upright(expected) if normals == "given" else 0.0, atol=1e-6)


def test_mirrored_nodes_still_face_outward(tmp_path):
    for scale in ([1, 1, 1], [-1, 1, 1], [-1, -2, 1]):
        glb = Glb()
        glb.add("meshes", primitives=[glb.primitive(BOX, BOX_FACES)])
        glb.document["nodes"] = [{"mesh": 0, "scale": scale}]
        scene = read(glb, tmp_path)
        corners = scene.posed(0.0).positions[scene.triangles.faces]
        volume = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
        assert volume == pytest.approx(8 * abs(np.prod(scale)), rel=1e-6)


@pytest.mark.parametrize("popping", [False, True])
def test_mirrored_skins_still_face_outward(tmp_path, popping):
    """A part that has no extent at first counts as it is later."""
    for scale in ([1, 1, 1], [-1, 1, 1]):
        glb = Glb()
        weights = glb.array(np.tile([1.0, 0, 0, 0], (8, 1)))
        joints = glb.array(np.zeros((8, 4)), "B")
        glb.add("meshes", primitives=[glb.primitive(BOX, BOX_FACES, JOINTS_0=joints, WEIGHTS_0=weights)])
        glb.add("skins", joints=[2])
        glb.document["nodes"] = [{"children": [1, 2], "scale": scale}, {"mesh": 0, "skin": 0}, {}]
        if popping:
            keys = np.array([[0, 0, 0], scale])
            glb.animate(glb.clip("Pop"), 0, "scale", [0.0, 1.0], keys)
        scene = read(glb, tmp_path)
        corners = scene.posed(1.0).positions[scene.triangles.faces]
        volume = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
        assert volume == pytest.approx(8, rel=1e-6)


def test_compressed_parts_are_refused_though_not_required(tmp_path):
    glb = Glb()
    primitive = glb.primitive(BOX, BOX_FACES, extensions={"KHR_draco_mesh_compression": {"bufferView": 0}})
    glb.add("meshes", primitives=[glb.primitive(BOX, BOX_FACES), primitive])
    glb.document["nodes"] = [{"mesh": 0}]
    assert len(read(glb, tmp_path).triangles.faces) == 24, "what is stored without compression is read"
    del glb.document["accessors"][primitive["attributes"]["POSITION"]]["bufferView"]
    with pytest.raises(UserError, match=r"meshes\[0\]\.primitives\[1\]\.extensions has KHR_draco.*without Draco"):
        read(glb, tmp_path)


def test_pointers_to_nodes_are_followed_and_others_counted(tmp_path):
    glb = Glb()
    glb.add("meshes", primitives=[glb.primitive(BOX, BOX_FACES)])
    glb.document["nodes"] = [{"mesh": 0}]
    clip = glb.clip("Slide")
    glb.animate(clip, 0, "translation", [0.0, 2.0], np.array([[0.0, 0, 0], [4, 0, 0]]))
    glb.animate(clip, 0, "translation", [0.0, 2.0], np.array([[0.0, 0, 0], [4, 0, 0]]))
    for channel, pointer in zip(glb.document["animations"][0]["channels"], ("/nodes/0/translation", "/materials/0/x")):
        channel["target"] = {"path": "pointer", "extensions": {"KHR_animation_pointer": {"pointer": pointer}}}
    scene = read(glb, tmp_path)
    assert np.abs(scene.posed(1.0).positions - upright(BOX + np.array([2.0, 0, 0]))).max() < 1e-6
    assert scene.clip is not None and scene.clip.ignored == 1 and (scene.clip.start, scene.clip.end) == (0, 2)
    lines = describe(scene, (0.0, 2.0))
    assert any(line.startswith("1 of its channels") for line in lines) and "nothing will move" not in " ".join(lines)
    assert any("has no length: nothing will move" in line for line in describe(scene, (1.0, 1.0)))


def test_matrix_nodes_instances_and_several_primitives(tmp_path):
    glb = Glb()
    red = glb.add("materials", pbrMetallicRoughness={"baseColorFactor": [1, 0, 0, 1]})
    glb.add("meshes", primitives=[glb.primitive(BOX, BOX_FACES, material=red), glb.primitive(BOX * 0.5, BOX_FACES)])
    matrix = np.eye(4)
    matrix[:3, 3] = [5, 6, 7]
    glb.document["nodes"] = [{"children": [1, 2]}, {"mesh": 0}, {"mesh": 0, "matrix": matrix.T.reshape(-1).tolist()}]
    glb.document["nodes"].append({"mesh": 0, "translation": [99, 0, 0]})  # in no scene
    scene = read(glb, tmp_path)
    assert scene.clip is None and scene.clips == []
    found = scene.posed(0.0).positions
    expected = np.concatenate([BOX, BOX * 0.5, BOX + matrix[:3, 3], BOX * 0.5 + matrix[:3, 3]])
    assert np.abs(found - upright(expected)).max() < 1e-6
    assert scene.triangles.faces.max() == 31 and np.bincount(scene.triangles.material).tolist() == [24, 24]


def test_morph_targets(tmp_path):
    glb = Glb()
    targets = np.random.default_rng(0).normal(size=(2, 8, 3))
    primitive = glb.primitive(BOX, BOX_FACES, targets=[{"POSITION": glb.array(target)} for target in targets])
    glb.add("meshes", primitives=[primitive], weights=[0.25, 0.5])
    glb.document["nodes"] = [{"mesh": 0}]
    still = read(glb, tmp_path).posed(0.0).positions
    assert np.abs(still - upright(BOX + 0.25 * targets[0] + 0.5 * targets[1])).max() < 1e-6
    glb.document["nodes"][0]["weights"] = [1.0, 0.0]
    assert np.abs(read(glb, tmp_path).posed(0.0).positions - upright(BOX + targets[0])).max() < 1e-6
    clip = glb.clip("Smile")
    glb.animate(clip, 0, "weights", [0.0, 2.0], np.array([0.0, 1.0, 1.0, 0.0])[:, None])
    moved = read(glb, tmp_path).posed(0.5).positions
    assert np.abs(moved - upright(BOX + 0.25 * targets[0] + 0.75 * targets[1])).max() < 1e-6


def test_strips_fans_and_no_indices(tmp_path):
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]])
    for mode, points in ((5, square), (6, square[[0, 1, 3, 2]]), (4, square[[0, 1, 2, 2, 1, 3]])):
        glb = Glb()
        glb.add("meshes", primitives=[glb.primitive(points, mode=mode)])
        glb.document["nodes"] = [{"mesh": 0}]
        scene = read(glb, tmp_path)
        corners = points[scene.triangles.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.allclose(normals, [[0, 0, 1], [0, 0, 1]])


def test_vertices_that_no_triangle_uses_are_left_out(tmp_path):
    glb = Glb()
    stray = np.concatenate([[[99.0, 0, 0]], BOX, [[0, 99.0, 0]]])
    glb.add("meshes", primitives=[glb.primitive(stray, BOX_FACES + 1)])
    glb.document["nodes"] = [{"mesh": 0}]
    scene = read(glb, tmp_path)
    assert np.abs(scene.posed(0.0).positions - upright(BOX)).max() < 1e-6
    assert np.array_equal(scene.triangles.faces, BOX_FACES)


def test_sparse_strided_and_quantised_accessors(tmp_path):
    glb = Glb()
    values = np.arange(24, dtype=np.float32).reshape(8, 3)
    padded = np.concatenate([values, np.full((8, 2), np.nan, np.float32)], 1)
    view = glb.view(padded.tobytes(), byteStride=20)
    strided = glb.add("accessors", bufferView=view, componentType=5126, count=8, type="VEC3")
    sparse = {
        "count": 2,
        "indices": {"bufferView": glb.view(np.array([1, 5], np.uint16).tobytes()), "componentType": 5123},
        "values": {"bufferView": glb.view(np.full((2, 3), 7, np.float32).tobytes())},
    }
    glb.document["accessors"][strided]["sparse"] = sparse
    zeros = glb.add("accessors", componentType=5126, count=8, type="VEC3", sparse=sparse)
    signed = glb.array([[-128, 0, 127]], "b", normalized=True)
    file = GltfFile(glb.save(tmp_path / "x.glb"))
    expected = values.astype(float)
    expected[[1, 5]] = 7
    assert np.array_equal(file.array(strided, "x", 3), expected)
    replaced = np.zeros((8, 3))
    replaced[[1, 5]] = 7
    assert np.array_equal(file.array(zeros, "x", 3), replaced)
    assert np.array_equal(file.array(signed, "x", 3), [[-1, 0, 1]])


def test_separate_and_embedded_buffers(tmp_path):
    glb = box()
    data = bytes(glb.binary)
    uris = {
        "embedded": "data:application/octet-stream;base64," + base64.b64encode(data).decode(),
        "beside": "a%20b.bin",
    }
    (tmp_path / "a b.bin").write_bytes(data)
    for name, uri in uris.items():
        document = {**glb.document, "buffers": [{"byteLength": len(data), "uri": uri}]}
        (tmp_path / f"{name}.gltf").write_text(json.dumps(document))
        assert len(read_scene(tmp_path / f"{name}.gltf").triangles.faces) == 12
    before = read_scene(tmp_path / "beside.gltf").digest
    (tmp_path / "a b.bin").write_bytes(data + b"\0")
    assert read_scene(tmp_path / "beside.gltf").digest != before


def test_files_beside_may_differ_in_case(tmp_path):
    glb = quad(np.full((2, 2, 3), 90, np.uint8))
    view = glb.document["bufferViews"][glb.document["images"][0].pop("bufferView")]
    start = view["byteOffset"]
    (tmp_path / "Skin.PNG").write_bytes(glb.binary[start : start + view["byteLength"]])
    (tmp_path / "Mesh.bin").write_bytes(glb.binary)
    glb.document["images"][0] = {"uri": "skin.png"}
    glb.document["buffers"] = [{"byteLength": len(glb.binary), "uri": "mesh.BIN"}]
    (tmp_path / "scene.gltf").write_text(json.dumps(glb.document))
    assert (read_scene(tmp_path / "scene.gltf").textures[0].pixels[..., :3] == 90).all()


def test_clips_by_name(tmp_path):
    glb = box()
    glb.clip("Walk")
    glb.animate(1, 1, "translation", [0.5, 2.5], [[0, 0, 0], [0, 1, 0]])
    glb.animate(glb.clip(), 1, "scale", [0.0], [[2, 2, 2]])
    for wanted, name in ((None, "Slide"), ("Walk", "Walk"), ("walk", "Walk"), ("animation_2", "animation_2")):
        scene = read(glb, tmp_path, wanted)
        assert scene.clip is not None and scene.clip.name == name
    with pytest.raises(UserError, match=r"Slide \(1\.00 s\), Walk \(2\.00 s\), animation_2"):
        read(glb, tmp_path, "Run")
    with pytest.raises(UserError, match="no animation; leave out --clip"):
        read(quad(), tmp_path, "Run")


def test_the_first_clip_that_moves_is_taken(tmp_path):
    glb = box()
    slide = glb.document["animations"].pop()
    glb.clip("T-Pose")
    glb.animate(glb.clip("RESET"), 1, "scale", [0.0], [[2, 2, 2]])
    glb.animate(glb.clip("Rest"), 1, "translation", [0.0, 1.0], [[1, 2, 3], [1, 2, 3]])
    glb.document["animations"].append(slide)
    scene = read(glb, tmp_path)
    assert scene.clip is not None and scene.clip.name == "Slide"
    rest = read(glb, tmp_path, "rest")
    assert any("nothing will move" in line for line in describe(rest, (0.0, 1.0)))
    glb.document["animations"].pop()
    still = read(glb, tmp_path)
    assert still.clip is not None and still.clip.name == "T-Pose"


def test_two_keyframes_at_one_time_are_a_jump(tmp_path):
    glb = box()
    times, places = [0.0, 1.0, 1.0, 2.0], [[0, 0, 0], [1, 0, 0], [5, 0, 0], [6, 0, 0]]
    glb.animate(glb.clip("Jump"), 1, "translation", times, places)
    scene = read(glb, tmp_path, "Jump")
    seen = [scene.nodes.world(scene.clip, second)[1, 0, 3] for second in (0.5, 0.999, 1.0, 1.5)]
    np.testing.assert_allclose(seen, [0.5, 0.999, 5.0, 5.5])
    glb.animate(glb.clip("Back"), 1, "translation", [0.0, 1.0, 0.5], places[:3])
    with pytest.raises(UserError, match="keyframe times that fall"):
        read(glb, tmp_path, "Jump")


def test_a_black_material_that_shines_has_the_colour_of_its_emission(tmp_path):
    """As programs export materials without shading."""
    glb = quad(np.full((2, 2, 3), 90, np.uint8), pbr={"baseColorFactor": [0, 0, 0, 0.5]}, emissiveFactor=[1, 1, 0.5])
    material = glb.document["materials"][0]
    material["emissiveTexture"] = material["pbrMetallicRoughness"].pop("baseColorTexture")
    found = read(glb, tmp_path).materials[0]
    assert found.factor == (1.0, 1.0, 0.5, 0.5) and found.texture == 0 and found.unlit
    material["pbrMetallicRoughness"]["baseColorFactor"] = [0.1, 0, 0, 1]
    lit = read(glb, tmp_path).materials[0]
    assert lit.factor == (0.1, 0.0, 0.0, 1.0) and lit.texture == -1 and not lit.unlit


def test_texture_transform_moves_coordinates(tmp_path):
    glb = quad(np.zeros((2, 2, 3), np.uint8))
    info = glb.document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    info["extensions"] = {"KHR_texture_transform": {"offset": [0.5, 0], "scale": [2, 1], "rotation": np.pi / 2}}
    found = read(glb, tmp_path).triangles.uv
    assert np.allclose(found, [[1.5, 0], [1.5, -2], [0.5, -2], [0.5, 0]])
