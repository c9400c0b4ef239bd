"""The editor's latency as a benchmark row: complete, of the code that the editor runs, mistakes in one line."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from helpers.bench_rows import TINY, check_rows, rows_of
from helpers.edit_scenes import bar_scene
from scgs_warp.apps import bench as app
from scgs_warp.benchmark import editing
from scgs_warp.edit import EditSession
from scgs_warp.editor.frame_image import Picture
from scgs_warp.editor.model import EditorModel

pytestmark = pytest.mark.usefixtures("all_threads")


def test_a_drag_in_the_editor(tmp_path, device, capsys):
    rows = rows_of(tmp_path, "edit", *TINY, "--device", device)
    check_rows(rows, device)
    stages = [row["name"].removeprefix("edit/drag/") for row in rows[1:]]
    drawn = ["project", "harmonics", "bin", "composite"]
    assert stages == ["solve", "skin", *drawn, "bytes", "encode", "rest"], "every stage is in use"
    assert "edit/drag" in capsys.readouterr().out


def test_three_handles_are_held_and_one_is_in_hand():
    model = EditorModel(EditSession(bar_scene()))
    editing.hold(model)
    assert len(model.session.edit.handles) == editing.HANDLES == 3
    assert model.dragging and model.active == model.session.edit.handles[-1].name


def test_what_cannot_be_dragged_is_said(tmp_path, capsys):
    assert app.cli(["edit", *TINY, "--motion", "hexplane"]) == 2
    assert "no control points" in capsys.readouterr().err


def test_what_is_sent_is_what_was_drawn():
    depth = np.array([[1.5, np.inf], [0.25, 3.0]], np.float32)
    sizes = {editing.encode(Picture(np.full((2, 2, 3), shade, np.uint8), depth)) for shade in (0, 255)}
    assert min(sizes) > 100
    bright = Picture(
        np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8), np.full((64, 64), 2.0, np.float32)
    )
    assert editing.encode(bright) > len(cv2.imencode(".jpg", bright.rgb, [cv2.IMWRITE_JPEG_QUALITY, 60])[1])
