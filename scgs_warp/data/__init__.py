"""Data sets: whatever lies in a folder becomes a ``Dataset`` of frames. One reader a file, chosen by what is there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..errors import UserError
from . import dnerf, nerfstudio
from .dataset import Dataset
from .images import check_options

__all__ = ["Dataset", "load"]

READERS = (dnerf, nerfstudio)
"""Asked in this order: ``recognises(folder)``, then ``read(folder, split, ...)``."""


def load(
    folder: str | Path,
    split: str = "train",
    *,
    downscale: float = 1,
    resample: str = "area",
    background: str = "black",
    progress: Callable[[int, int], None] | None = None,
) -> Dataset:
    """Read one split of a data set.

    Args:
        folder: holds ``transforms_train.json`` and so on (D-NeRF / Blender layout), or one ``transforms.json``
            (nerfstudio layout).
        split: ``train``, ``test`` or ``val``.
        downscale: images become this many times smaller; the intrinsics follow.
        resample: ``area`` (float, premultiplied by alpha) or ``bicubic`` (8 bits, Pillow: as the official SC-GS).
        background: ``black`` or ``white``: RGBA images are composited on it, once. ``random``: they stay
            premultiplied, on black, for the trainer to composite.
        progress: called with (done, total) after each image.

    Returns:
        Frames in the file's order, images float32 in [0, 1].

    Raises:
        UserError: one line naming file, field and remedy.
    """
    check_options(downscale, resample, background)
    if split not in ("train", "test", "val"):
        raise UserError(f"split is {split!r}; give train, test or val")
    folder = Path(folder)
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; give one with transforms_train.json or transforms.json")
    for reader in READERS:
        if reader.recognises(folder):
            return reader.read(
                folder, split, downscale=downscale, resample=resample, background=background, progress=progress
            )
    raise UserError(
        f"{folder}: no transforms_{split}.json and no transforms.json here; give the folder of a D-NeRF / Blender or "
        "nerfstudio data set"
    )
