"""From what a reader found out about each frame to a data set: every file is looked at once, and kept if there is room.

So a file that does not decode is told before training begins, whatever is kept of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..errors import UserError
from ..types import Camera
from .borders import border_mask, reduce_mask
from .cache import ImageCache, Pixels
from .dataset import Dataset, View, spread
from .images import Decoded, Look, decode, is_transparent, parallel_map, read_image, size_text
from .lens import Lens
from .points import finite

BORDER_FRAMES = 24
"""At most so many frames, spread over the video, are looked at for a border: all of them are in memory at once."""

LARGEST = 1e30
"""Of a camera's numbers: float32 holds them, and what is made of them."""


@dataclass(frozen=True)
class Shot:
    """A frame as its reader describes it."""

    file: Path
    viewmat: np.ndarray
    """[4, 4] float64 world-to-camera, OpenCV."""
    time: float
    lens: Callable[[tuple[int, int]], Lens]
    """Of a file of (width, height) pixels; raises UserError if that cannot be."""
    name: str
    mask: Path | None = None
    """An image, black where the frame is not valid."""


@dataclass(frozen=True)
class _Facts:
    """What is remembered of a file that was decoded."""

    camera: Camera
    source: tuple[int, int]
    has_alpha: bool
    transparent: bool
    distorted: bool
    valid: bool
    """Whether its own mask leaves a pixel."""
    valid_within_border: bool


def assemble(
    shots: Sequence[Shot],
    look: Look,
    *,
    folder: Path,
    split: str,
    one_size: bool = False,
    border: np.ndarray | None = None,
) -> Dataset:
    """The data set of these frames.

    Many tools write RGBA whatever they are given; taken for cut-out objects, filled images would get neither a border
    mask nor points on bare walls. So alpha counts if any pixel of any file is less than opaque; one image that an
    object fills keeps its own.

    Args:
        one_size: refuse files of different sizes.
        border: [H, W] bool, False on the border of the video; counts for images without alpha.

    Raises:
        UserError: one line naming the file, the field and the remedy.
    """
    cache = look.cache if look.cache is not None else ImageCache()
    keys = [object() for _ in shots]

    def examine(index: int) -> _Facts:
        decoded = _decode(shots[index], look)
        cache.offer(keys[index], decoded.pixels)
        return _facts(shots[index], decoded, border)

    facts = parallel_map(examine, range(len(shots)), look.progress)
    cut_out = any(fact.transparent for fact in facts)
    borders: dict[tuple[int, int], Tensor | None] = {}
    views = []
    for shot, fact, key in zip(shots, facts, keys):
        if one_size and fact.source != facts[0].source:
            raise UserError(
                f"{shot.file}: is {size_text(fact.source)}, but {shots[0].file.name} is {size_text(facts[0].source)}; "
                "give all images of a split one size"
            )
        has_alpha = fact.has_alpha and cut_out
        if fact.has_alpha and not has_alpha:
            cache.strip_alpha(key)
        common = None
        if not has_alpha and not fact.distorted:
            if fact.source not in borders:  # one for all: thousands would take gigabytes
                borders[fact.source] = _fitting(border, fact)
            common = borders[fact.source]
        if not (fact.valid if common is None else fact.valid_within_border):
            # Neither a step nor a score could say anything of such a frame.
            raise UserError(
                f"{shot.file}: no pixel is left by its mask, the video's border and the reduction to "
                f"{size_text((fact.camera.width, fact.camera.height))}; "
                "correct mask_path or the lens, give a smaller downscale or drop the frame"
            )
        views.append(View(fact.camera, shot.time, shot.name, _reader(shot, look), has_alpha, common, key))
    return Dataset(views, folder=folder, split=split, background=look.background, cache=cache)


def with_points(data: Dataset, points: np.ndarray | None, colors: np.ndarray | None) -> Dataset:
    """The data set with initial points [P, 3], world units, and colours [P, 3] in [0, 1]. Points that are not finite
    in float32 are left out."""
    if points is None:
        return data
    kept = finite(points)
    data.points = torch.from_numpy(points[kept]).float()
    data.colors = None if colors is None else torch.from_numpy(colors[kept]).float()
    return data


def _decode(shot: Shot, look: Look) -> Decoded:
    return read_image(shot.file, look, shot.lens, shot.mask)


def _reader(shot: Shot, look: Look) -> Callable[[], Pixels]:
    return lambda: _decode(shot, look).pixels


def _facts(shot: Shot, decoded: Decoded, border: np.ndarray | None) -> _Facts:
    image, alpha, mask = decoded.pixels
    height, width = image.shape[:2]
    lens, source = decoded.lens, decoded.source_size
    sx, sy = width / source[0], height / source[1]
    numbers = np.abs([lens.fx, lens.fy, lens.cx, lens.cy, *shot.viewmat.ravel()])
    if not (numbers < LARGEST).all() or min(lens.fx * sx, lens.fy * sy) * LARGEST < 1.0:
        raise UserError(
            f"{shot.file}: its camera has numbers beyond {LARGEST:g}, or none; correct its pose and intrinsics"
        )
    K = np.array([[lens.fx * sx, 0.0, lens.cx * sx], [0.0, lens.fy * sy, lens.cy * sy], [0.0, 0.0, 1.0]])
    camera = Camera(torch.from_numpy(shot.viewmat).float(), torch.from_numpy(K).float(), width, height)
    valid = mask is None or bool(mask.any())
    within = valid
    if border is not None and border.shape == (source[1], source[0]):
        reduced = torch.from_numpy(reduce_mask(border, (width, height)))
        within = bool((reduced if mask is None else reduced & mask).any())
    return _Facts(camera, source, alpha is not None, decoded.transparent, lens.distorted, valid, within)


def _fitting(border: np.ndarray | None, fact: _Facts) -> Tensor | None:
    if border is None or border.shape != (fact.source[1], fact.source[0]):
        return None
    return torch.from_numpy(reduce_mask(border, (fact.camera.width, fact.camera.height)))


def video_border(files: Sequence[Path], times: Sequence[float]) -> np.ndarray | None:
    """[H, W] bool, False on the black border of the video, if it has one; the same whichever split is read."""
    order = sorted(range(len(files)), key=lambda index: times[index])
    looked_at = [files[order[place]] for place in spread(len(order), BORDER_FRAMES)]
    images = parallel_map(decode, [file for file in looked_at if file.is_file()])
    if any(is_transparent(image) for image in images):
        return None  # alpha says it better
    return border_mask([image[..., :3] for image in images])
