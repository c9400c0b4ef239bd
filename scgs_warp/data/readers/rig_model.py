"""Reader of rigs whose cameras are a COLMAP model of one instant, as programs for multi-view video lay them out.

4DGaussians (``multipleview``): ``sparse_/``, the model of images ``image1.jpg``, ``image2.jpg``, ... of the first
instant, ``cam01/frame_00001.jpg``, ``points3D_multipleview.ply``. SpacetimeGaussians: a folder for each instant,
``colmap_0/images/cam00.png`` with ``colmap_0/sparse/0``. 3DGStream: ``frame000000/images/...`` with
``frame000000/sparse/0``. All cameras stand; the model of the first instant counts.
Layouts: Wu et al., 4D Gaussian Splatting, CVPR 2024; Li et al., Spacetime Gaussian Feature Splatting, CVPR 2024; Sun et
al., 3DGStream, CVPR 2024.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path, PurePosixPath

from ...errors import UserError
from ..assemble import with_points
from ..dataset import Dataset
from ..images import ReadOptions
from ..lens import Lens, make_lens
from ..natural_order import natural
from ..points import read_points
from .colmap_model import ModelCamera, ModelImage, find_model, read_model
from .rig import RigCamera, fitted_lens, images_in, read_rig

MODEL, POINTS = "sparse_", "points3D_multipleview.ply"
"""Names of 4DGaussians."""
INSTANT = re.compile(r"(?:colmap_|frame_?)[0-9]{1,9}")
"""Name of the folder of an instant."""


def recognises(folder: Path) -> bool:
    """Return whether the folder holds one of these layouts, and neither a model of its own nor the images of each
    camera beside ``poses_bounds.npy``, from which SpacetimeGaussians makes its folders."""
    if (folder / MODEL).is_dir() and find_model(folder / MODEL) is not None:
        return True
    if find_model(folder) is not None or not instants_in(folder):
        return False
    return not ((folder / "poses_bounds.npy").is_file() and any(images_in(path) for path in folder.glob("cam*")))


def instants_in(folder: Path) -> list[Path]:
    """Return the folders of instants in their order; none unless there are two, the first of which has a model."""
    found = [path for path in folder.iterdir() if INSTANT.fullmatch(path.name) and (path / "images").is_dir()]
    found.sort(key=lambda path: natural(path.name))
    return found if len(found) > 1 and find_model(found[0]) is not None else []


def is_instant(folder: Path) -> bool:
    """Return whether the folder is that of one of several instants of a rig."""
    whole = folder.resolve()
    return INSTANT.fullmatch(whole.name) is not None and whole in instants_in(whole.parent)


def read(folder: Path, split: str, options: ReadOptions) -> Dataset:
    """Read one split: the first camera in the order of names is held out for ``test`` and ``val`` alike.

    Times are those in the names of images or, of a folder for each instant, in the names of these folders.

    Raises:
        UserError: the data is invalid; one line names the file, the field and the remedy.
    """
    instants = [] if (folder / MODEL).is_dir() else instants_in(folder)
    place = find_model(instants[0] if instants else folder / MODEL)
    assert place is not None, "recognises(folder)"
    model = read_model(place)
    shown = {instant.name: images_in(instant / "images") for instant in instants}
    cameras = []
    for image in model.images:
        stem = PurePosixPath(image.name).stem
        name, files = stem, {instant: files[stem] for instant, files in shown.items() if stem in files}
        if not instants:
            name, files = _of_number(folder, place, stem)
        lens = partial(_lens, place, image, model.cameras[image.camera])
        cameras.append(RigCamera(name, image.viewmat, lens, files))
    data = read_rig(place, folder, cameras, split, options)
    if (folder / POINTS).is_file() and not instants:
        return with_points(data, *read_points(folder / POINTS))
    return with_points(data, model.points, model.colors) if len(model.points) else data


def _of_number(folder: Path, place: Path, stem: str) -> tuple[str, dict[str, Path]]:
    """Return the name of the folder of a camera of 4DGaussians, and its images: ``cam01`` of ``image1``."""
    match = re.fullmatch(r"image([0-9]{1,9})", stem)
    if match is None:
        raise UserError(f"{place}: names an image {stem[:60]!r}; 4DGaussians names the image of cam01 image1.jpg")
    name = next((path.name for path in sorted(folder.glob("cam*")) if path.name[3:].lstrip("0") == match[1]), None)
    return (f"cam{match[1]:0>2}", {}) if name is None else (name, images_in(folder / name))


def _lens(place: Path, image: ModelImage, camera: ModelCamera, source: tuple[int, int]) -> Lens:
    where = f"{place}: camera {image.camera}, of {image.name},"
    try:
        return fitted_lens(where, make_lens(camera.model, camera.params), (camera.width, camera.height), source)
    except ValueError as error:
        raise UserError(f"{where} {error}; undistort the images") from None
