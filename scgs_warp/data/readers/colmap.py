"""Reader of COLMAP's layout: a sparse model in ``sparse/0``, ``sparse`` or ``colmap/sparse/0``, and ``images/``."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePosixPath

from ...errors import UserError
from ...storage.safe_paths import inside
from ..assemble import Shot, assemble, video_border, with_points
from ..dataset import Dataset
from ..held_out import held_out
from ..images import Look, header_size, size_text
from ..lens import Lens, make_lens
from ..natural_order import natural
from .colmap_model import ModelCamera, ModelImage, find, read_model


def recognises(folder: Path) -> bool:
    """Whether the folder holds this layout."""
    return find(folder) is not None


def read(folder: Path, split: str, look: Look) -> Dataset:
    """Read one split: every eighth image, in the order of names, is held out for ``test`` and ``val`` alike.

    A model says nothing of time. Where every name has a number, those of the last folder or file name are the times
    (so that images that COLMAP did not register leave a gap, and cameras whose files are numbered alike share theirs);
    else the images follow each other evenly in the order of their names.

    Raises:
        UserError: one line naming the file, the field and the remedy, for anything in the data that cannot be used.
    """
    place = find(folder)
    assert place is not None, "recognises(folder)"
    model = read_model(place)
    images = sorted(model.images, key=lambda image: natural(image.name))
    base = _image_folder(folder, place)
    files = [_file(base, image, place) for image in images]
    lenses = [partial(_lens, place, image, model.cameras[image.camera]) for image in images]
    _check_sizes(files, lenses)
    times = _times([image.name for image in images])
    chosen = held_out(place, range(len(images)), split)
    shots = [
        Shot(
            files[index],
            images[index].viewmat,
            times[index],
            lenses[index],
            PurePosixPath(images[index].name).with_suffix("").as_posix().replace("/", "_"),
        )
        for index in chosen
    ]
    data = assemble(shots, look, folder=folder, split=split, border=video_border(files, times))
    return with_points(data, model.points, model.colors) if len(model.points) else data


def _image_folder(folder: Path, place: Path) -> Path:
    tried = [folder / "images", place / "images", folder / "input", folder]
    return next((base for base in tried[:-1] if base.is_dir()), tried[-1])


def _file(base: Path, image: ModelImage, place: Path) -> Path:
    return inside(base, image.name, f"{place}: the name of an image", "image")


def _check_sizes(files: list[Path], lenses: list[Callable[[tuple[int, int]], Lens]]) -> None:
    """All files, whichever split is read, and before any is decoded: a model of other images is refused at once."""
    for file, lens in zip(files, lenses):
        size = header_size(file)
        if size is not None:
            lens(size)
    missing = [file for file in files if not file.is_file()]
    if missing:
        raise UserError(
            f"{missing[0]}: no such image, though the model has it ({len(missing)} of {len(files)} are missing); give "
            "the images that the model was made from, under their names"
        )


def _times(names: list[str]) -> list[float]:
    """[0, 1], from the numbers in the names where all have one and they differ; else by order."""
    found = [re.findall(r"[0-9]{1,15}", PurePosixPath(name).stem) for name in names]
    if all(found):
        numbers = [int(digits[-1]) for digits in found]
        first, last = min(numbers), max(numbers)
        if last > first:
            return [(number - first) / (last - first) for number in numbers]
    return [index / max(len(names) - 1, 1) for index in range(len(names))]


def _lens(place: Path, image: ModelImage, camera: ModelCamera, source: tuple[int, int]) -> Lens:
    if (camera.width, camera.height) != source:
        raise UserError(
            f"{place}: camera {image.camera}, of {image.name}, is of {camera.width} x {camera.height} pixels, but the "
            f"image is {size_text(source)}; give the images that the model was made from, or a model of these images"
        )
    try:
        return make_lens(camera.model, camera.params)
    except ValueError as error:
        raise UserError(f"{place}: camera {image.camera}, of {image.name}: {error}; undistort the images") from None
