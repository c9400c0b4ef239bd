"""Reader of COLMAP's layout: a sparse model in ``sparse/0``, ``sparse`` or ``colmap/sparse/0``, and ``images/``."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePosixPath

from ...errors import UserError
from ...storage.safe_paths import inside
from ..assemble import FrameRecord, assemble, video_border, with_points
from ..dataset import Dataset
from ..held_out import held_out
from ..images import ReadOptions, header_size, size_text
from ..lens import Lens, make_lens
from ..natural_order import natural
from .colmap_model import ModelCamera, ModelImage, find_model, read_model


def recognises(folder: Path) -> bool:
    """Return whether the folder holds this layout."""
    return find_model(folder) is not None


def read(folder: Path, split: str, options: ReadOptions) -> Dataset:
    """Read one split: every eighth image, in the order of names, is held out for ``test`` and ``val`` alike.

    A model has no times. If every file name contains a number, the last number of each name is the image's time. Images
    that COLMAP did not register then leave a gap, and cameras with equally numbered files share times. Otherwise the
    images are evenly spaced in the order of their names.

    Raises:
        UserError: the data is invalid; one line names the file, the field and the remedy.
    """
    model_folder = find_model(folder)
    assert model_folder is not None, "recognises(folder)"
    model = read_model(model_folder)
    images = sorted(model.images, key=lambda image: natural(image.name))
    base = _image_folder(folder, model_folder)
    files = [_file(base, image, model_folder) for image in images]
    lenses = [partial(_lens, model_folder, image, model.cameras[image.camera]) for image in images]
    _check_sizes(files, lenses)
    times = times_from_names([image.name for image in images])
    chosen = held_out(model_folder, range(len(images)), split)
    records = [
        FrameRecord(
            files[index],
            images[index].viewmat,
            times[index],
            lenses[index],
            PurePosixPath(images[index].name).with_suffix("").as_posix().replace("/", "_"),
        )
        for index in chosen
    ]
    data = assemble(records, options, folder=folder, split=split, border=video_border(files, times))
    return with_points(data, model.points, model.colors) if len(model.points) else data


def _image_folder(folder: Path, model_folder: Path) -> Path:
    tried = [folder / "images", model_folder / "images", folder / "input", folder]
    return next((base for base in tried[:-1] if base.is_dir()), tried[-1])


def _file(base: Path, image: ModelImage, model_folder: Path) -> Path:
    return inside(base, image.name, f"{model_folder}: the name of an image", "image")


def _check_sizes(files: list[Path], lenses: list[Callable[[tuple[int, int]], Lens]]) -> None:
    """Check the presence and the sizes of the files of all splits before any is decoded, so that a model of other
    images is refused at once."""
    for file, lens in zip(files, lenses):
        size = header_size(file)
        if size is not None:
            lens(size)
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise UserError(
            f"{missing[0]}: no such image, though the model has it ({len(missing)} of {len(files)} are missing); give "
            "the images that the model was made from, with their names"
        )


def times_from_names(names: list[str]) -> list[float]:
    """Return times in [0, 1]: from the last number in each name if all names have one and the numbers differ, else from
    the order."""
    digit_groups = [re.findall(r"[0-9]{1,15}", PurePosixPath(name).stem) for name in names]
    if all(digit_groups):
        numbers = [int(digits[-1]) for digits in digit_groups]
        first, last = min(numbers), max(numbers)
        if last > first:
            return [(number - first) / (last - first) for number in numbers]
    return [index / max(len(names) - 1, 1) for index in range(len(names))]


def _lens(model_folder: Path, image: ModelImage, camera: ModelCamera, source: tuple[int, int]) -> Lens:
    if (camera.width, camera.height) != source:
        raise UserError(
            f"{model_folder}: camera {image.camera}, of {image.name}, is of {camera.width} x {camera.height} pixels, "
            f"but the image is {size_text(source)}; give the images that the model was made from, or a model of these "
            "images"
        )
    try:
        return make_lens(camera.model, camera.params)
    except ValueError as error:
        raise UserError(
            f"{model_folder}: camera {image.camera}, of {image.name}: {error}; undistort the images"
        ) from None
