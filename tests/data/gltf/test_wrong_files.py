"""Wrong glTF files are explained in one line."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.gltf_files import Glb, bar, box, quad

pytest.importorskip("pygltflib")

from scgs_warp.data.gltf.scene import read_scene
from scgs_warp.errors import UserError


def _edit(path: list, value):
    def change(glb: Glb) -> None:
        place = glb.document
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value

    return change


WRONG = {
    "version": (_edit(["asset", "version"], "1.0"), "asset.version is 1.0"),
    "draco": (_edit(["extensionsRequired"], ["KHR_draco_mesh_compression"]), "without Draco"),
    "mesh": (_edit(["nodes", 0, "mesh"], 7), "nodes\\[0\\].mesh is 7"),
    "accessor": (_edit(["meshes", 0, "primitives", 0, "indices"], 99), "indices is 99"),
    "count": (_edit(["accessors", 0, "count"], 10**6), "accessors\\[0\\] needs"),
    "type": (_edit(["accessors", 0, "type"], "VEC9"), "accessors\\[0\\] has an unknown type"),
    "components": (_edit(["accessors", 0, "type"], "SCALAR"), "is SCALAR, but meshes.* needs 4 components"),
    "view": (_edit(["bufferViews", 0, "byteLength"], 10**7), "bufferViews\\[0\\] ends behind"),
    "cycle": (_edit(["nodes"], [{"children": [1]}, {"children": [0]}, {"mesh": 0}]), "its own ancestor"),
    "parents": (_edit(["nodes"], [{"children": [2]}, {"children": [2]}, {"mesh": 0}]), "two parents"),
    "joint": (_edit(["skins", 0, "joints"], [1]), "names joint 1 of 1"),
    "skin": (_edit(["nodes", 3, "skin"], 4), "nodes\\[3\\].skin is 4"),
    "joints": (_edit(["skins", 0, "joints"], []), "skins\\[0\\].joints is empty"),
    "interpolation": (_edit(["animations", 0, "samplers", 0, "interpolation"], "SPLINE"), "interpolated by SPLINE"),
    "keyframes": (_edit(["animations", 0, "samplers", 0, "interpolation"], "CUBICSPLINE"), "3 values for 3"),
    "sampler": (_edit(["animations", 0, "channels", 0, "sampler"], 3), "sampler is 3 of 1"),
    "matrix": (_edit(["nodes", 2], {"matrix": np.eye(4).reshape(-1).tolist()}), "nodes\\[2\\].matrix"),
    "nothing": (_edit(["meshes", 0, "primitives", 0, "mode"], 1), "no triangles \\(only 1 sets of points or lines"),
    "material": (_edit(["meshes", 0, "primitives", 0, "material"], 5), "material is 5"),
    "uri": (_edit(["images"], [{"uri": "no.png"}]), None),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_files_are_explained(tmp_path, name):
    change, message = WRONG[name]
    glb, _ = bar()
    change(glb)
    if name == "mesh":
        glb.document["scenes"] = [{"nodes": [0]}]
    if name == "uri":
        glb.add("textures", source=0)
        glb.document["materials"][0]["pbrMetallicRoughness"] = {"baseColorTexture": {"index": 0}}
        message = "images\\[0\\].uri names no.png"
    with pytest.raises(UserError, match=message) as caught:
        read_scene(glb.save(tmp_path / "x.glb"))
    assert "x.glb" in str(caught.value) and "\n" not in str(caught.value)


def test_files_that_are_no_gltf(tmp_path):
    (tmp_path / "text.glb").write_text("hello")
    (tmp_path / "cut.glb").write_bytes(box().save(tmp_path / "x.glb").read_bytes()[:100])
    (tmp_path / "empty.gltf").write_text("{}")
    (tmp_path / "x.obj").write_text("v 0 0 0")
    for name in ("text.glb", "cut.glb", "empty.gltf", "x.obj", "missing.glb"):
        with pytest.raises(UserError, match=name):
            read_scene(tmp_path / name)


def test_images_that_do_not_decode(tmp_path):
    glb = quad(np.zeros((2, 2, 3), np.uint8))
    view = glb.document["images"][0]["bufferView"]
    start = glb.document["bufferViews"][view]["byteOffset"]
    glb.binary[start : start + 8] = b"nonsense"
    with pytest.raises(UserError, match="images\\[0\\] \\(image/png\\) does not decode"):
        read_scene(glb.save(tmp_path / "x.glb"))


def test_a_folder_is_said_to_be_one(tmp_path):
    with pytest.raises(UserError, match=r"is a folder; name a .glb or .gltf file with --mesh"):
        read_scene(tmp_path)
