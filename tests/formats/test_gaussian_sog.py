"""SOG files: there and back, through the program that defines them, of version 1, and files that are none."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from helpers.export_files import cloud, difference, matched, ordered, picture, ply_columns
from helpers.node_packages import splat_transform
from scgs_warp.errors import UserError
from scgs_warp.export.still import write_still
from scgs_warp.formats import sog_files
from scgs_warp.formats.gaussian_files import read_antialiased, read_gaussians
from scgs_warp.formats.gaussian_sog import write_sog
from scgs_warp.formats.sog_files import MAX_PIXELS, META
from scgs_warp.types import Gaussians

COUNT = 1000
LIMITS = {"scales": 0.06, "opacities": 0.5 / 255 + 1e-6, "colors": 0.01, "degrees": 1.1, "harmonics": 1.2}
"""Largest errors of a cloud of 1,000: the palette has 512 rows for harmonics that are noise."""


def plain(path: Path) -> dict[str, np.ndarray]:
    """Read a file and return it as columns of a plain .ply."""
    target = path.parent / "again" / f"{path.name}.ply"
    write_still(target, read_gaussians(path).activate())
    return ply_columns(target)


def check(found: dict[str, np.ndarray], truth: Gaussians) -> dict[str, float]:
    errors = difference(matched(found, truth), truth)
    reach = float(truth.means.abs().max())
    assert errors["means"] <= (1 + reach) * 2 * np.log1p(reach) / 65535 / 2 + 1e-6, errors
    assert all(errors[name] <= LIMITS[name] for name in errors if name != "means"), errors
    return errors


@pytest.mark.parametrize(("degree", "count"), [(0, 1), (1, 17), (2, 300), (3, COUNT)])
@pytest.mark.parametrize("name", ["a.sog", "folder/meta.json"])
def test_there_and_back(tmp_path, degree, count, name):
    truth, path = ordered(cloud(count, degree)), tmp_path / name
    assert write_still(path, truth) == 0
    check(plain(path), truth)
    if name == "a.sog":
        before = path.read_bytes()
        write_sog(path, truth)
        assert path.read_bytes() == before
        with zipfile.ZipFile(path) as archive:
            assert len(archive.namelist()) == (8 if degree else 6) and archive.testzip() is None
            meta = json.loads(archive.read(META))
        assert meta["count"] == count and meta["version"] == 2 and len(meta["sh0"]["codebook"]) == 256
    else:
        assert torch.equal(read_gaussians(path).means, read_gaussians(path.parent).means)
        assert sorted(p.name for p in tmp_path.iterdir() if p.name != "again") == ["folder"]


@pytest.mark.parametrize("degree", [0, 3])
def test_splat_transform_reads_ours_and_we_read_its(tmp_path, degree):
    truth = ordered(cloud(COUNT, degree))
    write_still(tmp_path / "a.ply", truth)
    write_still(tmp_path / "ours.sog", truth)
    write_still(tmp_path / "loose" / META, truth)
    splat_transform(tmp_path / "a.ply", tmp_path / "theirs.sog", "-g", "cpu")
    for name in ("ours.sog", f"loose/{META}", "theirs.sog"):
        seen = ply_columns(splat_transform(tmp_path / name, tmp_path / "seen.ply"))
        again = plain(tmp_path / name)
        for column, values in seen.items():
            np.testing.assert_allclose(again[column], values, atol=1e-5, rtol=1e-5, err_msg=column)
        if name != "theirs.sog":
            check(seen, truth)
        else:  # it cuts positions, rotations and opacities where we round
            assert difference(matched(seen, truth), truth)["means"] < 1e-3
    assert (tmp_path / "ours.sog").stat().st_size < 1.1 * (tmp_path / "theirs.sog").stat().st_size


def test_the_public_example_is_closer_than_what_splat_transform_makes_of_it(tmp_path, data_root):
    source = data_root / "splats" / "tiny_3dgs_9080.ply"
    truth = picture(read_gaussians(source).activate()).detach()
    write_still(tmp_path / "ours.sog", read_gaussians(source).activate())
    splat_transform(source, tmp_path / "theirs.sog", "-g", "cpu")
    ours, theirs = (
        float((picture(read_gaussians(tmp_path / f"{name}.sog").activate()).detach() - truth).square().mean())
        for name in ("ours", "theirs")
    )
    assert ours < theirs < 1e-3 and ours < 1e-4


def test_a_second_round_changes_nothing(tmp_path):
    """What has been rounded has few values: codebooks and palette hold them exactly."""
    write_still(tmp_path / "a.sog", cloud(COUNT))
    once = read_gaussians(tmp_path / "a.sog")
    write_still(tmp_path / "b.sog", once.activate())
    twice = read_gaussians(tmp_path / "b.sog")
    assert torch.equal(once.sh_rest, twice.sh_rest) and torch.equal(once.sh_dc, twice.sh_dc)
    torch.testing.assert_close(once.log_scales, twice.log_scales, atol=1e-5, rtol=0)
    torch.testing.assert_close(once.means, twice.means, atol=1e-5, rtol=0)


def test_a_flat_scene_and_transparent_colours_are_kept(tmp_path):
    truth = ordered(cloud(50))
    truth.means[:, 2] = 7.0
    truth.opacities[:25] = 0.0
    write_still(tmp_path / "a.sog", truth)
    found = difference(matched(plain(tmp_path / "a.sog"), truth), truth)
    assert found["colors"] < 0.01 and found["means"] < 1e-4


def files_of(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def bundle(path: Path, files: dict[str, bytes], kind: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", kind) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def webp(pixels: np.ndarray, kind: str = "WEBP") -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, kind, **({"lossless": True, "exact": True} if kind == "WEBP" else {}))
    return stream.getvalue()


def test_deflated_archives_and_png_are_read(tmp_path):
    write_still(tmp_path / "a.sog", cloud(300))
    files = files_of(tmp_path / "a.sog")
    meta = json.loads(files[META])
    with Image.open(io.BytesIO(files.pop("quats.webp"))) as image:
        files["quats.png"] = webp(np.asarray(image.convert("RGBA")), "PNG")
    meta["quats"]["files"] = ["quats.png"]
    bundle(tmp_path / "b.sog", files | {META: json.dumps(meta).encode()}, zipfile.ZIP_DEFLATED)
    for a, b in zip(*(read_gaussians(tmp_path / name).parameters() for name in ("a.sog", "b.sog"))):
        assert torch.equal(a, b)


def test_version_1_has_ranges_in_place_of_codebooks(tmp_path):
    """Written by hand, as nobody writes it any more: 2 Gaussians of degree 1."""
    texel = np.zeros((1, 2, 4), np.uint8)
    texel[..., 3] = 255
    low, high, scales, color, labels = (texel.copy() for _ in range(5))
    high[0, 1, [0, 2]] = low[0, 1, [0, 2]] = 255
    scales[0, 1, :3] = color[0, 1] = 255
    color[0, 0, 3] = 0
    labels[0, 1, 0] = 1
    turns = np.array([[[128, 128, 128, 252], [255, 128, 128, 253]]], np.uint8)
    palette = np.zeros((1, 64 * 3, 4), np.uint8)
    palette[0, 3:6, 1] = 255  # the second row: green
    names = {"means": ["l", "u"], "scales": ["s"], "quats": ["q"], "sh0": ["c"], "shN": ["p", "n"]}
    images = {"l": low, "u": high, "s": scales, "q": turns, "c": color, "p": palette, "n": labels}
    meta: dict[str, Any] = {
        "means": {"shape": [2, 3], "mins": [-1, 0, 0], "maxs": [1, 0, 2]},
        "scales": {"mins": [-5, -4, -3], "maxs": [-1, -1, -1]},
        "quats": {},
        "sh0": {"mins": [0, 0, 0, -2], "maxs": [1, 2, 3, 4]},
        "shN": {"mins": -0.5, "maxs": 0.5},
    }
    for name, files in names.items():
        meta[name]["files"] = files
    bundle(tmp_path / "a.sog", {META: json.dumps(meta).encode(), **{name: webp(p) for name, p in images.items()}})
    found = {name: value.detach().numpy() for name, value in read_gaussians(tmp_path / "a.sog").named_parameters()}
    e = np.e
    np.testing.assert_allclose(found["means"], [[1 - e, 0, 0], [e - 1, 0, e * e - 1]], atol=1e-5)
    np.testing.assert_allclose(found["log_scales"], [[-5, -4, -3], [-1, -1, -1]], atol=1e-6)
    np.testing.assert_allclose(found["sh_dc"], [[0, 0, 0], [1, 2, 3]], atol=1e-6)
    np.testing.assert_allclose(found["opacity_logits"], [-2, 4], atol=1e-6)
    half = 0.5**0.5
    np.testing.assert_allclose(np.abs(found["quats"]), [[1, 0, 0, 0], [half, half, 0, 0]], atol=6e-3)
    assert found["sh_rest"].shape == (2, 3, 3)
    np.testing.assert_allclose(found["sh_rest"][1], np.tile([-0.5, 0.5, -0.5], (3, 1)), atol=1e-6)
    np.testing.assert_allclose(found["sh_rest"][0], -0.5, atol=1e-6)


def test_the_first_number_of_a_codebook_may_be_missing(tmp_path):
    write_still(tmp_path / "a.sog", cloud(300))
    files = files_of(tmp_path / "a.sog")
    meta = json.loads(files[META])
    expected = meta["scales"]["codebook"][0]
    meta["scales"]["codebook"][0] = None
    bundle(tmp_path / "b.sog", files | {META: json.dumps(meta).encode()})
    a, b = (read_gaussians(tmp_path / name).log_scales.detach() for name in ("a.sog", "b.sog"))
    assert torch.equal(a[a > expected + 1e-6], b[a > expected + 1e-6]) and float((a - b).abs().max()) < 0.2


@pytest.mark.parametrize("name", ["a.sog", "folder/meta.json"])
@pytest.mark.parametrize("antialiased", [False, True])
def test_the_mark_of_antialiasing_is_kept(tmp_path, name, antialiased):
    write_still(tmp_path / name, cloud(), antialiased=antialiased)
    assert read_antialiased(tmp_path / name) == antialiased
    (tmp_path / name).write_bytes(b"damaged")
    assert not read_antialiased(tmp_path / name)


Change = Callable[[dict[str, Any], dict[str, bytes]], object]


def small(meta: dict[str, Any], files: dict[str, bytes]) -> None:
    files["quats.webp"] = webp(np.zeros((4, 4, 4), np.uint8))


CASES: dict[str, tuple[Change, str]] = {
    "count": (lambda meta, _: meta.update(count=10**7), "4 x|20 x 16 pixels; it needs 10,000,000"),
    "too many": (lambda meta, _: meta.update(count=10**9), "count is 1000000000"),
    "no count": (lambda meta, _: meta.pop("count"), "count is None"),
    "flag": (lambda meta, _: meta.update(count=True), "count is True"),
    "version": (lambda meta, _: meta.update(version=3), "version 3 of SOG"),
    "section": (lambda meta, _: meta.pop("quats"), "quats is missing"),
    "range": (lambda meta, _: meta["means"].update(mins=[0, 1]), "means.mins is not 3 finite"),
    "codebook": (lambda meta, _: meta["scales"].update(codebook=["a"]), "scales.codebook"),
    "long": (lambda meta, _: meta["sh0"].update(codebook=[0.0] * 257), "sh0.codebook"),
    "name": (lambda meta, _: meta["sh0"].update(files=[3]), "names no image number 1"),
    "missing": (lambda _, files: files.pop("sh0.webp"), "holds no 'sh0.webp'|sh0.webp: no such file"),
    "image": (lambda _, files: files.update({"sh0.webp": b"RIFF"}), "no sound WebP or PNG"),
    "small": (small, "4 x 4 pixels"),
    "palette": (lambda _, files: files.update({"shN_centroids.webp": files["sh0.webp"]}), "shN has"),
    "rows": (lambda meta, _: meta["shN"].update(count=10**6), "shN has 1000000 rows"),
    "path": (lambda meta, _: meta["sh0"].update(files=["../sh0.webp"]), "holds no|leads out of"),
    "root": (lambda meta, _: meta["sh0"].update(files=["/etc/passwd"]), "holds no|leads out of"),
}


@pytest.mark.parametrize("bundled", [True, False])
@pytest.mark.parametrize("case", CASES)
def test_damage_is_one_line(tmp_path, case, bundled):
    change, words = CASES[case]
    write_still(tmp_path / "a.sog", cloud(300))
    files = files_of(tmp_path / "a.sog")
    meta = json.loads(files[META])
    change(meta, files)
    files[META] = json.dumps(meta).encode()
    if bundled:
        path = bundle(tmp_path / "b.sog", files)
    else:
        path = tmp_path / "folder" / META
        path.parent.mkdir()
        for name, content in files.items():
            (path.parent / name).write_bytes(content)
    with pytest.raises(UserError, match=words) as caught:
        read_gaussians(path)
    assert str(path.parent) in str(caught.value) and "\n" not in str(caught.value)


def test_other_files_are_one_line(tmp_path):
    cases = {
        "text.sog": (b"hello", "no zip archive"),
        "empty.sog": (b"", "no zip archive"),
        "other.sog": (bundle(tmp_path / "x.zip", {"a.txt": b"a"}).read_bytes(), "holds no 'meta.json'"),
        "json.sog": (bundle(tmp_path / "x.zip", {META: b"{"}).read_bytes(), "not valid JSON"),
        "list.sog": (bundle(tmp_path / "x.zip", {META: b"[]"}).read_bytes(), "holds no JSON object"),
    }
    write_still(tmp_path / "good.sog", cloud(300))
    good = (tmp_path / "good.sog").read_bytes()
    place = good.index(b"RIFF") + 200
    cases["bit.sog"] = (good[:place] + bytes([good[place] ^ 4]) + good[place + 1 :], "is damaged")
    cases["cut.sog"] = (good[:-100], "no zip archive")
    for name, (content, words) in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError, match=words) as caught:
            read_gaussians(tmp_path / name)
        assert name in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(UserError, match="no such file"):
        read_gaussians(tmp_path / "missing.sog")
    with pytest.raises(UserError, match="no such file"):
        read_gaussians(tmp_path / "missing" / META)


def test_bombs_are_refused_before_they_are_unpacked(tmp_path, monkeypatch):
    """A small archive of a large member, and a small image of many pixels."""
    write_still(tmp_path / "a.sog", cloud(300))
    files = files_of(tmp_path / "a.sog")
    big = dict(files) | {"sh0.webp": bytes(sog_files.MAX_IMAGE + 1)}
    bundle(tmp_path / "member.sog", big, zipfile.ZIP_DEFLATED)
    assert (tmp_path / "member.sog").stat().st_size < 1 << 20
    with pytest.raises(UserError, match="larger than"):
        read_gaussians(tmp_path / "member.sog")
    side = int(MAX_PIXELS**0.5) + 1
    wide = webp(np.zeros((side, side, 4), np.uint8))
    assert len(wide) < 1 << 20
    bundle(tmp_path / "image.sog", files | {"sh0.webp": wide})
    loaded: list[object] = []
    plain = Image.Image.convert
    monkeypatch.setattr(Image.Image, "convert", lambda self, mode: loaded.append(self.size) or plain(self, mode))
    with pytest.raises(UserError, match=f"{side} x {side} pixels"):
        read_gaussians(tmp_path / "image.sog")
    assert (side, side) not in loaded


def test_folders_of_others_are_not_replaced(tmp_path, monkeypatch):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "notes.txt").write_text("keep me")
    with pytest.raises(UserError, match="holds other files"):
        write_still(folder / META, cloud(10))
    assert [p.name for p in folder.iterdir()] == ["notes.txt"]
    monkeypatch.chdir(folder)
    with pytest.raises(UserError, match="is the current folder"):
        write_still(Path(META), cloud(10))
    write_still(tmp_path / "new" / META, cloud(10))
    write_still(tmp_path / "new" / META, cloud(20, 0))  # what is there is replaced as a whole
    assert len(read_gaussians(tmp_path / "new")) == 20 and len(list((tmp_path / "new").iterdir())) == 6
