"""Data sets: ``load`` chooses a reader by the files in a folder and returns a ``Dataset`` of frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..config.fields import CACHE_MIB
from ..errors import UserError
from .cache import ImageCache
from .choice import check_choice
from .dataset import Dataset
from .images import ReadOptions, check_options
from .readers import (
    actors_hq,
    colmap,
    dnerf,
    easy_mocap,
    nerfies,
    nerfstudio,
    panoptic,
    poses_bounds,
    rig_model,
)
from .unknown import no_layout, not_a_folder

__all__ = ["Dataset", "ImageCache", "is_data_set", "load"]

READERS = (dnerf, nerfstudio, nerfies, panoptic, rig_model, poses_bounds, easy_mocap, actors_hq, colmap)
"""Readers in the order in which they are tried: ``recognises(folder)``, then ``read(folder, split, options)``."""


def load(
    folder: str | Path,
    split: str = "train",
    *,
    downscale: float = 1,
    resample: str = "area",
    background: str = "black",
    progress: Callable[[int, int], None] | None = None,
    cache_mib: float = CACHE_MIB,
    cache: ImageCache | None = None,
    frames: str = "",
    only_cameras: str = "",
    min_frames: int = 0,
) -> Dataset:
    """Read one split of a data set. ``docs/data.md`` describes the layouts.

    Args:
        folder: folder of the data set; its files determine the layout.
        split: ``train``, ``test`` or ``val``.
        downscale: factor by which width and height are divided; the intrinsics are adapted.
        resample: ``area`` (float, premultiplied by alpha) or ``bicubic`` (8 bits, Pillow: as the official SC-GS).
        background: ``black`` or ``white``: RGBA images are composited once, on this colour. ``random``: images stay
            premultiplied, on black, and the trainer composites them.
        progress: called with (done, total) after each image.
        cache_mib: size of the cache of decoded images; images that do not fit are decoded again at each access.
        cache: a cache shared with other splits, used instead of a new one of ``cache_mib``.
        frames: instants to read, as ``A:B:C`` (first, end, step) in their order; their times are then scaled to go from
            0 to 1. Empty: all.
        only_cameras: names of the cameras to read, separated by commas. Empty: all.
        min_frames: smallest number of frames whose images must exist; the others are left out. 0: half of the frames.

    Returns:
        Frames in the file's order, images float32 in [0, 1]; ``notes`` says what was left out.

    Raises:
        UserError: one line naming file, field and remedy.
    """
    check_options(downscale, resample, background)
    if split not in ("train", "test", "val"):
        raise UserError(f"split is {split!r}; give train, test or val")
    folder = Path(folder)
    if not folder.is_dir():
        raise not_a_folder(folder)
    kept = cache if cache is not None else ImageCache(cache_mib)
    options = ReadOptions(downscale, resample, background, progress, kept, frames, only_cameras, min_frames)
    check_choice(options)
    for reader in READERS:
        if reader.recognises(folder):
            return reader.read(folder, split, options)
    raise no_layout(folder, is_data_set)


def is_data_set(folder: Path) -> bool:
    """Return whether a reader recognises the layout of a folder."""
    return any(reader.recognises(folder) for reader in READERS)
