"""Reader of the D-NeRF / Blender layout: ``transforms_{train,val,test}.json`` beside folders of images.

``camera_angle_x`` (horizontal field of view, radians) or ``fl_x, fl_y, cx, cy, w, h`` (pixels); per frame
``file_path``, ``transform_matrix`` (camera-to-world, OpenGL: x right, y up, z backward) and ``time`` in [0, 1].
Layout: Pumarola et al., D-NeRF, CVPR 2021, and NeRF's Blender scenes.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..errors import UserError
from ..types import Frame
from .dataset import Dataset
from .images import Decoded, parallel_map, read_image, without_idle_alpha
from .transforms import (
    check_distortion,
    find_image,
    make_camera,
    read_intrinsics,
    read_pose,
    read_times,
    read_transforms,
    size_text,
)


def transforms_path(folder: Path, split: str) -> Path:
    return folder / f"transforms_{split}.json"


def recognises(folder: Path) -> bool:
    """Whether the folder holds this layout."""
    return any(transforms_path(folder, split).is_file() for split in ("train", "test", "val"))


def read(
    folder: Path,
    split: str,
    *,
    downscale: float = 1,
    resample: str = "area",
    background: str = "black",
    progress: Callable[[int, int], None] | None = None,
) -> Dataset:
    """Read one split.

    Args:
        progress: called with (done, total) after each decoded image.

    Raises:
        UserError: one line naming the file, the field and the remedy, for anything in the data that cannot be used.
    """
    path = transforms_path(folder, split)
    content = read_transforms(path)
    entries = content["frames"]
    poses = [read_pose(path, index, entry) for index, entry in enumerate(entries)]
    times = read_times(path, entries)
    files = [find_image(path, folder, index, entry) for index, entry in enumerate(entries)]
    for described in (content, *entries):
        check_distortion(path, described)

    def decode(file: Path) -> Decoded:
        return read_image(file, downscale, resample, background)

    images = without_idle_alpha(parallel_map(decode, files, progress))
    source = images[0].source_size
    for file, image in zip(files, images):
        if image.source_size != source:
            raise UserError(
                f"{file}: is {size_text(image.source_size)}, but {files[0].name} is {size_text(source)}; "
                "give all images of a split one size"
            )
    frames = []
    for index, (entry, viewmat, time, file, image) in enumerate(zip(entries, poses, times, files, images)):
        intrinsics = read_intrinsics(path, {**content, **entry}, index, source)
        camera = make_camera(viewmat, intrinsics, source, image.image)
        frames.append(Frame(camera, time, image.image, image.alpha, name=file.stem))
    return Dataset(frames, folder=folder, split=split, background=background)
