"""Results of ViPE: a film, poses and intrinsics by the numbers of frames, depth in an archive."""

from __future__ import annotations

import zipfile
from pathlib import Path

import av
import numpy as np
import pytest
import torch

from helpers.foreign_scenes import COUNT, K, wall, write_exr
from helpers.importing import entries, refused, silent
from scgs_warp.capture import import_scene
from scgs_warp.capture.imports import vipe
from scgs_warp.data import load
from scgs_warp.storage.exr_files import INSTALL, reads_exr

UNPOSED = 1
"""Number of the frame without a pose."""
POSED = [number for number in range(COUNT) if number != UNPOSED]


def write(folder: Path, name: str = "film", camera: str = "PINHOLE") -> Path:
    """The wall, with frames as ViPE's program writes them."""
    made = wall()
    for kind in ("rgb", "pose", "intrinsics", "depth", "vipe"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    with av.open(str(folder / f"rgb/{name}.mp4"), "w") as out:
        stream = out.add_stream("libx264rgb", rate=24, options={"crf": "0"})
        stream.width, stream.height, stream.pix_fmt = made.images.shape[2], made.images.shape[1], "rgb24"
        for image in made.images:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")))
        out.mux(stream.encode())
    poses = np.linalg.inv(made.viewmats).astype(np.float32)
    np.savez(folder / f"pose/{name}.npz", data=poses[POSED], inds=np.array(POSED))
    lens = np.tile(np.float32(K[[0, 1, 0, 1], [0, 1, 2, 2]]), (COUNT, 1))
    np.savez(folder / f"intrinsics/{name}.npz", data=lens, inds=np.arange(COUNT))
    (folder / f"intrinsics/{name}_camera.txt").write_text("".join(f"{i}: {camera}\n" for i in range(COUNT)))
    (folder / f"vipe/{name}_info.pkl").write_bytes(b"\x80\x04.")
    with zipfile.ZipFile(folder / f"depth/{name}.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for number in range(COUNT):
            write_exr(folder / "map.exr", {"Z": made.depths[number].astype(np.float16)})
            if reads_exr():
                archive.write(folder / "map.exr", f"{number:05d}.exr")
    return folder


@pytest.mark.parametrize("given", ["", "pose/film.npz", "rgb/film.mp4"])
def test_cameras_images_times_and_depth(tmp_path, given):
    made = import_scene(write(tmp_path / "source") / given, tmp_path / "data", silent)
    note = f"1 of {COUNT} frames have no pose or intrinsics, and are left out"
    assert (made.program, made.frames, (made.note or "").split("; ")[0]) == ("ViPE", COUNT - 1, note)
    truth, found = wall(), entries(tmp_path / "data")
    views = torch.stack([entry.camera.viewmat for entry in found]).double().numpy()
    relative = truth.viewmats[POSED] @ np.linalg.inv(truth.viewmats[0])
    np.testing.assert_allclose((views @ np.linalg.inv(views[0]))[:, :3, :3], relative[:, :3, :3], atol=1e-4)
    np.testing.assert_allclose(found[0].camera.K.numpy(), K, atol=1e-4)
    np.testing.assert_allclose([entry.time for entry in found], np.array(POSED) / (COUNT - 1), atol=1e-3)
    data = load(tmp_path / "data")
    assert np.abs(data[0].image.numpy() * 255 - truth.images[0]).max() <= 2.0
    if reads_exr():
        depth = data.depth(0)
        assert depth is not None and made.points > 500
        expected = truth.depths[0] / np.median(truth.depths[0])
        np.testing.assert_allclose(depth.numpy() / np.median(depth.numpy()), expected, rtol=3e-3)


def test_without_openexr(tmp_path, monkeypatch):
    monkeypatch.setattr(vipe, "reads_exr", lambda: False)
    made = import_scene(write(tmp_path / "source"), tmp_path / "data", silent)
    assert made.points == 0 and made.note is not None and made.note.endswith(f"depth was not read: {INSTALL}")


def test_what_does_not_fit(tmp_path):
    source = write(tmp_path / "source")
    good = dict(np.load(source / "pose/film.npz"))
    for changed, words in (
        ({"data": good["data"][:, :3]}, "not 16 numbers for each of the frames"),
        ({"data": good["data"][0, 0, 0]}, "not 16 numbers for each of the frames"),
        ({"inds": good["inds"][:2]}, "not 16 numbers for each of the frames"),
        ({"inds": np.full(len(good["inds"]), -1)}, "not 16 numbers for each of the frames"),
        ({"data": 2 * good["data"]}, "data of frame 0 is not rigid"),
    ):
        np.savez(source / "pose/film.npz", **{**good, **changed})
        refused(source, tmp_path, words)
    np.savez(source / "pose/film.npz", **good)
    (source / "depth/film.zip").write_bytes(b"no archive")
    if reads_exr():
        refused(source, tmp_path, "film.zip: is no zip archive")
    refused(write(tmp_path / "wide", camera="MEI"), tmp_path, "has the camera 'MEI', and only PINHOLE is read")
    write(tmp_path / "wide", "other")
    refused(tmp_path / "wide", tmp_path, "holds 2 films of ViPE; give one of them, such as .*rgb/film.mp4")
