"""Exports from which something is missing, and files that macOS puts beside theirs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.films import mask_images
from helpers.foreign_scenes import COUNT, WRITERS, write_monst3r, write_polycam
from helpers.importing import silent
from scgs_warp.capture import import_scene
from scgs_warp.capture.source import Folder


def note_of(source: Path, tmp_path: Path) -> str | None:
    return import_scene(source, tmp_path / "data", silent).note


def test_cameras_without_images_are_counted(tmp_path):
    source = write_polycam(tmp_path / "source")
    for file in sorted((source / "keyframes/corrected_images").iterdir())[:3]:
        file.unlink()
    said = f"3 of {COUNT} cameras have no image in corrected_images, and are left out"
    assert note_of(source, tmp_path) == said


@pytest.mark.parametrize(
    ("spoil", "count"),
    [
        (lambda file: file.unlink(), 2),
        (lambda file: cv2.imwrite(str(file), np.zeros((18, 24), np.uint16)), 2),
        (lambda file: cv2.imwrite(str(file), np.full((18, 18), 3000, np.uint16)), 2),
        (lambda file: cv2.imwrite(str(file), np.full((18, 18), 3000, np.uint16)), COUNT),
    ],
    ids=["missing", "empty", "other proportions", "all of other proportions"],
)
def test_frames_whose_depth_is_not_used_are_counted(tmp_path, spoil, count):
    source = write_polycam(tmp_path / "source")
    for file in sorted((source / "keyframes/depth").iterdir())[:count]:
        spoil(file)
        (source / f"keyframes/confidence/{file.name}").unlink()
    note = note_of(source, tmp_path)
    assert note is not None and note.startswith(f"{count} of {COUNT} frames have no depth map, or one that is empty")


def test_nothing_is_said_of_a_scene_without_depth(tmp_path):
    source = write_monst3r(tmp_path / "source")
    for file in source.glob("*.npy"):
        file.unlink()
    assert note_of(source, tmp_path) is None


@pytest.mark.parametrize("program", ["MonST3R", "Polycam", "Record3D", "3D Scanner App"])
def test_files_that_macos_hides_are_no_frames(tmp_path, program):
    """Disks of other systems get a file ``._NAME`` beside each file."""
    source = WRITERS[program](tmp_path / "source")
    for file in [path for path in source.rglob("*") if path.is_file()]:
        file.with_name(f"._{file.name}").write_bytes(b"\0\5\26\7\0\2\0\0Mac OS X")
    assert import_scene(source, tmp_path / "data", silent).frames == COUNT


def test_images_that_macos_hides_are_no_frames(tmp_path):
    folder = mask_images(tmp_path / "images", 3)
    digest = Folder(folder).digest()
    (folder / "._001.png").write_bytes(b"\0\5\26\7\0\2\0\0Mac OS X")
    assert Folder(folder).count == len(list(Folder(folder).frames(64))) == 3 and Folder(folder).digest() == digest
