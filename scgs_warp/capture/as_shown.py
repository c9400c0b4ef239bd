"""Decoded frames of a film as players show them: upright, in sRGB, with square pixels, and cut out by alpha."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np

from . import cut_out
from .high_dynamic_range import is_high_dynamic_range, to_standard

BT709, UNKNOWN, BT2020 = 1, 2, 9
"""Numbers of the matrices from RGB to the stored brightness and colour differences (ITU-T H.273)."""
HD_LONGER, SD_SHORTER = 1280, 576
"""Sides, pixels, from which on and beyond which films are of high definition."""


def picture(frame: Any, longest: int, shape: float) -> tuple[np.ndarray, np.ndarray | None]:
    """Return [H, W, 3] uint8 and alpha [H, W] uint8, None for a film without alpha.

    Args:
        longest: largest size of the longer side; larger pictures are reduced.
        shape: width of the stored pixels divided by their height.
    """
    width, height = frame.width * shape, frame.height
    scale = min(1.0, longest / max(width, height))
    rich = is_high_dynamic_range(frame.color_trc)
    if frame.colorspace == UNKNOWN:
        frame.colorspace = _usual_matrix(frame.width, frame.height, rich)
    clear = not rich and any(component.is_alpha for component in frame.format.components)
    image = frame.to_ndarray(format="rgb48le" if rich else "rgba" if clear else "rgb24")
    if frame.interlaced_frame:
        image = _one_field(image)
    image, alpha = cut_out.split(image) if clear else (image, None)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    if size != (frame.width, frame.height):
        image, alpha = cut_out.resized(image, alpha, size)
    if rich:
        image = to_standard(image, frame.color_trc)
    matrix = _display_matrix(frame)
    return turned(image, matrix), None if alpha is None else turned(alpha, matrix)


def _usual_matrix(width: int, height: int, rich: bool) -> int:
    """Return the matrix that players take for a film that does not name its own: by convention, BT.709 is that of high
    definition, BT.2020 that of high dynamic range, and BT.601, which is ffmpeg's own choice, that of the rest."""
    if rich:
        return BT2020
    return BT709 if max(width, height) >= HD_LONGER or min(width, height) > SD_SHORTER else UNKNOWN


def _one_field(image: np.ndarray) -> np.ndarray:
    """Replace every other row of an interlaced picture, which was recorded at another moment, by those beside it."""
    image = image.copy()
    own, other = image[0::2], image[1::2]
    between = len(own) - 1
    other[:] = own[: len(other)]
    other[:between] = cv2.addWeighted(own[:-1], 0.5, own[1:], 0.5, 0.0)
    return image


def _display_matrix(frame: Any) -> np.ndarray | None:
    """Return the matrix by which players turn and mirror the pictures [3, 3], for row vectors; None without one."""
    try:
        found = [bytes(data) for data in frame.side_data if data.type.name == "DISPLAYMATRIX"]
    except ValueError:  # other data, of a kind that PyAV does not know
        turn = math.radians(frame.rotation)
        return np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    return np.frombuffer(found[0], np.int32).reshape(3, 3) if found and len(found[0]) == 36 else None


def turned(image: np.ndarray, matrix: np.ndarray | None) -> np.ndarray:
    """Turn an image [H, W, ...] by a display matrix, rounded to quarter turns, after mirroring it if the matrix does:
    films of front cameras may be stored so."""
    if matrix is None:
        return image
    (a, b), (c, d) = matrix[:2, :2].astype(float)
    if a * d - b * c < 0:
        image, a, b = image[:, ::-1], -a, -b
    return np.ascontiguousarray(np.rot90(image, round(-math.degrees(math.atan2(b, a)) / 90) % 4))
