"""Scenes of other programs: the same cameras, images, times and points in every layout, and mistakes in one line."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from helpers.foreign_scenes import (
    COUNT,
    WALL,
    WRITERS,
    K,
    wall,
    write_depth_anything,
    write_megasam,
    write_monst3r,
    write_polycam,
    write_record3d,
    write_scanner,
    write_vggt,
)
from helpers.importing import entries, refused, silent
from scgs_warp.apps import capture as app
from scgs_warp.capture import import_scene
from scgs_warp.capture.imports.depth_writing import DepthWriter
from scgs_warp.capture.imports.stacks import Stack
from scgs_warp.capture.similarity import align, centres
from scgs_warp.data import load
from scgs_warp.errors import UserError

METRIC = ("Polycam", "Record3D", "3D Scanner App")


@pytest.fixture(params=list(WRITERS))
def imported(request, tmp_path):
    source = WRITERS[request.param](tmp_path / "source")
    made = import_scene(source, tmp_path / "data", silent)
    assert made.program == request.param and made.frames == COUNT
    return request.param, tmp_path / "data", made


def test_cameras_images_and_times(imported):
    program, folder, _ = imported
    truth, found = wall(), entries(folder)
    assert len(found) == COUNT and len(load(folder, "test")) == 1
    np.testing.assert_allclose([entry.time for entry in found], np.linspace(0, 1, COUNT), atol=1e-3)
    views = torch.stack([entry.camera.viewmat for entry in found]).double().numpy()
    if program not in METRIC:  # their worlds have any orientation and scale
        views = align(centres(views), centres(truth.viewmats)).viewmats(views)
        turns = [v[1:, :3, :3] @ v[0, :3, :3].T for v in (views, truth.viewmats)]
        np.testing.assert_allclose(turns[0], turns[1], atol=1e-4)
        np.testing.assert_allclose(centres(views), centres(truth.viewmats), atol=1e-3)
    else:
        np.testing.assert_allclose(views, truth.viewmats, atol=1e-4)
    np.testing.assert_allclose(found[0].camera.K.numpy(), K, atol=1e-4)
    data = load(folder)
    assert np.abs(data[0].image.numpy() * 255 - truth.images[0]).max() <= 1.0


def test_the_app_of_depth_anything_uses_other_names(tmp_path):
    """``predictions.npz`` of its app holds the arrays of ``results.npz``, two of them in the plural."""
    source = write_depth_anything(tmp_path / "source", images="images", depth="depths")
    made = import_scene(source, tmp_path / "data", silent)
    assert (made.program, made.frames) == ("Depth Anything 3", COUNT) and made.points > 500


def test_depth_gives_points_where_the_wall_is(imported):
    """In the frame of the cameras, at the depth of the wall, in its colours."""
    program, folder, _ = imported
    data = load(folder)
    if program in ("Record3D", "ViPE"):
        pytest.importorskip("OpenEXR")
    assert data.points is not None and len(data.points) > 500 and data.colors is not None
    camera, truth = data.entries[0].camera, wall()
    scale = 1.0
    if program not in METRIC:
        found = torch.stack([e.camera.viewmat for e in entries(folder)]).double().numpy()
        scale = align(centres(found), centres(truth.viewmats)).scale
    local = data.points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = (local @ camera.K.T)[:, :2] / local[:, 2:]
    inside = ((pixels >= 1) & (pixels < torch.tensor([47.0, 35.0]))).all(1)
    columns, rows = pixels[inside].long().T
    depth = local[inside, 2].numpy() * scale
    assert np.median(np.abs(depth - truth.depths[0][rows, columns])) < 0.03
    error = (data.colors[inside] - data[0].image[rows, columns]).abs().mean(1)
    assert inside.sum() > 200 and error.median() < 0.08
    if program in METRIC:
        assert np.median(np.abs(data.points[:, 1].numpy() - WALL)) < 0.02


def test_depth_maps_are_those_of_the_wall(imported):
    """In the units of the written cameras, at every frame."""
    program, folder, _ = imported
    data, truth = load(folder), wall()
    if program in ("Record3D", "ViPE"):
        pytest.importorskip("OpenEXR")
    assert data.with_depth == list(range(len(data)))
    scale = 1.0
    if program not in METRIC:
        found = torch.stack([e.camera.viewmat for e in entries(folder)]).double().numpy()
        scale = align(centres(found), centres(truth.viewmats)).scale
    order = {round(entry.time, 3): index for index, entry in enumerate(entries(folder))}
    for index, entry in enumerate(data.entries):
        depth, true = data.depth(index), truth.depths[order[round(entry.time, 3)]]
        assert depth is not None
        every = len(true) // len(depth)  # Polycam's maps are smaller than its images
        true = true[::every, ::every]
        assert depth.shape == true.shape
        known = depth > 0
        assert float(known.float().mean()) > 0.5
        error = (depth.double().numpy() * scale - true)[known.numpy()]
        assert np.abs(error).max() < 0.01 * true.max(), program


def test_depth_of_any_scale_and_size_is_written(tmp_path):
    """float16 holds it in units of the first map's median; large maps are reduced; unknown ones are left out."""
    for scale in (1e-7, 1.0, 1e7):
        writer = DepthWriter(tmp_path / f"{scale}")
        (tmp_path / f"{scale}").mkdir()
        assert writer.write("none", np.zeros((4, 4)), (40, 40)) is None
        depth = scale * np.linspace(1.0, 3.0, 1024 * 768).reshape(768, 1024)
        depth[:2] = np.nan
        assert writer.write("other", depth, (1024, 700)) is None, "other proportions"
        name = writer.write("a", depth, (1024, 768))
        assert name == "depths/a.npy"
        found = np.load(tmp_path / f"{scale}" / name)
        assert found.shape == (384, 512) and found.dtype == np.float16
        np.testing.assert_allclose(found[1:].astype(np.float64) * writer.unit, depth[3::2, 1::2], rtol=2e-3)
        assert not found[0].any()


def test_the_app_imports(tmp_path, capsys):
    source = write_megasam(tmp_path / "source")
    assert app.cli(["--poses", str(source), "--output", str(tmp_path / "data"), "--device", "cpu"]) == 0
    printed = capsys.readouterr().out
    assert "6 frames of MegaSaM" in printed and "points from its depth" in printed
    assert app.cli(["--poses", str(source), "--output", str(tmp_path / "data"), "--device", "cpu"]) == 2
    assert "holds something else" in capsys.readouterr().err
    assert app.cli(["film.mp4", "--poses", str(source), "--output", str(tmp_path / "x"), "--device", "cpu"]) == 2
    assert "both VIDEO and --poses" in capsys.readouterr().err


@pytest.mark.parametrize("orientation", [3, 4, 6])
def test_photos_that_a_tag_turns_are_refused(tmp_path, orientation):
    """Their cameras describe the stored pixels, viewers and other readers show turned ones."""
    from PIL import Image

    source = write_scanner(tmp_path / "source")
    for index, path in enumerate(sorted(source.glob("frame_*.png"))):
        tag = Image.Exif()
        tag[0x0112] = 1 if index < 3 else orientation
        Image.open(path).save(path.with_suffix(".jpg"), exif=tag, quality=95)
        path.unlink()
    refused(source, tmp_path, "frame_00003.jpg: is turned by its EXIF tag")


def test_a_time_beyond_all_clocks_is_refused(tmp_path):
    source = write_monst3r(tmp_path / "source")
    track = source / "pred_traj.txt"
    rows = track.read_text().splitlines()
    track.write_text("\n".join([*rows[:-1], "2e19 " + rows[-1].split(" ", 1)[1]]))
    refused(source, tmp_path, "source: a frame has the time 2e.19")


def with_arrays(path: Path, **changed) -> Path:
    """Replace arrays of an .npz, or leave one out (None)."""
    with np.load(path, allow_pickle=True) as old:
        arrays = {name: old[name] for name in old.files if name != "pose_enc_list"}
    arrays |= changed
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


def test_other_options_are_refused(tmp_path, capsys):
    source = write_megasam(tmp_path / "source")
    command = ["--poses", str(source), "--output", str(tmp_path / "data"), "--device", "cpu"]
    assert app.cli([*command, "--held-out", "cam00"]) == 2
    assert "--held-out: is for films" in capsys.readouterr().err
    assert app.cli([*command, "--size", "640"]) == 2
    assert app.cli(["--output", str(tmp_path / "data")]) == 2
    assert "neither VIDEO nor --rig nor --poses" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


def test_malformed_arrays(tmp_path):
    fresh = lambda: write_megasam(tmp_path / "source")  # noqa: E731
    refused(with_arrays(fresh(), cam_c2w=None), tmp_path, "holds no poses")
    refused(with_arrays(fresh(), images=None), tmp_path, "holds no images")
    refused(with_arrays(fresh(), cam_c2w=np.zeros((2, 4, 4))), tmp_path, r"cam_c2w is \[2, 4, 4\]")
    refused(with_arrays(fresh(), cam_c2w=np.full((6, 4, 4), np.nan)), tmp_path, r"cam_c2w\[0\] is no finite")
    refused(with_arrays(fresh(), cam_c2w=np.tile(2 * np.eye(4), (6, 1, 1))), tmp_path, "not rigid")
    refused(with_arrays(fresh(), intrinsic=-K), tmp_path, "positive focal lengths")
    refused(with_arrays(fresh(), depths=np.ones((6, 5, 5))), tmp_path, "does not fit 6 images")
    refused(with_arrays(fresh(), depths=np.ones((6, 36, 48, 2))), tmp_path, "does not fit 6 images")
    refused(with_arrays(fresh(), depths=np.ones((6, 0))), tmp_path, "does not fit 6 images")
    refused(with_arrays(fresh(), images=np.zeros((6, 36, 48, 3), np.uint16)), tmp_path, "holds uint16")
    bright = np.linspace(0, 255, 6 * 36 * 48 * 3).reshape(6, 36, 48, 3).astype(np.float32)
    refused(with_arrays(fresh(), images=bright), tmp_path, r"images\[0\] goes from 0 to 42\.\d*; export bytes")
    refused(with_arrays(fresh(), images=bright / 128 - 1), tmp_path, r"images\[0\] goes from -1 to")
    refused(with_arrays(fresh(), intrinsic=K * 1e-9), tmp_path, "positive focal lengths")
    refused(with_arrays(fresh(), images=np.zeros((6, 36, 48, 4), np.uint8)), tmp_path, r"images is \[6, 36, 48, 4\]")
    refused(with_arrays(fresh(), images=np.array([None] * 6, dtype=object)), tmp_path, "no numbers")
    (tmp_path / "bad.npz").write_bytes(b"PK nothing")
    refused(tmp_path / "bad.npz", tmp_path, "holds no poses")
    vggt = with_arrays(write_vggt(tmp_path / "vggt"), intrinsic=np.zeros((3, 3, 3)))
    refused(vggt, tmp_path, r"intrinsic is \[3, 3, 3\]")
    vggt = with_arrays(write_vggt(tmp_path / "sure"), depth_conf=np.ones((6, 36, 40), np.float32))
    refused(vggt, tmp_path, "depth_conf is .* does not fit")


def test_an_array_that_ends_early(tmp_path):
    """Its header promises more frames than there are."""
    import io
    import zipfile

    buffer = io.BytesIO()
    np.save(buffer, np.zeros((4, 8, 8, 3), np.uint8))
    data = buffer.getvalue().replace(b"(4, 8, 8, 3)", b"(9, 8, 8, 3)")
    with zipfile.ZipFile(tmp_path / "short.npz", "w") as archive:
        archive.writestr("images.npy", data)
    with pytest.raises(UserError, match="which it does not hold"):
        Stack(tmp_path / "short.npz", "images")


def test_malformed_folders(tmp_path):
    source = write_monst3r(tmp_path / "monst3r")
    (source / "frame_0005.png").unlink()
    refused(source, tmp_path, "6 rows .* there are 5")
    (write_monst3r(tmp_path / "rows") / "pred_traj.txt").write_text("0 1 2\n")
    refused(tmp_path / "rows", tmp_path, "no table of 8 numbers")
    polycam = write_polycam(tmp_path / "polycam")
    file = sorted((polycam / "keyframes/corrected_cameras").iterdir())[2]
    content = json.loads(file.read_text())
    for key, value, words in (
        ("fx", "wide", "fx is missing or no number"),
        ("t_11", 7.0, "not rigid"),
        ("width", 50, "50 x 72 pixels, but"),
    ):
        file.write_text(json.dumps(content | {key: value}))
        refused(polycam, tmp_path, words)
    file.write_text("[")
    refused(polycam, tmp_path, file.name)
    record = write_record3d(tmp_path / "record3d")
    text = (record / "metadata.json").read_text()
    (record / "metadata.json").write_text(text.replace('"poses"', '"moses"'))
    refused(record, tmp_path, "poses is missing")
    late = json.loads(text) | {"frameTimestamps": [0.0, 1.0, 2.0, 3.0, 4.0, 1e300]}
    (record / "metadata.json").write_text(json.dumps(late))
    refused(record, tmp_path, "the time 1e")
    (record / "metadata.json").write_text(text)
    for number in range(1, 5):
        (record / f"rgb/{number}.png").unlink()
    refused(record, tmp_path, "6 poses, but .* holds 2 images")
    mixed = write_monst3r(tmp_path / "mixed")
    cv2.imwrite(str(mixed / "frame_0002.png"), np.zeros((36, 40, 3), np.uint8))
    refused(mixed, tmp_path, "frame_0002.png: is 40 x 36 pixels, but the first image is 48 x 36")
    unsure = write_monst3r(tmp_path / "unsure")
    np.save(unsure / "conf_2.npy", np.ones((4, 4)))
    refused(unsure, tmp_path, r"conf_2.npy is \[4, 4\], but the depth \[36, 48\]")
    scanner = write_scanner(tmp_path / "scanner")
    cv2.imwrite(str(scanner / "conf_00001.png"), np.zeros((4, 4), np.uint8))
    refused(scanner, tmp_path, "of another size than depth_00001.png")
    (scanner / "conf_00001.png").unlink()
    cv2.imwrite(str(scanner / "depth_00002.png"), np.zeros((4, 4, 3), np.uint8))
    refused(scanner, tmp_path, "no depth image of one channel")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", tmp_path, "is no scene of MegaSaM, VGGT")
    (tmp_path / "capture.r3d").write_bytes(b"PK")
    refused(tmp_path / "capture.r3d", tmp_path, "no zip archive, or a damaged one")
    refused(tmp_path / "none", tmp_path, "no such file or folder")
    (tmp_path / "studio").mkdir()
    (tmp_path / "studio/transforms.json").write_text("{}")
    refused(tmp_path / "studio", tmp_path, "nerfstudio's layout already")


def test_unknown_depth_and_outlines_give_no_points(tmp_path):
    depths = wall().depths.copy()
    depths[:, :, :24] = 0.0
    depths[:, 10:20, 30:40] *= 3.0
    source = with_arrays(write_megasam(tmp_path / "source"), depths=depths)
    made = import_scene(source, tmp_path / "data", silent)
    assert 0 < made.points < COUNT * 36 * 24 - COUNT * 30
    nothing = with_arrays(source, depths=np.full_like(depths, np.nan))
    assert import_scene(nothing, tmp_path / "none", silent).points == 0


def test_unsure_depth_gives_no_points(tmp_path):
    """The least confident fifth of a network's depth, and the lowest of the three levels of a phone."""
    sure, pixels = wall().depths, 36 * 48
    confidence = np.ones_like(sure)
    confidence[:, :7] = 0.5  # 7 of 36 rows: just less than a fifth
    depths = np.where(confidence < 1, 0.5 * sure, sure)
    source = with_arrays(write_vggt(tmp_path / "vggt"), depth=np.float32(depths), depth_conf=confidence)
    made = import_scene(source, tmp_path / "data", silent)
    assert 0.7 * COUNT * pixels < made.points <= COUNT * 29 * 48
    data, truth = load(tmp_path / "data"), wall()
    found = torch.stack([e.camera.viewmat for e in entries(tmp_path / "data")]).double().numpy()
    points = align(centres(found), centres(truth.viewmats)).points(np.asarray(data.points, np.float64))
    moved = points - centres(truth.viewmats).mean(0)
    assert np.ptp(np.linalg.norm(moved, axis=1)) < 2.0  # half the depth would lie far nearer
    scanner = write_scanner(tmp_path / "scanner")
    before = import_scene(scanner, tmp_path / "before", silent).points
    for file in scanner.glob("conf_*.png"):
        level = np.full((36, 48), 2, np.uint8)
        level[:18] = 0
        cv2.imwrite(str(file), level)
    assert import_scene(scanner, tmp_path / "after", silent).points < 0.6 * before


def test_depth_near_zero_gives_no_points(tmp_path):
    """MegaSaM's tracker writes a millionth where depth is unknown."""
    depths = wall().depths.copy()
    depths[:, :, 24:] = 1e-6
    made = import_scene(with_arrays(write_megasam(tmp_path / "s"), depths=depths), tmp_path / "data", silent)
    assert 0 < made.points <= COUNT * 36 * 24
    points = np.asarray(load(tmp_path / "data").points)
    found = torch.stack([e.camera.viewmat for e in entries(tmp_path / "data")]).double().numpy()
    assert np.linalg.norm(points[:, None] - centres(found)[None], axis=2).min() > 0.5
