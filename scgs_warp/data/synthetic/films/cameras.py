"""Cameras of a film: a path as of a hand that holds a phone, or a rig of cameras that stand still.

World units are taken as metres. Matrices are world-to-camera, OpenCV.
"""

from __future__ import annotations

import math

import numpy as np

DISTANCE = 3.1
"""Distance of the cameras from the middle of the room."""
HEIGHT = 1.5
"""Mean height of the cameras above the floor."""
AIM = 1.05
"""Height above the floor at which the cameras look."""
TREMOR = ((0.45, 1.0), (0.8, 0.7), (1.7, 0.45), (3.1, 0.25), (6.3, 0.12), (9.1, 0.06))
"""Frequency in Hz and relative amplitude of the movements of a hand: slow drift to tremor."""
SWAY_METRES = 0.025
SWAY_DEGREES = 0.9
"""Amplitude of the slowest movement at a shake of 1."""


def looking(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the matrix [4, 4] of an upright camera at ``eye`` that looks at ``target``."""
    forward = target - eye
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    camera_to_world[:3, 3] = eye
    return np.linalg.inv(camera_to_world)


def at(azimuth: float, height: float, floor: float, distance: float = DISTANCE) -> np.ndarray:
    """Return the matrix of a camera that looks at the subject from ``azimuth`` degrees off its front."""
    angle = math.radians(azimuth - 90.0)
    eye = np.array([distance * math.cos(angle), distance * math.sin(angle), floor + height])
    return looking(eye, np.array([0.0, 0.0, floor + AIM]))


class HandHeldPath:
    """Somebody walks half round the subject with a phone; the hand sways and trembles."""

    def __init__(self, seconds: float, floor: float, shake: float, arc: float, rng: np.random.Generator) -> None:
        """
        Args:
            seconds: length of the film.
            shake: strength of the hand's movements; 0: none.
            arc: angle of the walk about the subject, degrees.
        """
        self.seconds, self.floor, self.shake, self.arc = seconds, floor, shake, arc
        self._phases = rng.uniform(0.0, 2.0 * math.pi, (6, len(TREMOR)))
        self._side = 1.0 if rng.uniform() < 0.5 else -1.0

    def viewmat(self, seconds: float) -> np.ndarray:
        """Return the world-to-camera matrix [4, 4] at a moment of the film."""
        share = seconds / self.seconds
        azimuth = self._side * self.arc * (share - 0.5)
        height = HEIGHT + 0.3 * math.sin(2.0 * math.pi * share + 0.7)
        steady = at(azimuth, height, self.floor, DISTANCE + 0.25 * math.sin(3.0 * math.pi * share))
        return self._hand(seconds) @ steady

    def _hand(self, seconds: float) -> np.ndarray:
        """Return the small rigid motion of the camera in its own frame."""
        waves = np.array([frequency for frequency, _ in TREMOR]) * 2.0 * math.pi * seconds
        sizes = np.array([size for _, size in TREMOR]) * self.shake
        sway = (sizes * np.sin(waves + self._phases)).sum(1)
        x, y, z = np.radians(SWAY_DEGREES) * sway[:3]
        turn = np.eye(4)
        turn[:3, :3] = _small_rotation(x, y, z)
        turn[:3, 3] = SWAY_METRES * sway[3:]
        return turn


def _small_rotation(x: float, y: float, z: float) -> np.ndarray:
    """Return the rotation [3, 3] by the vector (x, y, z), radians (Rodrigues)."""
    angle = math.sqrt(x * x + y * y + z * z)
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-12:
        return np.eye(3) + K
    return np.eye(3) + math.sin(angle) / angle * K + (1.0 - math.cos(angle)) / angle**2 * K @ K


def rig_viewmats(count: int, floor: float, arc: float) -> np.ndarray:
    """Return the matrices [C, 4, 4] of a rig that stands across ``arc`` degrees about the subject. The first camera is
    nearest to the middle, the others on both sides, alternately lower and higher."""
    spacing = arc / max(count - 1, 1)
    azimuths = sorted((spacing * (k - (count - 1) / 2) for k in range(count)), key=abs)
    heights = [HEIGHT + (0.0 if k == 0 else 0.35 * (-1.0) ** k) for k in range(count)]
    return np.stack([at(azimuth, height, floor) for azimuth, height in zip(azimuths, heights)])
