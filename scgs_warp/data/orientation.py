"""Orientation of photographs: the EXIF tag that tells how a stored image is to be turned before it is shown.

Programs disagree on it: viewers and phones turn the image, while COLMAP, instant-ngp and nerfstudio estimate cameras
from the pixels as they are stored. ``images.read_image`` therefore follows the camera.
"""

from __future__ import annotations

import io
import struct

import numpy as np

UPRIGHT = 1
TAG = 0x0112
TURNS = {2: (0, True), 3: (2, False), 4: (2, True), 5: (3, True), 6: (3, False), 7: (1, True), 8: (1, False)}
"""For each value of the tag: number of quarter turns counter-clockwise, and whether the result is mirrored left to
right."""


def read_orientation(data: bytes | memoryview) -> int:
    """Return the EXIF orientation of an image file, 1 to 8; 1 for files without the tag. PNG files are not searched,
    because cameras do not write them."""
    from PIL import Image

    if bytes(data[:2]) != b"\xff\xd8" and bytes(data[:4]) not in (b"RIFF", b"II*\0", b"MM\0*"):
        return UPRIGHT
    try:
        with Image.open(io.BytesIO(data), formats=("JPEG", "WEBP", "TIFF")) as image:
            value = image.getexif().get(TAG, UPRIGHT)
    except (OSError, ValueError, SyntaxError, TypeError, KeyError, struct.error, Image.DecompressionBombError):
        return UPRIGHT  # The decoder reports the damage.
    return value if value in TURNS else UPRIGHT


def upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Turn an image [H, W, ...] as viewers show it."""
    if orientation not in TURNS:
        return pixels
    turns, mirrored = TURNS[orientation]
    turned = np.rot90(pixels, turns)
    return np.ascontiguousarray(turned[:, ::-1] if mirrored else turned)


def swaps_sides(orientation: int) -> bool:
    """Return whether turning exchanges width and height."""
    return orientation >= 5
