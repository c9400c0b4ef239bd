"""Reader of COLMAP's layout: a sparse model in ``sparse/0``, ``sparse`` or ``colmap/sparse/0``, and ``images/``.

Images may be smaller than the model's cameras state: in a folder of reduced images (``images_2``, ``images_4``), or all
of them. The cameras are then scaled to them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePosixPath

from ...errors import UserError, shell_words
from ..assemble import FrameRecord, assemble, video_border, with_points
from ..choice import choose
from ..dataset import Dataset
from ..far_origin import moved, note, offset_of
from ..held_out import held_out
from ..images import ReadOptions, header_sizes, is_reduced, size_text
from ..lens import Lens, make_lens, rescaled
from ..name_times import times_from_names
from ..natural_order import natural
from .colmap_images import ImageFiles, find_images
from .colmap_model import ModelCamera, ModelImage, find_model, read_model
from .rig_model import is_instant

MADE_FROM = "give the images that the model was made from, with their names"
"""What to do about missing images."""


def recognises(folder: Path) -> bool:
    """Return whether the folder holds this layout."""
    return find_model(folder) is not None


def read(folder: Path, split: str, options: ReadOptions) -> Dataset:
    """Read one split: every eighth image, in the order of names, is held out for ``test`` and ``val`` alike.

    A model has no times; they are those in the images' names (:func:`moments_in_names`). Images that COLMAP did not
    register then leave a gap, and cameras with equally numbered files share times. If the names tell none, the images
    are evenly spaced in their order. The images of one instant of a rig (``rig_model``) have time 0.

    Raises:
        UserError: the data is invalid; one line names the file, the field and the remedy.
    """
    model_folder = find_model(folder)
    assert model_folder is not None, "recognises(folder)"
    model = read_model(model_folder)
    images = sorted(model.images, key=lambda image: natural(image.name))
    found = find_images(folder, model_folder, [image.name for image in images])
    files = found.files
    lenses = [partial(_lens, model_folder, image, model.cameras[image.camera]) for image in images]
    instant = is_instant(folder)
    times = [0.0] * len(images) if instant else times_from_names([image.name for image in images])
    choice = choose(model_folder, files, times, options, _cameras(images), MADE_FROM)
    sizes = _check_sizes([files[index] for index in choice.indices], [lenses[index] for index in choice.indices])
    stated = [model.cameras[images[index].camera] for index in choice.indices]
    ratio, smaller = _reduction(found, sizes, [(camera.width, camera.height) for camera in stated])
    options = options._replace(downscale=max(1.0, options.downscale / ratio))
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
    notes = [*choice.notes, *found.notes, *smaller, *([] if offset is None else [note(offset)])]
    if instant:
        notes.append(f"{folder}: holds one instant of a rig; give --data {shell_words(folder.parent)} for all instants")
    data = assemble(records, options, folder=folder, split=split, border=border, notes=notes)
    points = model.points if offset is None else model.points - offset
    return with_points(data, points, model.colors) if len(points) else data


def _cameras(images: list[ModelImage]) -> list[str]:
    """Name the camera of each image: the folder in the image's name or, if no name has one, COLMAP's number."""
    folders = [PurePosixPath(image.name).parent.as_posix() for image in images]
    return folders if any(folder != "." for folder in folders) else [str(image.camera) for image in images]


def _check_sizes(files: list[Path], lenses: list[Callable[[tuple[int, int]], Lens]]) -> list[tuple[int, int] | None]:
    """Check the presence and the sizes of the files of all splits before any is decoded, so that a model of other
    images is refused at once. Return the size of each image as its camera sees it, None where it is unreadable."""
    found: list[tuple[int, int] | None] = []
    for file, lens in zip(files, lenses):
        sizes = header_sizes(file)
        found.append(next((size for size in sizes if _fits(lens, size)), None))
        if sizes and found[-1] is None:
            lens(sizes[0])  # raises
    return found


def _fits(lens: Callable[[tuple[int, int]], Lens], size: tuple[int, int]) -> bool:
    try:
        lens(size)
    except UserError:
        return False
    return True


def _reduction(
    found: ImageFiles, sizes: list[tuple[int, int] | None], stated: list[tuple[int, int]]
) -> tuple[int, list[str]]:
    """Return how many times smaller than the model's cameras the images of a reduced folder are (1 for those of another
    folder, which are all that there is), and a note if images are smaller."""
    smaller = [(size, full) for size, full in zip(sizes, stated) if size is not None and size != full]
    if not smaller:
        return 1, []
    size, full = smaller[0]
    line = (
        f"{found.folder}: images are {size_text(size)}, the model's cameras {size_text(full)}; "
        "the cameras are scaled to the images"
    )
    return (max(1, round(full[0] / size[0])) if found.reduced else 1), [line]


def _lens(model_folder: Path, image: ModelImage, camera: ModelCamera, source: tuple[int, int]) -> Lens:
    """Return the lens at the size of the image, which is that of its camera or a reduced one.

    Images that are only a little smaller are others, undistorted or cropped, even in the same proportions.
    """
    full = camera.width, camera.height
    if full != source and not is_reduced(source, full):
        raise UserError(
            f"{model_folder}: camera {image.camera}, of {image.name}, is of {camera.width} x {camera.height} pixels, "
            f"but the image is {size_text(source)}; give the images that the model was made from, or a model of these "
            "images"
        )
    try:
        lens = make_lens(camera.model, camera.params)
        return lens if full == source else rescaled(lens, full, source)
    except ValueError as error:
        raise UserError(
            f"{model_folder}: camera {image.camera}, of {image.name}: {error}; undistort the images"
        ) from None
