"""Masks that the user gives: black on moving pixels, as in COLMAP and nerfstudio.

Most are images of 0 and 255. Programs also write 0 and 1, 16 bits, or white images whose alpha channel is the mask.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from ..data.images import size_text
from ..data.mask_files import classes_of, is_in_alpha
from ..errors import UserError
from .moving import frame_name
from .source import Folder, Source, open_source, read_image, read_rgb

HIDES_ALL = 0.999
"""Share of the pixels above which masks count as hiding everything."""


def read_masks(
    path: Path,
    source: Source,
    indices: Sequence[int],
    names: Sequence[str],
    size: tuple[int, int],
    turns: Sequence[int] = (),
) -> Iterator[np.ndarray]:
    """Read the user's masks.

    The masks are a video, or a folder with one mask for each frame of the source: with the same name for a folder of
    images, in the order of names for a video. A folder may also hold masks of the picked frames only, named by their
    numbers.

    Args:
        indices, names: indices, ascending, and file names of the picked frames.
        size: (width, height) of the frames.
        turns: quarter turns, counter-clockwise, of the frames that were turned; empty if none was.

    Yields:
        [H, W] bool for each picked frame, at ``size``, True on moving pixels.

    Raises:
        UserError: masks are missing, do not fit the frames, or hide everything.
    """
    masks = open_source(path)
    if isinstance(masks, Folder):
        images = _of_folder(path, _paired(masks, source, indices, names))
    else:
        images = _of_film(masks, source, indices, max(size))
    shares = []
    for image, count in zip(images, turns or [0] * len(indices)):
        mask = _fitted(image, path, size, count)
        shares.append(float(mask.mean()))
        yield mask
    if np.mean(shares) > HIDES_ALL:
        raise UserError(
            f"{path}: masks hide everything; they are black where something moves, and white elsewhere: invert them, "
            "or give --masks none"
        )


def _of_film(masks: Source, source: Source, indices: Sequence[int], longest: int) -> Iterator[np.ndarray]:
    """Yield the frames of a film of masks."""
    found = 0
    for still in islice(masks.frames(longest, set(indices)), len(indices)):
        yield still.image
        found += 1
    if found < len(indices):
        missing = f"ends before frame {indices[found]} of {source.path}"
        raise UserError(f"{masks.path}: {missing}; give a mask for each frame of the video")


class _Values(NamedTuple):
    """Values that the pixels of masks have."""

    kind: np.dtype
    colors: tuple[float, float]
    """Smallest and largest value of all colours."""
    alphas: tuple[float, float]
    """The same of the alpha channel; both 0 without one."""

    @property
    def largest(self) -> float:
        """Largest value of white by the kind of numbers."""
        return 1.0 if self.kind.kind == "f" else float(np.iinfo(self.kind).max)


def _values_of(file: Path) -> _Values:
    image = read_image(file, cv2.IMREAD_UNCHANGED)
    colors = image if image.ndim == 2 else image[..., :3]
    alphas = image[..., 3] if image.ndim == 3 and image.shape[2] == 4 else np.zeros(1, image.dtype)
    return _Values(image.dtype, (float(colors.min()), float(colors.max())), (float(alphas.min()), float(alphas.max())))


def _of_folder(path: Path, files: Sequence[Path]) -> Iterator[np.ndarray]:
    """Yield masks as bytes [H, W, 3], 255 where nothing moves. What their numbers mean is decided for all alike."""
    if all(classes_of(file) is not None for file in files):
        for file in files:
            classes = classes_of(file)
            assert classes is not None
            yield cv2.cvtColor(np.where(classes > 0, 255, 0).astype(np.uint8), cv2.COLOR_GRAY2RGB)
        return
    each = [_values_of(file) for file in files]
    values = each[0]
    if len({one.kind for one in each}) > 1:
        yield from map(read_rgb, files)
        return
    colors = min(one.colors[0] for one in each), max(one.colors[1] for one in each)
    alphas = min(one.alphas[0] for one in each), max(one.alphas[1] for one in each)
    in_alpha = is_in_alpha(path, colors, alphas, values.largest)
    most = alphas[1] if in_alpha else colors[1]
    white = most if most in (1.0, 255.0) else values.largest
    if most < 0.5 * white:
        raise UserError(
            f"{path}: masks hide everything, because their largest value is {most:g}; save them with "
            f"{values.largest:g} where nothing moves and 0 where something does, or give --masks none"
        )
    if white == values.largest and values.kind.kind != "f" and not in_alpha:
        yield from map(read_rgb, files)
        return
    for file in files:
        image = read_image(file, cv2.IMREAD_UNCHANGED)
        if image.ndim == 3:
            image = image[..., 3] if in_alpha else image[..., :3].max(2)
        gray = np.rint(image.astype(np.float64) * (255.0 / white)).clip(0, 255).astype(np.uint8)
        yield cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB)


def _fitted(image: np.ndarray, path: Path, size: tuple[int, int], turns: int = 0) -> np.ndarray:
    """Return [H, W] bool at ``size``, True on black, of a mask that may have to be turned as its frame was."""
    if (image.shape[1] > image.shape[0]) != (size[0] > size[1]):
        image = np.ascontiguousarray(np.rot90(image, turns))
    ratio = image.shape[1] / image.shape[0] / (size[0] / size[1])
    if abs(ratio - 1) > 0.02:
        raise UserError(
            f"{path}: holds masks of {size_text(image.shape[1::-1])}, frames are {size_text(size)}; give masks of the "
            "frames' proportions"
        )
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA).max(2) < 128


def _paired(masks: Folder, source: Source, indices: Sequence[int], names: Sequence[str]) -> list[Path]:
    """Return the file of each picked frame's mask."""
    by_name = {file.name: file for file in masks.files} | {file.stem: file for file in masks.files}
    if not source.video:
        keys = [next((key for key in (f"{name}.png", Path(name).stem) if key in by_name), name) for name in names]
    elif len(masks.files) > max(indices):
        return [masks.files[index] for index in indices]
    else:
        keys = [frame_name(index) for index in indices]
    missing = [key for key in keys if key not in by_name]
    if missing:
        raise UserError(
            f"{masks.path}: no mask for {Path(missing[0]).stem} ({len(missing)} of {len(keys)} are missing); name "
            "masks as their frames, or give one for each frame of the video"
        )
    return [by_name[key] for key in keys]
