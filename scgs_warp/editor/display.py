"""The browser's units: scenes a millimetre or a kilometre wide look the same to it, and its depth ends at 167."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.cameras import Overview

RADIUS = 4.0
"""How far the training cameras stand from the scene, in the browser."""
FARTHEST = 167.0
"""The largest depth that a picture can carry."""


@dataclass(frozen=True)
class Display:
    """The scene's centre at 0, its cameras ``RADIUS`` away."""

    centre: tuple[float, float, float]
    scale: float

    @staticmethod
    def of(overview: Overview) -> Display:
        return Display(overview.centre, RADIUS / overview.radius)

    def show(self, points: np.ndarray) -> np.ndarray:
        """[..., 3] of the world, as the browser has them."""
        return (np.asarray(points, np.float64) - self.centre) * self.scale

    def world(self, points: np.ndarray) -> np.ndarray:
        """[..., 3] the inverse."""
        return np.asarray(points, np.float64) / self.scale + self.centre

    def depth(self, depth: np.ndarray, behind: float, stride: int = 1) -> np.ndarray:
        """[H, W] float32 of world units, ``behind`` (browser's units) further away; what is infinite, at the end."""
        return np.minimum(depth[::stride, ::stride] * np.float32(self.scale) + np.float32(behind), FARTHEST)

    @property
    def empty_depth(self) -> np.ndarray:
        """[2, 2] the depth of a picture that hides nothing."""
        return np.full((2, 2), FARTHEST, np.float32)
