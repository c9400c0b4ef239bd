"""Conversion to browser units, in which all scenes have the same size, because a picture can encode depths
only up to 167 browser units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.cameras import Overview

RADIUS = 4.0
"""Distance of the training cameras from the scene's centre, browser units."""
FARTHEST = 167.0
"""Largest depth that a picture can encode, browser units."""


@dataclass(frozen=True)
class Display:
    """Map from world units to browser units: the scene's centre is the origin, its cameras are ``RADIUS`` away."""

    centre: tuple[float, float, float]
    scale: float

    @staticmethod
    def of(overview: Overview) -> Display:
        return Display(overview.centre, RADIUS / overview.radius)

    def show(self, points: np.ndarray) -> np.ndarray:
        """Convert points [..., 3] from world to browser units."""
        return (np.asarray(points, np.float64) - self.centre) * self.scale

    def world(self, points: np.ndarray) -> np.ndarray:
        """Convert points [..., 3] from browser to world units."""
        return np.asarray(points, np.float64) / self.scale + self.centre

    def depth(self, depth: np.ndarray, behind: float, stride: int = 1) -> np.ndarray:
        """Convert every ``stride``-th row and column of depth [H, W], float32 world units, to browser units.

        The result is moved away by ``behind`` (browser units) and limited to ``FARTHEST``.
        """
        return np.minimum(depth[::stride, ::stride] * np.float32(self.scale) + np.float32(behind), FARTHEST)

    @property
    def empty_depth(self) -> np.ndarray:
        """[2, 2] depth of a picture that hides no overlay."""
        return np.full((2, 2), FARTHEST, np.float32)
