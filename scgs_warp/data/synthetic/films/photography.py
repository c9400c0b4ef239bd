"""Pictures as a camera with a shutter takes them: rolling shutter, motion blur, exposure and white balance.

Light is averaged and multiplied in linear sRGB, as on a sensor, and stored with sRGB's curve.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from ....types import Camera
from .stage import Stage

BLUR_INSTANTS = 8
"""Number of moments within an exposure whose light is averaged."""
BAND_SECONDS = 0.003
"""Longest time between the first and the last row of a band, whose rows share a moment."""


@dataclass(frozen=True)
class Shutter:
    """Shutter of a camera."""

    exposure: float = 0.0
    """Seconds that a row is exposed; 0: no motion blur."""
    readout: float = 0.0
    """Seconds from the first to the last row; 0: all rows at once."""


@dataclass(frozen=True)
class View:
    """A camera in motion."""

    viewmat: Callable[[float], np.ndarray]
    """World-to-camera [4, 4] at a second."""
    K: np.ndarray
    """[3, 3]"""
    width: int
    height: int

    def camera(self, seconds: float) -> Camera:
        """Return the camera at a second."""
        viewmat, K = (torch.from_numpy(matrix).float() for matrix in (self.viewmat(seconds), self.K))
        return Camera(viewmat, K, self.width, self.height)


def photograph(
    stage: Stage, view: View, seconds: float, time_of: Callable[[float], float], shutter: Shutter, samples: int
) -> Tensor:
    """Take a picture whose middle row is exposed around ``seconds``.

    Args:
        time_of: function from seconds to the time of the subject.
        samples: rays per pixel, axis and moment.

    Returns:
        linear light [H, W, 3], on the stage's device.
    """
    lit = stage.pose(time_of(seconds))
    if shutter.exposure == 0 and shutter.readout == 0:
        return to_linear(stage.caster.render(lit, view.camera(seconds), samples)[..., :3])
    light = torch.zeros(view.height, view.width, 3, device=stage.device)
    picture = torch.zeros(view.height, view.width, 4, device=stage.device)
    bands = max(1, math.ceil(shutter.readout / BAND_SECONDS))
    instants = BLUR_INSTANTS if shutter.exposure > 0 else 1
    edges = [round(view.height * band / bands) for band in range(bands + 1)]
    for instant in range(instants):
        late = ((instant + 0.5) / instants - 0.5) * shutter.exposure
        for top, bottom in pairwise(edges):
            moment = seconds + late + ((top + bottom) / (2 * view.height) - 0.5) * shutter.readout
            posed = stage.pose_lit_as(lit, time_of(moment))
            stage.caster.render_rows(posed, view.camera(moment), range(top, bottom), samples, picture)
        light += to_linear(picture[..., :3]) / instants
    return light


def to_linear(color: Tensor) -> Tensor:
    """Convert stored sRGB values in [0, 1] to linear light."""
    return torch.where(color <= 0.04045, color / 12.92, ((color.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4)


def to_stored(light: Tensor) -> Tensor:
    """Convert linear light to stored sRGB values, clipped to [0, 1]."""
    light = light.clamp(0.0, 1.0)
    return torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


def develop(light: Tensor, gains: np.ndarray) -> np.ndarray:
    """Expose: multiply linear light [H, W, 3] by gains [3], and return stored values [H, W, 3] uint8 RGB."""
    stored = to_stored(light * torch.as_tensor(gains, dtype=torch.float32, device=light.device))
    return (stored * 255.0).round().to(torch.uint8).cpu().numpy()


def drifting_gains(seconds: np.ndarray, exposure: float, balance: float, rng: np.random.Generator) -> np.ndarray:
    """Return gains [V, 3] of linear light: an automatic exposure and white balance that wander.

    Args:
        exposure: largest relative change of the exposure; 0: none.
        balance: largest relative change of the red and the blue against the green.
    """
    gains = np.ones((len(seconds), 3))
    gains *= (1.0 + exposure) ** _wander(seconds, rng)[:, None]
    warmth = (1.0 + balance) ** _wander(seconds, rng)
    gains[:, 0] *= warmth
    gains[:, 2] /= warmth
    return gains


def _wander(seconds: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a smooth random function of the seconds [V], which changes within a second or two and reaches 1 or -1."""
    rates, phases = rng.uniform(0.15, 0.6, 3), rng.uniform(0.0, 2.0 * math.pi, 3)
    wave = np.sin(2.0 * math.pi * seconds[:, None] * rates + phases).mean(1)
    return wave / np.abs(wave).max()
