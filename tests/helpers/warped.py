"""Pictures that a bent lens takes of a known pattern: made with OpenCV's inverse models, apart from the readers."""

from __future__ import annotations

import cv2
import numpy as np


def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[..., 3] in [0, 1]: a smooth colour for each direction (x, y, 1)."""
    return 0.5 + 0.4 * np.stack([np.sin(4 * x + y), np.cos(3 * y - x), np.sin(5 * (x + y))], axis=-1)


def pixel_centres(width: int, height: int) -> np.ndarray:
    """[H, W, 2]"""
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)


def landing(rays: np.ndarray, K: np.ndarray, distortion: np.ndarray, fisheye: bool = False) -> np.ndarray:
    """[N, 2] pixels where the rays (x, y, 1), [N, 2], land."""
    points = np.concatenate([rays, np.ones((len(rays), 1))], 1)[:, None]
    model = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    return model(points, np.zeros(3), np.zeros(3), K, distortion)[0].reshape(-1, 2)


def picture(width: int, height: int, K: np.ndarray, distortion: np.ndarray, fisheye: bool = False) -> np.ndarray:
    """[H, W, 3] uint8 RGB of the pattern, as the bent lens sees it."""
    pixels = pixel_centres(width, height).reshape(-1, 2)
    rays = np.zeros_like(pixels)
    for _ in range(200):  # each ray moves until it lands on its pixel
        rays -= 0.7 * (landing(rays, K, distortion, fisheye) - pixels) / K[[0, 1], [0, 1]]
    x, y = rays.reshape(height, width, 2).transpose(2, 0, 1)
    return (pattern(x, y) * 255).round().astype(np.uint8)


def straight(width: int, height: int, K: np.ndarray) -> np.ndarray:
    """[H, W, 3] the pattern as a pinhole sees it."""
    x, y = ((pixel_centres(width, height) - K[[0, 1], 2]) / K[[0, 1], [0, 1]]).transpose(2, 0, 1)
    return pattern(x, y)
