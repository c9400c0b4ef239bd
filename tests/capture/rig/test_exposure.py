"""Cameras of a rig that are darker than the others are named."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from helpers.films import pan
from scgs_warp.capture.features import FrameFiles
from scgs_warp.capture.rig import exposure
from scgs_warp.storage.png_files import write_png

PLACES = np.random.default_rng(0).uniform(10, [150, 110], (80, 2))
"""Pixels of the points, the same in all pictures."""


def described(folder, monkeypatch, factors, sharing=lambda camera, point: True) -> list[str]:
    """Describe pictures of one thing, which differ by factors; each has the points that ``sharing`` gives it."""
    names, images = [], {}
    for camera, factor in enumerate(factors):
        names.append(f"cam{camera}")
        write_png(folder / f"cam{camera}.png", (pan([0])[0] * factor).clip(0, 255).astype(np.uint8))
        points = [
            SimpleNamespace(point3D_id=k, xy=place, has_point3D=lambda: True)
            for k, place in enumerate(PLACES)
            if sharing(camera, k)
        ]
        images[camera] = SimpleNamespace(name=f"cam{camera}.png", has_pose=camera != 9, points2D=points)
    monkeypatch.setattr(exposure, "read_model", lambda _: SimpleNamespace(images=images))
    return exposure.describe_exposures(folder, FrameFiles(folder, [f"{name}.png" for name in names], None), names)


def test_a_dark_camera_is_named(tmp_path, monkeypatch):
    (line,) = described(tmp_path, monkeypatch, [1.0, 0.3, 1.0, 1.0])
    assert "cam1 0.30." in line and "cam0" not in line and "--set optim.frame_colors=2e-3" in line
    assert described(tmp_path, monkeypatch, [1.0, 1.05, 0.97, 1.0]) == []


def test_a_dark_camera_between_others_does_not_make_them_bright(tmp_path, monkeypatch):
    """Its neighbours share most points with it."""

    def sharing(camera: int, point: int) -> bool:
        return point % 3 == camera % 3 or point % 3 == (camera + 1) % 3

    (line,) = described(tmp_path, monkeypatch, [1.0, 1.0, 0.5, 1.0, 1.0], sharing)
    assert "cameras: cam2 0.50." in line


@pytest.mark.parametrize("count", [0, 10])
def test_few_points_tell_nothing(count, tmp_path, monkeypatch):
    assert described(tmp_path, monkeypatch, [1.0, 0.3, 1.0], lambda camera, point: point < count) == []
