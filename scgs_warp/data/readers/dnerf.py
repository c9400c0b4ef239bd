"""Reader of the D-NeRF / Blender layout: ``transforms_{train,val,test}.json`` beside folders of images.

``camera_angle_x`` (horizontal field of view, radians) or ``fl_x, fl_y, cx, cy, w, h`` (pixels); per frame
``file_path``, ``transform_matrix`` (camera-to-world, OpenGL: x right, y up, z backward) and ``time`` in [0, 1].
Layout: Pumarola et al., D-NeRF, CVPR 2021, and NeRF's Blender scenes.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from ..assemble import FrameRecord, assemble
from ..dataset import Dataset
from ..images import ReadOptions
from .transforms import find_image, read_distortion, read_lens, read_pose, read_times, read_transforms


def transforms_path(folder: Path, split: str) -> Path:
    return folder / f"transforms_{split}.json"


def recognises(folder: Path) -> bool:
    """Return whether the folder holds this layout."""
    return any(transforms_path(folder, split).is_file() for split in ("train", "test", "val"))


def read(folder: Path, split: str, options: ReadOptions) -> Dataset:
    """Read one split.

    Raises:
        UserError: the data is invalid; one line names the file, the field and the remedy.
    """
    path = transforms_path(folder, split)
    content = read_transforms(path)
    entries = content["frames"]
    poses = [read_pose(path, index, entry) for index, entry in enumerate(entries)]
    times = read_times(path, entries)
    files = [find_image(path, folder, index, entry) for index, entry in enumerate(entries)]
    records = []
    for index, (entry, viewmat, time, file) in enumerate(zip(entries, poses, times, files)):
        fields = {**content, **entry}
        read_distortion(path, fields)
        records.append(FrameRecord(file, viewmat, time, partial(read_lens, path, fields, index), file.stem))
    return assemble(records, options, folder=folder, split=split, one_size=True)
