"""Assembly of a data set from the frames that a reader found.

Every file is decoded once, so that a damaged file is reported before training begins, and cached if there is room.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..errors import UserError
from ..types import Camera
from .borders import border_mask, reduce_mask
from .cache import ImageCache, Pixels
from .covisible import read_covisible
from .dataset import Dataset, StoredFrame, spread
from .depth_maps import DepthFile, read_depth_map
from .far_origin import offset_of
from .images import Decoded, ReadOptions, decode, is_transparent, parallel_map, read_image, size_text
from .lens import Lens
from .points import finite_points

BORDER_FRAMES = 24
"""Largest number of frames decoded for the detection of borders; all of them are in memory at once."""

MAX_CAMERA_VALUE = 1e30
"""Largest magnitude of an entry of a pose or of intrinsics: float32 holds the entry and the products formed from it."""


@dataclass(frozen=True)
class FrameRecord:
    """A frame as described by its reader, before decoding."""

    file: Path
    viewmat: np.ndarray
    """[4, 4] float64 world-to-camera, OpenCV."""
    time: float
    lens: Callable[[tuple[int, int]], Lens]
    """Function from the (width, height) of the file to the lens; raises UserError if the size does not fit."""
    name: str
    mask: Path | None = None
    """Path of the frame's own mask, an image that is black where the frame is not valid; None without a mask."""
    states_size: bool = True
    """Whether the camera states the size of its images, which decides on the EXIF orientation."""
    depth: DepthFile | None = None
    masked_by_alpha: bool = False
    """Whether pixels of the image that are not opaque are not valid, instead of transparent."""
    covisible: Path | None = None
    """Mask of what training images show as well; None without one."""
    mask_excludes: bool = False
    """Whether the mask is black where the frame is valid instead."""
    cut_out_by: Path | None = None
    """Image whose brightness is the alpha of the frame; None: that of its own file."""

    def anchored(self) -> FrameRecord:
        """Return the record with absolute paths, which stay valid if the program changes its directory."""
        mask, covisible = (None if path is None else path.absolute() for path in (self.mask, self.covisible))
        depth = None if self.depth is None else self.depth._replace(path=self.depth.path.absolute())
        return replace(self, file=self.file.absolute(), mask=mask, depth=depth, covisible=covisible)


@dataclass(frozen=True)
class _Facts:
    """Properties of a decoded file."""

    camera: Camera
    source: tuple[int, int]
    has_alpha: bool
    transparent: bool
    distorted: bool
    valid: bool
    """True if the frame's own mask leaves at least one valid pixel."""
    valid_within_border: bool


def assemble(
    records: Sequence[FrameRecord],
    options: ReadOptions,
    *,
    folder: Path,
    split: str,
    one_size: bool = False,
    border: np.ndarray | None = None,
    notes: Sequence[str] = (),
) -> Dataset:
    """Decode every frame once and return the data set.

    Many tools write RGBA files even for images without transparency. Alpha is therefore used only if at least one file
    is cut out (:func:`is_transparent`); otherwise it is dropped, and the frames get border masks and background points.

    Args:
        one_size: whether to refuse files of different sizes, unless their cameras state them.
        border: [H, W] bool, False on the border of the video; applied to images without alpha.
        notes: lines for the user, kept with the data set.

    Raises:
        UserError: one line naming the file, the field and the remedy.
    """
    far = offset_of([record.viewmat for record in records])
    if far is not None:
        x, y, z = (f"{value:.0f}" for value in far)
        raise UserError(
            f"{folder}: the cameras are so far from the origin that 32-bit numbers do not tell them apart; subtract "
            f"({x}, {y}, {z}) from the places of all cameras and points"
        )
    cache = options.cache if options.cache is not None else ImageCache()
    keys = [object() for _ in records]

    def inspect(index: int) -> _Facts:
        decoded = _decode(records[index], options)
        cache.offer(keys[index], decoded.pixels)
        return _facts(records[index], decoded, border)

    facts = parallel_map(inspect, range(len(records)), options.progress)
    cut_out = any(fact.transparent for fact in facts)
    borders: dict[tuple[int, int], Tensor | None] = {}
    views = []
    for record, fact, key in zip(records, facts, keys):
        if one_size and fact.source != facts[0].source and not (record.states_size and records[0].states_size):
            raise UserError(
                f"{record.file}: is {size_text(fact.source)}, but {records[0].file.name} is "
                f"{size_text(facts[0].source)}; give all images of a split one size, or each frame its w and h"
            )
        has_alpha = fact.has_alpha and cut_out
        if fact.has_alpha and not has_alpha:
            cache.strip_alpha(key)
        common = None
        if not has_alpha and not fact.distorted:
            if fact.source not in borders:  # Frames share one mask: thousands of copies would take gigabytes.
                borders[fact.source] = _reduced_border(border, fact)
            common = borders[fact.source]
        if not (fact.valid if common is None else fact.valid_within_border):
            # A frame without valid pixels has neither a loss nor a score.
            raise UserError(
                f"{record.file}: no pixel is left after its mask, the video's border and the reduction to "
                f"{size_text((fact.camera.width, fact.camera.height))}; "
                "correct mask_path or the lens, give a smaller downscale or drop the frame"
            )
        later = record.anchored()
        read, depth, shown = _reader(later, options), _depth_reader(later, fact), _covisible_reader(later, fact)
        views.append(StoredFrame(fact.camera, record.time, record.name, read, has_alpha, common, key, depth, shown))
    return Dataset(views, folder=folder, split=split, background=options.background, cache=cache, notes=notes)


def with_points(data: Dataset, points: np.ndarray | None, colors: np.ndarray | None) -> Dataset:
    """Attach initial points [P, 3], world units, and colours [P, 3] in [0, 1]. Points that are non-finite in float32
    are left out."""
    if points is None:
        return data
    kept = finite_points(points)
    data.points = torch.from_numpy(points[kept]).float()
    data.colors = None if colors is None else torch.from_numpy(colors[kept]).float()
    return data


def _decode(record: FrameRecord, options: ReadOptions) -> Decoded:
    own = record.mask, record.states_size, record.masked_by_alpha, record.mask_excludes, record.cut_out_by
    return read_image(record.file, options, record.lens, *own)


def _reader(record: FrameRecord, options: ReadOptions) -> Callable[[], Pixels]:
    return lambda: _decode(record, options).pixels


def _depth_reader(record: FrameRecord, fact: _Facts) -> Callable[[], Tensor] | None:
    file = record.depth
    if file is None:
        return None
    lens = record.lens(fact.source) if fact.distorted else None
    return lambda: read_depth_map(file, fact.source, lens)


def _covisible_reader(record: FrameRecord, fact: _Facts) -> Callable[[], Tensor] | None:
    path = record.covisible
    if path is None:
        return None
    lens = record.lens(fact.source) if fact.distorted else None
    return lambda: read_covisible(path, fact.source, (fact.camera.width, fact.camera.height), lens)


def _facts(record: FrameRecord, decoded: Decoded, border: np.ndarray | None) -> _Facts:
    image, alpha, mask = decoded.pixels
    height, width = image.shape[:2]
    lens, source = decoded.lens, decoded.source_size
    sx, sy = width / source[0], height / source[1]
    numbers = np.abs([lens.fx, lens.fy, lens.cx, lens.cy, *record.viewmat.ravel()])
    if not (numbers < MAX_CAMERA_VALUE).all() or min(lens.fx * sx, lens.fy * sy) * MAX_CAMERA_VALUE < 1.0:
        raise UserError(
            f"{record.file}: its camera has numbers beyond {MAX_CAMERA_VALUE:g} or non-finite; "
            "correct its pose and intrinsics"
        )
    K = np.array([[lens.fx * sx, 0.0, lens.cx * sx], [0.0, lens.fy * sy, lens.cy * sy], [0.0, 0.0, 1.0]])
    camera = Camera(torch.from_numpy(record.viewmat).float(), torch.from_numpy(K).float(), width, height)
    valid = mask is None or bool(mask.any())
    within = valid
    if border is not None and border.shape == (source[1], source[0]):
        reduced = torch.from_numpy(reduce_mask(border, (width, height)))
        within = bool((reduced if mask is None else reduced & mask).any())
    return _Facts(camera, source, alpha is not None, decoded.transparent, lens.distorted, valid, within)


def _reduced_border(border: np.ndarray | None, fact: _Facts) -> Tensor | None:
    if border is None or border.shape != (fact.source[1], fact.source[0]):
        return None
    return torch.from_numpy(reduce_mask(border, (fact.camera.width, fact.camera.height)))


def video_border(files: Sequence[Path], times: Sequence[float]) -> np.ndarray | None:
    """Detect the black border of the video: return [H, W] bool, False on the border; None without a border. The result
    does not depend on the split."""
    order = sorted(range(len(files)), key=lambda index: times[index])
    sampled = [files[order[position]] for position in spread(len(order), BORDER_FRAMES)]
    images = parallel_map(decode, [file for file in sampled if file.is_file()])
    if any(is_transparent(image) for image in images):
        return None  # Alpha marks the border more precisely.
    return border_mask([image[..., :3] for image in images])
