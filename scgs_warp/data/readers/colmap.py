"""Reader of COLMAP's layout: a sparse model in ``sparse/0``, ``sparse`` or ``colmap/sparse/0``, and ``images/``."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePosixPath

from ...errors import UserError
from ...storage.safe_paths import inside
from ..assemble import FrameRecord, assemble, video_border, with_points
from ..choice import choose
from ..dataset import Dataset
from ..far_origin import moved, note, offset_of
from ..held_out import held_out
from ..images import ReadOptions, header_sizes, size_text
from ..lens import Lens, make_lens
from ..name_times import times_from_names
from ..natural_order import natural
from .colmap_model import ModelCamera, ModelImage, find_model, read_model
from .transforms import in_any_case

MADE_FROM = "give the images that the model was made from, with their names"
"""What to do about missing images."""


def recognises(folder: Path) -> bool:
    """Return whether the folder holds this layout."""
    return find_model(folder) is not None


def read(folder: Path, split: str, options: ReadOptions) -> Dataset:
    """Read one split: every eighth image, in the order of names, is held out for ``test`` and ``val`` alike.

    A model has no times; they are those in the images' names (:func:`moments_in_names`). Images that COLMAP did not
    register then leave a gap, and cameras with equally numbered files share times. If the names tell none, the images
    are evenly spaced in their order.

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
    times = times_from_names([image.name for image in images])
    choice = choose(model_folder, files, times, options, _cameras(images), MADE_FROM)
    _check_sizes([files[index] for index in choice.indices], [lenses[index] for index in choice.indices])
    chosen = held_out(model_folder, choice.indices, split)
    offset = offset_of([image.viewmat for image in images])
    records = [
        FrameRecord(
            files[index],
            images[index].viewmat if offset is None else moved(images[index].viewmat, offset),
            choice.times[index],
            lenses[index],
            PurePosixPath(images[index].name).with_suffix("").as_posix().replace("/", "_"),
        )
        for index in chosen
    ]
    border = video_border([files[index] for index in choice.indices], [times[index] for index in choice.indices])
    notes = [*choice.notes, *([] if offset is None else [note(offset)])]
    data = assemble(records, options, folder=folder, split=split, border=border, notes=notes)
    points = model.points if offset is None else model.points - offset
    return with_points(data, points, model.colors) if len(points) else data


def _image_folder(folder: Path, model_folder: Path) -> Path:
    tried = [folder / "images", model_folder / "images", folder / "input", folder]
    return next((base for base in tried[:-1] if base.is_dir()), tried[-1])


def _file(base: Path, image: ModelImage, model_folder: Path) -> Path:
    file = inside(base, image.name, f"{model_folder}: the name of an image", "image")
    return in_any_case(file) or file


def _cameras(images: list[ModelImage]) -> list[str]:
    """Name the camera of each image: the folder in the image's name or, if no name has one, COLMAP's number."""
    folders = [PurePosixPath(image.name).parent.as_posix() for image in images]
    return folders if any(folder != "." for folder in folders) else [str(image.camera) for image in images]


def _check_sizes(files: list[Path], lenses: list[Callable[[tuple[int, int]], Lens]]) -> None:
    """Check the presence and the sizes of the files of all splits before any is decoded, so that a model of other
    images is refused at once."""
    for file, lens in zip(files, lenses):
        sizes = header_sizes(file)
        if sizes and not any(_fits(lens, size) for size in sizes):
            lens(sizes[0])  # raises


def _fits(lens: Callable[[tuple[int, int]], Lens], size: tuple[int, int]) -> bool:
    try:
        lens(size)
    except UserError:
        return False
    return True


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
