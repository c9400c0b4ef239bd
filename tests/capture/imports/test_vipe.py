"""Results of ViPE: a film, poses and intrinsics by the numbers of frames, depth in an archive."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch

from helpers.foreign_scenes import COUNT, K, wall, write_vipe
from helpers.importing import entries, refused, silent
from scgs_warp.capture import import_scene
from scgs_warp.capture.imports import vipe
from scgs_warp.data import load
from scgs_warp.storage.exr_files import INSTALL, reads_exr

UNPOSED = 1
"""Number of the frame without a pose."""
POSED = [number for number in range(COUNT) if number != UNPOSED]
write = partial(write_vipe, unposed=UNPOSED)


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
