"""Attacks by files: no file runs code, leaves its folder or exhausts the machine, as SECURITY.md promises."""

from __future__ import annotations

import json
import os
import pickle
import secrets
import struct
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement
from safetensors.torch import load_file, save_file

from fuzz.files_runs import load_resumed, write_model, write_resumable
from helpers.edit_scenes import bar_scene
from helpers.gltf_files import box
from helpers.layouts import write_colmap, write_nerfies, write_panoptic
from helpers.nerfstudio_files import write as write_nerfstudio
from helpers.tiny import write_dnerf
from scgs_warp.data import load
from scgs_warp.data.images import decode
from scgs_warp.data.points import read_ply
from scgs_warp.edit import EditSession
from scgs_warp.editor import files
from scgs_warp.errors import UserError
from scgs_warp.formats.gaussian_files import read_gaussians
from scgs_warp.scene.scene import Scene
from scgs_warp.storage import checkpoint
from scgs_warp.storage.files import write_atomically


class Payload:
    """Object whose unpickling leaves a mark."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.mark),)


def refused(action: Any, *words: str) -> str:
    """Return the one line of a refusal."""
    with pytest.raises(UserError) as caught:
        action()
    text = str(caught.value)
    assert text.isprintable() and all(word in text for word in words), text
    return text


def test_a_pickle_that_calls_itself_a_checkpoint_is_not_opened(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    for write in (
        lambda path: path.write_bytes(pickle.dumps(Payload(tmp_path / "mark"))),
        lambda path: torch.save({"x": Payload(tmp_path / "mark")}, path),
    ):
        write(run / "checkpoint.safetensors")
        refused(lambda: Scene.load(run), "checkpoint.safetensors", "damaged or not ours")
    assert not (tmp_path / "mark").exists()
    objects = np.array([Payload(tmp_path / "mark")], object)
    write_nerfies(tmp_path / "data", 4)
    np.save(tmp_path / "data/points.npy", objects, allow_pickle=True)
    refused(lambda: load(tmp_path / "data"), "points.npy")
    assert not (tmp_path / "mark").exists()


def rewrite(run: Path, change: Any) -> None:
    """Rewrite a checkpoint with other tensors or metadata as a valid file."""
    path = run / checkpoint.FILE
    tensors, metadata = checkpoint.read(run)
    change(tensors, metadata)
    text = json.dumps(metadata)
    save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, path, {checkpoint.METADATA_KEY: text})
    assert load_file(path)


def put(*keys: str, value: Any) -> Any:
    def change(tensors: dict[str, torch.Tensor], metadata: dict[str, Any]) -> None:
        metadata.pop("crc32", None)
        inner: Any = metadata
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = value

    return change


def tensor(name: str, make: Any) -> Any:
    def change(tensors: dict[str, torch.Tensor], metadata: dict[str, Any]) -> None:
        metadata.pop("crc32", None)
        tensors[name] = make(tensors.get(name))

    return change


def far_control_point(tensors: dict[str, torch.Tensor], metadata: dict[str, Any]) -> None:
    """A control point that no Gaussian follows, and a network that moves everything by a third of float32's range."""
    metadata.pop("crc32", None)
    tensors["motion.positions"][0, 0] = 3e38
    tensors["motion.network.head.bias"][7:] = 1e38


CHECKPOINTS = {
    "a network of terabytes": (put("config", "motion", "width", value=10**9), "motion.width"),
    "layers without end": (put("config", "motion", "layers", value=10**8), "motion.layers"),
    "chunks without end": (put("config", "motion", "chunks", value=10**6), "motion.chunks"),
    "chunks too large together": (put("config", "motion", value={"chunks": 64, "width": 2048}), "motion.chunks"),
    "less than a chunk": (put("config", "motion", "chunks", value=0), "chunks"),
    "chunks that are not there": (put("config", "motion", "chunks", value=3), "not a complete checkpoint"),
    "no number": (put("config", "motion", "width", value=float("nan")), "motion.width"),
    "another motion": (put("motion", value="__import__('os')"), "no motion model"),
    "a scale of 0": (put("normalisation", "scale", value=0.0), "normalisation.scale"),
    "a step that is text": (put("step", value="1"), "metadata.step"),
    "Gaussians without end": (tensor("gaussians.means", lambda _: torch.zeros(10**12, 0)), "gaussians.means"),
    "nodes without end": (tensor("motion.positions", lambda _: torch.zeros(10**12, 0)), "motion.positions"),
    "NaN": (tensor("gaussians.quats", lambda old: old * float("nan")), "gaussians.quats"),
    "other rows": (tensor("gaussians.opacity_logits", lambda old: old[:3]), "gaussians.opacity_logits"),
    "other harmonics": (tensor("gaussians.sh_rest", lambda old: old[:, :2]), "gaussians.sh_rest"),
    "whole numbers": (tensor("gaussians.means", lambda old: old.to(torch.int64)), "gaussians.means"),
    "hyper-coordinates of another size": (
        tensor("gaussians.hyper", lambda old: old[:, :0]),
        "gaussians.hyper has 0 columns, not 2",
    ),
    "a control point that overflows": (far_control_point, "the control points are not finite"),
    "scales that overflow": (tensor("gaussians.log_scales", lambda old: old + 1e6), "scales are not finite"),
}


@pytest.mark.parametrize("case", CHECKPOINTS)
def test_a_malicious_checkpoint_is_refused(tmp_path, case):
    change, words = CHECKPOINTS[case]
    write_model("control-points", tmp_path / "run")
    Scene.load(tmp_path / "run")
    rewrite(tmp_path / "run", change)
    refused(lambda: Scene.load(tmp_path / "run"), "checkpoint.safetensors", words)


def test_a_checkpoint_whose_header_lies_is_refused(tmp_path):
    write_model("static", tmp_path / "run")
    path = tmp_path / "run" / checkpoint.FILE
    whole = path.read_bytes()
    for length in (10**12, 2**63, 2**64 - 1):
        path.write_bytes(struct.pack("<Q", length) + whole[8:])
        refused(lambda: Scene.load(tmp_path / "run"), "damaged or not ours")


def test_a_graph_that_points_outside_its_arrays_is_refused(tmp_path):
    """Indices out of range would make a kernel read and write outside its arrays."""
    write_resumable(tmp_path / "run")
    load_resumed(tmp_path / "run")
    nodes = len(checkpoint.read(tmp_path / "run")[0]["motion.positions"])
    for index in (nodes, 2**31 - 1, -2, -(2**31)):

        def change(tensors: dict[str, torch.Tensor], metadata: dict[str, Any], index: int = index) -> None:
            metadata.pop("crc32", None)
            tensors["extra.graph.neighbors"] = torch.full((nodes, 4), index, dtype=torch.int32)
            tensors["extra.graph.weights"] = torch.full((nodes, 4), 0.25)

        rewrite(tmp_path / "run", change)
        refused(lambda: load_resumed(tmp_path / "run"), "extra.graph.neighbors")


PLY = "ply\nformat {form} 1.0\nelement vertex {count}\n{rest}end_header\n"
FLOATS = "".join(f"property float {axis}\n" for axis in "xyz")
HEADERS = {
    "a million millions": PLY.format(form="binary_little_endian", count=10**12, rest=FLOATS),
    "more than numbers hold": PLY.format(form="binary_little_endian", count=10**30, rest=FLOATS),
    "as text": PLY.format(form="ascii", count=10**12, rest=FLOATS),
    "fewer than none": PLY.format(form="binary_little_endian", count=-5, rest=FLOATS),
    "lists": PLY.format(form="binary_little_endian", count=10**9, rest="property list uint float x\n" + FLOATS),
    "no types": PLY.format(form="binary_little_endian", count=2, rest="property object x\n"),
    "no end": "ply\nformat ascii 1.0\n" + "comment x\n" * 1000,
    "another element": "ply\nformat binary_little_endian 1.0\nelement b 1000000000000\nproperty double a\nend_header\n",
}


@pytest.mark.parametrize("case", HEADERS)
def test_a_malicious_ply_header_is_refused(tmp_path, case):
    path = tmp_path / "a.ply"
    path.write_bytes(HEADERS[case].encode() + bytes(64))
    for read in (read_ply, read_gaussians):
        refused(lambda read=read: read(path), "a.ply", ";")


WAYS_OUT = ("../secret.png", "a/../../secret.png", "/etc/hostname", "..\\secret.png", "C:/x.png", "//host/x.png", "..")
BAD_NAMES = ("a\0b.png", "x" * 300, "\ud800.png", " ")


def json_field(path: Path, *keys: Any) -> Any:
    """Set a path at a place of a JSON file."""

    def change(name: str) -> None:
        content = json.loads(path.read_text())
        inner = content
        for key in keys[:-1]:
            inner = inner[key]
        inner[keys[-1]] = name
        path.write_text(json.dumps(content))

    return change


PLACES = {
    "nerfstudio": (write_nerfstudio, "transforms.json", ("frames", 1, "file_path"), "frames[1].file_path"),
    "mask": (write_nerfstudio, "transforms.json", ("frames", 0, "mask_path"), "frames[0].mask_path"),
    "points": (write_nerfstudio, "transforms.json", ("ply_file_path",), "ply_file_path"),
    "dnerf": (write_dnerf, "transforms_train.json", ("frames", 2, "file_path"), "frames[2].file_path"),
    "panoptic": (write_panoptic, "train_meta.json", ("fn", 0, 0), "fn[0][0]"),
    "nerfies": (lambda folder: write_nerfies(folder, 4), "dataset.json", ("train_ids", 0), "train_ids"),
}


@pytest.mark.parametrize("layout", PLACES)
def test_names_in_data_do_not_lead_out_of_the_folder(tmp_path, layout):
    write, file, keys, field = PLACES[layout]
    folder = tmp_path / "scene"
    write(folder)
    load(folder)
    np.savez(tmp_path / "secret.png")
    change = json_field(folder / file, *keys)
    for name in (*WAYS_OUT, *BAD_NAMES):
        change(name)
        refused(lambda: load(folder), str(folder / file), field, ";")


def test_names_inside_the_folder_may_be_said_in_any_way(tmp_path):
    folder = tmp_path / "scene"
    content = write_nerfstudio(folder)
    before = load(folder)[1].image
    for name in ("./f_1.png", "x/../f_1.png", "x\\..\\f_1.png", str(folder / "f_1.png"), f"../scene/{'f_1.png'}"):
        content["frames"][1]["file_path"] = name
        (folder / "transforms.json").write_text(json.dumps(content))
        assert torch.equal(load(folder)[1].image, before), name
    (tmp_path / "f_1.png").write_bytes((folder / "f_1.png").read_bytes())
    (folder / "linked.png").symlink_to(tmp_path / "f_1.png")  # whoever owns the folder put it there
    content["frames"][1]["file_path"] = "linked.png"
    (folder / "transforms.json").write_text(json.dumps(content))
    assert torch.equal(load(folder)[1].image, before)


@pytest.mark.parametrize("name", ["../out.png", "/etc/hostname", "a/../../x.png"])
def test_names_in_a_colmap_model_do_not_lead_out(tmp_path, name):
    write_colmap(tmp_path / "scene", 3, text=True)
    path = tmp_path / "scene/sparse/0/images.txt"
    path.write_text(path.read_text().replace("frame_2.png", name))
    refused(lambda: load(tmp_path / "scene"), "sparse/0", "leads out of")


@pytest.mark.parametrize("uri", ["../../secret.bin", "/dev/zero", "%2e%2e/secret.bin", "file:///etc/passwd", "%00"])
def test_uris_of_a_gltf_stay_beside_it(tmp_path, uri):
    pytest.importorskip("pygltflib")
    from scgs_warp.data.gltf.scene import read_scene

    glb = box()
    folder = tmp_path / "models/box"
    folder.mkdir(parents=True)
    (tmp_path / "secret.bin").write_bytes(bytes(glb.binary))
    (tmp_path / "models/secret.bin").write_bytes(bytes(glb.binary))
    glb.document["buffers"] = [{"byteLength": len(glb.binary), "uri": uri}]
    (folder / "a.gltf").write_text(json.dumps(glb.document))
    refused(lambda: read_scene(folder / "a.gltf"), "buffers[0].uri")


def test_what_is_no_file_is_not_read(tmp_path):
    """``/dev/zero`` never ends; a pipe without a writer never begins."""
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "zero.png").symlink_to("/dev/zero")
    for name in ("pipe.png", "zero.png"):
        done: list[str] = []
        worker = threading.Thread(
            target=lambda name=name, done=done: done.append(refused(lambda: decode(tmp_path / name), "not a regular")),
            daemon=True,
        )
        worker.start()
        worker.join(20)
        assert done, name


EDIT: dict[str, Any] = {"format": "scgs-warp edit", "version": 1}


@pytest.mark.parametrize(
    "more",
    [
        {"output": "/etc/cron.d/x"},
        {"path": "../../x"},
        {"include": "/etc/passwd"},
        {"film": {"output": "../../film.mp4"}},
        {"film": {"path": "/tmp/x"}},
        {"scene": {"run": "../other"}},
        {"handles": [{"name": "a", "nodes": [0], "file": "/etc/passwd"}]},
        {"handles": [{"name": "a", "nodes": "../../nodes.json"}]},
        {"exec": "import os"},
    ],
    ids=str,
)
def test_paths_in_an_edit_are_refused(tmp_path, more):
    path = tmp_path / "edit.json"
    path.write_text(json.dumps({**EDIT, **more}))
    before = sorted(tmp_path.iterdir())
    refused(lambda: EditSession(bar_scene(nodes=12, gaussians=30)).load(path), "edit.json")
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("name", ["../x", "a/b", "/etc/x", "..", "", "a\0b", "a\nb", ".hidden", "x" * 200, "\u202ea"])
def test_names_in_the_editor_stay_in_its_folder(tmp_path, name):
    refused(lambda: files.output_path(tmp_path / "edits", name, ".json"), "file name")
    assert not (tmp_path / "edits").exists()


def test_messages_cannot_command_a_terminal():
    text = str(UserError("a\x1b[2Jb\r\nc\u202ed\ud800 " + "x" * 5000))
    assert text.isprintable() and len(text) <= 1100 and "\\x1b[2Jb c\\u202ed\\ud800" in text


def test_a_link_in_the_place_of_a_temporary_file_is_not_written_through(tmp_path, monkeypatch):
    victim = tmp_path / "victim"
    victim.write_text("mine")
    (tmp_path / ".a.json.0123abcd.tmp").symlink_to(victim)
    monkeypatch.setattr(secrets, "token_hex", lambda _: "0123abcd")  # an attacker who guesses right
    write_atomically(tmp_path / "a.json", b"{}")
    assert victim.read_text() == "mine" and (tmp_path / "a.json").read_bytes() == b"{}"


def test_a_picture_that_claims_to_be_gigantic_is_not_unpacked(tmp_path):
    import zlib

    head = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    rows = zlib.compress(bytes(60_001 * 60), 9)
    chunks = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in ((b"IHDR", head), (b"IDAT", rows), (b"IEND", b""))
    )
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunks)
    refused(lambda: decode(tmp_path / "a.png"), "a.png", "save it again, smaller")


def test_gaussians_of_a_ply_that_cannot_be_drawn_are_left_out(tmp_path):
    names = ["x", "y", "z", "opacity", *(f"f_dc_{i}" for i in range(3)), *(f"scale_{i}" for i in range(3))]
    rows = np.zeros(5, [(name, "<f4") for name in (*names, *(f"rot_{i}" for i in range(4)))])
    rows["rot_0"] = 1.0
    rows["scale_1"][0], rows["x"][1], rows["f_dc_2"][2] = 200.0, 1e30, 1e9
    rows["opacity"][3] = np.inf  # opaque: some programs write it so
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "a.ply"))
    found = read_gaussians(tmp_path / "a.ply")
    assert len(found) == 2 and float(found.opacities().max()) == 1.0
    assert bool(torch.isfinite(found.opacity_logits).all())
