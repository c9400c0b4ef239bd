"""COLMAP's models as files: complete, or not there."""

from __future__ import annotations

import pytest

from helpers.full_disk import small_disk
from helpers.textured_corner import model_of, stills, true_cameras
from scgs_warp.capture.colmap import read_model, write_model
from scgs_warp.capture.rig import adjustment
from scgs_warp.errors import UserError

CAMERAS = true_cameras()
NAMES = [f"cam{number}é.png" for number in CAMERAS]


@pytest.fixture(scope="module")
def model():
    return model_of(CAMERAS, NAMES)


def test_a_model_comes_back(tmp_path, model):
    write_model(model, tmp_path / "model")
    write_model(model, tmp_path / "model")
    again = read_model(tmp_path / "model")
    assert again.num_points3D() == model.num_points3D() and again.num_reg_images() == len(CAMERAS)
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


def test_a_model_whose_end_is_missing_is_named(tmp_path, model):
    whole = tmp_path / "out/work/model"
    whole.parent.mkdir(parents=True)
    write_model(model, whole)
    for file in whole.iterdir():
        content = file.read_bytes()
        for length in (*range(0, len(content), 97), 4, len(content) - 1):
            file.write_bytes(content[:length])
            with pytest.raises(UserError, match=r"model: is damaged; remove .*out, and capture again"):
                read_model(whole)
        file.write_bytes(content)
        file.unlink()
        with pytest.raises(UserError, match="model: is damaged"):
            read_model(whole)
        file.write_bytes(content)
    read_model(whole)


def test_a_full_disk_leaves_no_half_of_a_model(tmp_path, model):
    with small_disk(tmp_path / "disk", 1) as disk:
        folder = tmp_path / "disk/model"
        disk.fill()
        with pytest.raises(UserError, match=r"model: cannot be written \(No space left on device\); make room"):
            write_model(model, folder)
        assert not folder.exists()
        disk.free()
        (tmp_path / "disk/ballast").write_bytes(bytes((1 << 20) - (5 << 12)))  # room for a part of it
        with pytest.raises(UserError, match=r"model: cannot be written \(No space left on device\); make room"):
            write_model(model, folder)
        assert [path.name for path in (tmp_path / "disk").iterdir()] == ["ballast"]
        disk.free()
        write_model(model, folder)
        disk.fill()
        with pytest.raises(UserError, match="cannot be written"):
            write_model(model, folder)
        assert read_model(folder).num_points3D() == model.num_points3D(), "the earlier one stays"


def test_an_adjusted_model_is_not_half_written_either(tmp_path, monkeypatch):
    pictures = stills(tmp_path, CAMERAS)
    write_model(model_of(CAMERAS, pictures.names), tmp_path / "model")
    monkeypatch.setattr(adjustment, "adjusted", lambda model, *_: model)
    with small_disk(tmp_path / "disk", 1) as disk:
        disk.fill()
        with pytest.raises(UserError, match="adjusted: cannot be written"):
            adjustment.adjust(tmp_path / "model", pictures, tmp_path / "disk/adjusted")
        disk.free()
        assert adjustment.adjust(tmp_path / "model", pictures, tmp_path / "disk/adjusted") is False
