"""Frames for tests of capture: cut-outs of a textured wall, and images with black squares."""

from __future__ import annotations

import cv2
import numpy as np

from scgs_warp.visualization.video import write_png


def wall(seed: int = 0, height: int = 200, width: int = 700) -> np.ndarray:
    """[height, width, 3] uint8, patterned at several scales."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width, 3), np.float32)
    for size in (4, 12, 40):
        coarse = rng.uniform(-1, 1, (height // size + 2, width // size + 2, 3)).astype(np.float32)
        total += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.rint(128 + 60 * total).clip(0, 255).astype(np.uint8)


def pan(shifts, height: int = 120, width: int = 160) -> list[np.ndarray]:
    """Cut-outs of the wall; ``shifts`` in pixels."""
    background = wall(height=height)
    return [background[:, shift : shift + width].copy() for shift in shifts]


def mask_images(folder, count: int, size=(160, 120), name="{:03d}.png"):
    """Masks, each with a black square in a place of its own."""
    folder.mkdir()
    for index in range(count):
        picture = np.full((size[1], size[0], 3), 255, np.uint8)
        picture[10:30, 5 * index : 5 * index + 20] = 0
        write_png(folder / name.format(index), picture)
    return folder
