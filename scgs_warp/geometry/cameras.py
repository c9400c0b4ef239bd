"""Cameras for films: an overview of the training cameras, and paths around the scene. All angles are in degrees."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..types import Camera

FULL_ORBIT_GAP = 100.0
"""Largest gap between neighbouring azimuths of cameras that count as surrounding the scene."""
SWING_SHARE = 0.8
"""Fraction of an observed arc that a turntable uses, since the arc's ends show the scene at a slant."""
STEEPEST = 80.0
"""Largest elevation of a turntable, because azimuth is undefined above a pole."""
ROUNDING = 2e-6
"""Relative error of positions taken from float32 viewmats, as a share of their distance from the origin."""

PARALLEL = 1e-4
"""Threshold for the smallest eigenvalue of the mean of I - d d^T over the directions d of the optical axes. The axes
define a nearest point if the eigenvalue exceeds it. It corresponds to angles of about 1 degree between them."""
AHEAD = 20.0
"""Distance of a scene from cameras that look the same way, in units of their spread, where nothing tells it."""

Vector = Sequence[float] | np.ndarray | Tensor


@dataclass(frozen=True)
class Overview:
    """Summary of the training cameras: plain numbers in world units, stored with the scene."""

    centre: tuple[float, float, float]
    """Point with the least squared distance to all optical axes."""
    up: tuple[float, float, float]
    """Common up direction of the cameras, a unit vector."""
    radius: float
    """Median distance of the cameras from the centre."""
    fov_x: float
    """Median horizontal field of view."""
    elevation: float
    """Median elevation of the cameras, seen from the centre."""
    azimuth: float = 0.0
    """Azimuth at which a film starts: the middle of the observed arc, or the first camera of a full orbit."""
    sweep: float = 360.0
    """Arc of azimuths that the cameras cover; 360 for a full orbit."""
    aspect: float = 1.0
    """Aspect ratio of the images: width divided by height."""
    longer_side: float = 0.0
    """Median of the images' longer sides in pixels; 0 in checkpoints of older versions."""

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as values that JSON represents exactly."""
        return {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()}

    @staticmethod
    def from_dict(values: dict[str, Any]) -> Overview:
        """Restore an overview from the result of ``to_dict``.

        Raises:
            KeyError, TypeError, ValueError: the values do not describe an overview.
        """
        rest = {key: float(value) for key, value in values.items() if key not in ("centre", "up")}
        return Overview(_triple(values["centre"]), _triple(values["up"]), **rest)


def _triple(vector: Sequence[float] | np.ndarray) -> tuple[float, float, float]:
    x, y, z = vector
    return float(x), float(y), float(z)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def agreed_up(rotations: np.ndarray) -> np.ndarray:
    """Return the common up direction of cameras, [3].

    The x axes of level cameras are perpendicular to the up direction, whatever their pitch, so it is the direction in
    which the x axes vary least. If the cameras hardly turn, this determines only a plane that contains the up
    direction, and the mean of their -y axes decides.

    Args:
        rotations: [V, 3, 3] world to camera.
    """
    mean = -rotations[:, 1].mean(0)
    values, vectors = np.linalg.eigh(rotations[:, 0].T @ rotations[:, 0] / len(rotations))
    if values[1] > 0.01 and values[1] > 10 * values[0]:  # cameras turn by some degrees and roll by far less
        level = vectors[:, 0]
        agreement = float(level @ mean)
        if abs(agreement) > 0.05:
            return level * math.copysign(1.0, agreement)
    if np.linalg.norm(mean) > 1e-3:
        return _unit(mean)
    return np.array([0.0, 0.0, 1.0])


def places_and_directions(cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Return the camera centres [V, 3] and the unit vectors [V, 3] of the optical axes, float64."""
    viewmats = torch.stack([camera.viewmat.detach().cpu() for camera in cameras]).double().numpy()
    positions = -np.einsum("vij,vi->vj", viewmats[:, :3, :3], viewmats[:, :3, 3])
    return positions, viewmats[:, 2, :3] / np.linalg.norm(viewmats[:, 2, :3], axis=1, keepdims=True)


def _centre(positions: np.ndarray, axes: np.ndarray, distance: float | None) -> np.ndarray:
    """Return the point with the least squared distance to all optical axes, [3].

    If a distance is given, or the axes are parallel or meet behind the cameras, return a point ahead of them instead.
    """
    if distance is None:
        centre, least = nearest_to_axes(positions, axes), rounding(positions)
        if centre is not None:
            depths = np.einsum("vi,vi->v", centre - positions, axes)
            if np.median(depths) > least and (depths > 0).mean() >= 0.75:
                return centre
    return point_ahead(positions, axes, distance)


def nearest_to_axes(positions: np.ndarray, axes: np.ndarray) -> np.ndarray | None:
    """Return the point x nearest to all optical axes (directions d, through p): sum (I - d d^T)(x - p) = 0; None if
    they are parallel."""
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    matrix = projectors.mean(axis=0)
    if np.linalg.eigvalsh(matrix)[0] <= PARALLEL:
        return None
    return np.linalg.solve(matrix, np.einsum("vij,vj->i", projectors, positions) / len(positions))


def point_ahead(positions: np.ndarray, axes: np.ndarray, distance: float | None) -> np.ndarray:
    """Return the point [3] at a distance before the mean camera, or amid the cameras of a panorama. Without a distance,
    it is ``AHEAD`` times the cameras' spread, or 1 for cameras at one place."""
    middle, forward = positions.mean(axis=0), axes.mean(axis=0)
    if np.linalg.norm(forward) < 1e-3:  # a panorama: the scene surrounds the cameras
        return middle
    if distance is None:
        spread = float(np.linalg.norm(positions - middle, axis=1).max())
        distance = AHEAD * spread if spread > rounding(positions) else 1.0
    return middle + _unit(forward) * distance


def rounding(positions: np.ndarray) -> float:
    """Return the distance up to which camera centres [V, 3], computed from viewmats, count as equal."""
    return ROUNDING * float(np.linalg.norm(positions, axis=1).max())


def _horizon(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit vectors of azimuths 0 and 90, which are perpendicular to ``up``; they are x and y if up is z."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    zero = _unit(helper - (helper @ up) * up)
    return zero, np.cross(up, zero)


def _arc(azimuths: np.ndarray) -> tuple[float, float]:
    """Return the start and the extent of the shortest arc that contains all azimuths."""
    ordered = np.sort(azimuths % 360.0)
    gaps = np.diff(np.append(ordered, ordered[0] + 360.0))
    widest = int(gaps.argmax())
    return float(ordered[(widest + 1) % len(ordered)]), float(360.0 - gaps[widest])


def overview(cameras: Sequence[Camera], distance: float | None = None) -> Overview:
    """Summarise training cameras, from a small arc to a full orbit.

    Args:
        cameras: at least one, world units.
        distance: where the optical axes do not meet, the distance of the scene before the mean camera, if it is known.

    Raises:
        ValueError: ``cameras`` is empty.
    """
    if not cameras:
        raise ValueError("cameras is empty; an overview needs at least one")
    viewmats = torch.stack([camera.viewmat.detach().cpu().double() for camera in cameras]).numpy()
    rotations = viewmats[:, :3, :3]
    positions = -np.einsum("vji,vj->vi", rotations, viewmats[:, :3, 3])
    up = agreed_up(rotations)
    centre = _centre(positions, rotations[:, 2], distance)
    offsets = positions - centre
    distances = np.linalg.norm(offsets, axis=1)
    heights = offsets @ up
    zero, ninety = _horizon(up)
    flat = np.stack([offsets @ zero, offsets @ ninety], axis=1)
    aside = np.linalg.norm(flat, axis=1) > 0.1 * distances  # cameras near a pole have no usable azimuth
    azimuths = np.degrees(np.arctan2(flat[:, 1], flat[:, 0]))
    start, sweep = _arc(azimuths[aside]) if aside.any() else (float(azimuths[0]), 0.0)
    if 360.0 - sweep <= FULL_ORBIT_GAP:
        azimuth, sweep = float(azimuths[aside][0]), 360.0
    else:
        azimuth = start + sweep / 2
    fields = [2 * math.degrees(math.atan(camera.width / (2 * float(camera.K[0, 0])))) for camera in cameras]
    return Overview(
        centre=_triple(centre),
        up=_triple(up),
        radius=float(np.median(distances)) or 1.0,
        fov_x=float(np.median(fields)),
        elevation=float(np.median(np.degrees(np.arcsin(np.clip(heights / np.maximum(distances, 1e-12), -1, 1))))),
        azimuth=azimuth % 360.0,
        sweep=sweep,
        aspect=float(np.median([camera.width / camera.height for camera in cameras])),
        longer_side=float(np.median([max(camera.width, camera.height) for camera in cameras])),
    )


def _vector(name: str, value: Vector) -> np.ndarray:
    """Return a caller's vector [3] as float64; a tensor may be on a GPU or need a gradient."""
    plain = value.tolist() if isinstance(value, Tensor) else value
    vector = np.asarray(plain, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name} must be 3 finite numbers, got {plain!r:.80}")
    return vector


def scaled_camera(camera: Camera, width: int, height: int) -> Camera:
    """Return a camera with the same view in an image of another size."""
    factors = camera.K.new_tensor([width / camera.width, height / camera.height, 1.0])
    return Camera(camera.viewmat, camera.K * factors[:, None], width, height)


def look_at(eye: Vector, target: Vector, up: Vector) -> Tensor:
    """Return the viewmat of a camera at ``eye`` that sees ``target`` at the image's centre and ``up`` upwards.

    Args:
        eye: [3] world.
        target: [3] world.
        up: [3] any length; replaced by another direction if it is parallel to the viewing direction.

    Returns:
        [4, 4] world-to-camera, OpenCV (x right, y down, z forward), float32.

    Raises:
        ValueError: an argument is not three finite numbers, or eye and target coincide.
    """
    eye, target, up = (_vector(name, value) for name, value in (("eye", eye), ("target", target), ("up", up)))
    if not np.linalg.norm(target - eye) > 0:
        raise ValueError("eye and target coincide; a camera must look somewhere")
    forward = _unit(target - eye)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6 * max(float(np.linalg.norm(up)), 1e-12):
        right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right = _unit(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return torch.from_numpy(viewmat).float()


def image_size(overview: Overview, size: int, step: int = 2) -> tuple[int, int]:
    """Return (width, height) in the training images' proportions: longer side ``size``, both multiples of ``step``,
    which is 2 for video."""
    width = size if overview.aspect >= 1 else size * overview.aspect
    height = size / overview.aspect if overview.aspect >= 1 else size
    return max(step, step * round(width / step)), max(step, step * round(height / step))


def orbit_camera(
    overview: Overview, azimuth: float, size: int, elevation: float | None = None, step: int = 2
) -> Camera:
    """Return a camera on the sphere around the scene's centre that looks at the centre.

    Args:
        overview: overview of the scene.
        azimuth: degrees, as ``Overview.azimuth``.
        size: longer side of the image in pixels.
        elevation: degrees, clamped to ``STEEPEST``. None: that of the training cameras.
        step: as for ``image_size``.

    Returns:
        A camera on the CPU with square pixels and the training cameras' field of view.
    """
    width, height = image_size(overview, size, step)
    elevation = overview.elevation if elevation is None else elevation
    tilt = math.radians(max(-STEEPEST, min(STEEPEST, elevation)))
    turn = math.radians(azimuth)
    centre, up = np.array(overview.centre), np.array(overview.up)
    zero, ninety = _horizon(up)
    aside = math.cos(turn) * zero + math.sin(turn) * ninety
    eye = centre + overview.radius * (math.cos(tilt) * aside + math.sin(tilt) * up)
    focal = width / (2 * math.tan(math.radians(overview.fov_x) / 2))
    rows = [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]
    K = torch.tensor(rows, dtype=torch.float32, device="cpu")
    return Camera(look_at(eye, centre, up), K, width, height)


def turntable(
    overview: Overview, frames: int, size: int, azimuths: tuple[float, float] | None = None, step: int = 2
) -> list[Camera]:
    """Return the cameras of a looping film that goes around the scene.

    If the training cameras surround the scene, the film is one turn of equal steps that starts at the first camera. If
    they cover only an arc (a forward-facing capture), the scene's back is unknown: the camera swings like a pendulum,
    from the middle of the arc to one side, to the other, and back, within ``SWING_SHARE`` of the arc.

    Args:
        overview: overview of the scene.
        frames: number of cameras.
        size: longer side of the images in pixels; the shorter follows the training images' proportions.
        azimuths: (first, last) in degrees, which replace this path: equal steps from the first, without the last.
        step: as for ``image_size``.

    Raises:
        ValueError: ``frames`` is less than 1.
    """
    if frames < 1:
        raise ValueError(f"frames is {frames}; it must be at least 1")
    phases = [frame / frames for frame in range(frames)]
    if azimuths is not None:
        first, last = azimuths
        angles = [first + (last - first) * phase for phase in phases]
    elif overview.sweep >= 360.0:
        angles = [overview.azimuth + 360.0 * phase for phase in phases]
    else:
        reach = SWING_SHARE * overview.sweep / 2
        angles = [overview.azimuth + reach * math.sin(2 * math.pi * phase) for phase in phases]
    return [orbit_camera(overview, angle, size, step=step) for angle in angles]
