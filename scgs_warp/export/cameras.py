"""Cameras of a data set as nerfstudio's ``transforms.json``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..data.dataset import Dataset
from ..evaluation.evaluate import distinct_names
from ..geometry.rotation import OPENGL_TO_OPENCV
from ..storage.files import write_atomically
from ..types import Camera


def write_cameras(path: Path, splits: Mapping[str, Dataset]) -> int:
    """Write poses (camera-to-world, OpenGL), intrinsics in pixels and times in [0, 1]. Images are not copied;
    ``file_path`` is ``SPLIT/NAME.png``, where names that repeat, as in the folders of a rig, get the frame's number.

    Args:
        splits: data sets by the names of their splits, with cameras as used in training: world units, after downscaling
            and without lens distortion.

    Returns:
        Number of cameras.

    Raises:
        UserError: the file cannot be written.
    """
    entries, lists = [], {}
    for split, data in splits.items():
        names = [f"{split}/{name}.png" for name in distinct_names([entry.name for entry in data.entries])]
        lists[f"{split}_filenames"] = names
        for name, entry in zip(names, data.entries):
            entries.append({"file_path": name, **_fields(entry.camera), "time": entry.time})
    content = {"camera_model": "PINHOLE", "frames": entries, **lists}
    shared = ("w", "h", "fl_x", "fl_y", "cx", "cy")
    if entries and all(all(entry[key] == entries[0][key] for key in shared) for entry in entries):
        first = {key: entries[0][key] for key in shared}
        content = {"camera_model": "PINHOLE", **first, **content}
        for entry in entries:
            for key in shared:
                del entry[key]
    write_atomically(path, (json.dumps(content, indent=1) + "\n").encode())
    return len(entries)


def _fields(camera: Camera) -> dict[str, Any]:
    K = camera.K.double().cpu().numpy()
    pose = np.linalg.inv(camera.viewmat.double().cpu().numpy()) @ OPENGL_TO_OPENCV
    return {
        "w": camera.width, "h": camera.height, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2],
        "transform_matrix": pose.tolist(),
    }  # fmt: skip
