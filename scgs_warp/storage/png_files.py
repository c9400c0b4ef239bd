"""Pictures as PNG."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def write_png(path: Path, image: np.ndarray) -> None:
    """Write [H, W, 3] uint8 RGB, or [H, W, 4] with straight alpha, losslessly.

    Raises:
        OSError: the file cannot be written.
    """
    import cv2

    swapped = image[..., [2, 1, 0, 3]] if image.shape[2] == 4 else image[..., ::-1]
    encoded = cv2.imencode(".png", swapped, [cv2.IMWRITE_PNG_COMPRESSION, 4])[1]
    path.write_bytes(encoded.data)  # Unlike numpy's tofile, this reports why it failed.
