"""A walking skeleton of rods 1 to 3 pixels wide, bright or nearly black, with the truth of their axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ....kernels import solid_textures as patterns
from ..raycast import Lamp
from ..renderer import GROUND_TRUTH_TIMES
from ..shading import Shading
from ..solids import Vector, capsule
from ..surface import Material, Piece, RigidParts, merge, placed
from .rod_skeleton import RODS, bone_transforms
from .subject import SurfaceSubject

FILE = "rods.npz"
LIGHT_STEP = 0.035
"""Distance between the rings of vertices that hold the light, along a rod."""
LAMP = Lamp(spread=0.3, sky_rays=24, key_rays=8, reach=0.3)

CREAM, CORAL, MINT = (1.25, 1.20, 1.06), (1.25, 0.62, 0.46), (0.64, 1.15, 0.98)
GOLD, SKY, LILAC = (1.25, 1.00, 0.36), (0.62, 0.96, 1.25), (1.04, 0.82, 1.25)
BRIGHT: dict[str, tuple[Vector, Vector, Vector]] = {
    "spine": (CREAM, CORAL, GOLD),
    "ribs": (CREAM, GOLD, SKY),
    "head": (CREAM, LILAC, CORAL),
    "eyes": (MINT, SKY, MINT),
    "arms": (SKY, CREAM, LILAC),
    "hands": (CORAL, CREAM, GOLD),
    "legs": (MINT, CREAM, GOLD),
    "feet": (GOLD, CORAL, CREAM),
    "tail": (LILAC, CREAM, MINT),
}
"""Colours of each group of rods. Some exceed 1, because at most half of a rod faces the key light."""
DARKENING = 0.06
"""Colours of the dark skeleton over those of the bright one."""


def _darkened(color: Vector) -> Vector:
    return color[0] * DARKENING, color[1] * DARKENING, color[2] * DARKENING


def _material(group: str, dark: bool) -> Material:
    first, second, third = BRIGHT[group]
    if dark:
        first, second, third = _darkened(first), _darkened(second), _darkened(third)
    return Material(int(patterns.STRIPES), (first, second, third), (0.0, 0.0, 13.0))


def _axes() -> np.ndarray:
    """Return the end points [R, 2, 3] of ``RODS``, in the frames of their bones."""
    return np.array([(rod.start, rod.end) for rod in RODS], np.float64)


def _along(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the rigid transform [4, 4] that moves the origin to the middle of ``start`` and ``end``, and turns the
    z axis to ``end``."""
    z = (end - start) / np.linalg.norm(end - start)
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    return placed(*((start + end) / 2), turn=np.stack([x, np.cross(z, x), z], axis=1))


class RodsSubject(SurfaceSubject):
    """The skeleton; it also knows the axes of its rods."""

    def __init__(self, device: str, shading: Shading, dark: bool) -> None:
        pieces = []
        for rod, (start, end) in zip(RODS, _axes()):
            solid = capsule(float(np.linalg.norm(end - start)), rod.radius, LIGHT_STEP)
            pieces.append(Piece(*solid, _material(rod.group, dark), rod.bone, _along(start, end)))
        self.rigid = RigidParts(merge(pieces), bone_transforms)
        super().__init__(self.rigid, device, shading, LAMP)

    def ends(self, times: Sequence[float]) -> np.ndarray:
        """Return the end points of the rods' axes, [T, R, 2, 3] float64, world; rods reach one radius farther."""
        axes, found = _axes(), []
        for time in times:
            moves = self.rigid.part_transforms(float(time))
            found.append(np.einsum("rij,rej->rei", moves[:, :3, :3], axes) + moves[:, None, :3, 3])
        return np.stack(found)

    def write_rods(self, folder: Path, times: Mapping[str, Sequence[float]]) -> None:
        """Write ``rods.npz``: names, radii and end points of all rods, at the instants of the ground truth and at those
        of every picture.

        Args:
            times: times of the pictures of each split.

        Raises:
            OSError: the file cannot be written.
        """
        instants = np.linspace(0.0, 1.0, GROUND_TRUTH_TIMES)
        arrays: dict[str, Any] = {f"{split}_ends": self.ends(own).astype(np.float32) for split, own in times.items()}
        arrays["names"] = np.array([rod.name for rod in RODS])
        arrays["radii"] = np.array([rod.radius for rod in RODS], np.float32)
        arrays["times"] = instants.astype(np.float32)
        arrays["ends"] = self.ends(instants.tolist()).astype(np.float32)
        np.savez(folder / FILE, **arrays)


def make_rods(device: str, shading: Shading, dark: bool) -> RodsSubject:
    """Make the skeleton in bright colours, or in dark ones that are easily mistaken for a black background."""
    return RodsSubject(device, shading, dark)
