"""What the pixels of a mask mean: its colours, its alpha channel, or the numbers of a palette's colours."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np

from ..errors import UserError
from ..storage.files import open_regular

Range = tuple[float, float]
MOST_DIFFERENT = 0.02
"""Largest relative difference between the proportions of a mask that cuts out and of its image."""


def classes_of(path: Path) -> np.ndarray | None:
    """Return the numbers [H, W] of the colours of a palette image, of which none or all are black, as programs
    write that label objects: 0 takes the place of black. None for other images, whose colours tell."""
    from PIL import Image

    try:
        with open_regular(path) as file, Image.open(file) as image:
            palette = image.getpalette("RGB") if image.mode == "P" else None
            if palette is None:
                return None
            classes = np.asarray(image)
    except (OSError, ValueError, SyntaxError, TypeError, struct.error, Image.DecompressionBombError):
        return None  # The decoder reports the damage.
    used = np.unique(classes)
    colors = np.zeros((256, 3), np.uint8)
    colors[: len(palette) // 3] = np.array(palette, np.uint8).reshape(-1, 3)
    tells_apart = not colors[used].any(axis=1).all() and bool((colors[used] != colors[used[0]]).any())
    return classes if used[0] == 0 and len(used) > 1 and not tells_apart else None


def marked(path: Path, pixels: np.ndarray) -> np.ndarray:
    """Return [H, W] bool, True where a mask with the pixels [H, W, 3 or 4] is not black, by whatever it means.

    Raises:
        UserError: it may mean either.
    """
    colors, alphas = pixels[..., :3], pixels[..., 3:]
    white = float(np.iinfo(pixels.dtype).max)
    if alphas.size and is_in_alpha(path, _range(colors), _range(alphas), white):
        return alphas[..., 0] > 0
    classes = None if alphas.size else classes_of(path)
    return (colors.max(axis=2) if classes is None else classes) > 0


def _range(values: np.ndarray) -> Range:
    return float(values.min()), float(values.max())


def cut_out(path: Path, pixels: np.ndarray, mask_path: Path, mask: np.ndarray) -> np.ndarray:
    """Return the pixels [H, W, 4] of an image whose alpha is the brightness of a mask, black on the background.

    Args:
        path: the image; its pixels are [H, W, 3 or 4].
        mask: [h, w, 3 or 4] of any size.

    Raises:
        UserError: the mask has other proportions than the image.
    """
    (height, width), (rows, columns) = pixels.shape[:2], mask.shape[:2]
    if abs(columns * height / (rows * width) - 1.0) > MOST_DIFFERENT:
        raise UserError(
            f"{mask_path}: is {columns} x {rows} pixels, but its image {path.name} {width} x {height}; give it the "
            "proportions of the image"
        )
    grey, largest = mask[..., :3].max(axis=2), float(np.iinfo(mask.dtype).max)
    share = grey.astype(np.float32) / (1.0 if grey.max() == 1 else largest)  # some programs write 0 and 1
    if (height, width) != (rows, columns):
        share = cv2.resize(share, (width, height), interpolation=cv2.INTER_AREA)
    alpha = np.rint(share * np.iinfo(pixels.dtype).max).astype(pixels.dtype)
    return np.dstack([pixels[..., :3], alpha])


def by_alpha(pixels: np.ndarray, mask: np.ndarray | None, opaque: float) -> tuple[np.ndarray, np.ndarray | None]:
    """Take alpha from the pixels [H, W, 3 or 4] of an image into its mask [H, W], None if every pixel is valid.

    Args:
        opaque: least alpha of valid pixels, in [0, 1].
    """
    if pixels.shape[2] == 3:
        return pixels, mask
    valid = pixels[..., 3] >= opaque * np.iinfo(pixels.dtype).max
    if not valid.all():
        mask = valid if mask is None else mask & valid
    return np.ascontiguousarray(pixels[..., :3]), mask


def is_in_alpha(path: Path, colors: Range, alphas: Range, white: float) -> bool:
    """Return whether masks are in their alpha channel, by the smallest and largest values of colours and of alpha.

    Args:
        white: value of white by the kind of numbers.

    Raises:
        UserError: only alpha differs, of black pixels.
    """
    if colors[0] < colors[1] or alphas[0] == alphas[1]:
        return False
    if colors[0] < white:
        raise UserError(
            f"{path}: masks differ in their alpha channel only, and black that is transparent may mean either; save "
            "them without alpha, black on what does not count and white elsewhere"
        )
    return True
