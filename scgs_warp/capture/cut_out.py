"""Pictures that are cut out by alpha, as programs that remove backgrounds write them. What is hidden has no colour: it
is black, and does not bleed into what is visible."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from ..data.images import CUT_OUT, OPAQUE
from .source_frame import shrunk

HIDDEN = 128
"""Alpha below which a pixel shows nothing in which features are found."""


def split(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Split [H, W, 4] uint8 into colours, black where they are hidden, and alpha, None if all is opaque."""
    image, alpha = np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3])
    if alpha.min(initial=255) == 255:
        return image, None
    image[alpha == 0] = 0
    return image, alpha


def is_cut_out(alpha: np.ndarray | None) -> bool:
    """Return whether a picture with this alpha [H, W] uint8 is cut out, as for data sets."""
    return alpha is not None and float((alpha < OPAQUE * 255).mean()) > CUT_OUT


def moved(
    image: np.ndarray, alpha: np.ndarray | None, move: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Apply a linear operation, such as a reduction, to colours weighted by alpha, and to alpha."""
    if alpha is None:
        return move(image), None
    share = alpha[..., None].astype(np.float32)
    both = move(np.concatenate([image * (share / 255), share], 2))
    opacity = np.rint(both[..., 3]).clip(0, 255).astype(np.uint8)
    colors = both[..., :3] * (255 / np.maximum(both[..., 3:], 0.5))
    colors[opacity == 0] = 0
    return np.rint(colors).clip(0, 255).astype(np.uint8), opacity


def resized(image: np.ndarray, alpha: np.ndarray | None, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray | None]:
    """Resize a picture to (width, height) by averaging."""
    return moved(image, alpha, lambda pixels: cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))


def reduced(image: np.ndarray, alpha: np.ndarray | None, longest: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Reduce a picture with alpha as ``shrunk`` does one without."""
    if alpha is None:
        return shrunk(image, longest), None
    height, width = shrunk(image[..., 0], longest).shape
    return resized(image, np.ascontiguousarray(alpha), (width, height))
