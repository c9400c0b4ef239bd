"""Views of a scene's surface, in normalised units: where cameras stand, and what they see."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...geometry.cameras import SWING_SHARE, Overview, image_size, look_at, orbit_camera
from ...ops.binning import bin_splats
from ...ops.compositing import composite
from ...ops.harmonics import MAX_DEGREE, spherical_harmonics
from ...ops.projection import project
from ...ops.surface_depth import surface_depth
from ...rendering.render import draw
from ...scene.scene import Scene
from ...types import Camera, Gaussians, Splats, Tiles

LEVEL = 0.5
"""Opacity that a ray has accumulated where it meets the surface."""
LOW_PASS = 0.3
"""Variance in square pixels that training adds to splats (the ``eps2d`` of projection)."""
USUAL_SIZE = 800
"""Longer side in pixels of the training images where it is not known."""
BORDER_SIZE, BORDER_VIEWS, BORDER_SHARE = 64, 8, 0.2
"""Size and number of the images that tell whether a scene is a single subject, and the share of their borders' pixels
that surroundings cover at least."""
NEAREST = 1.15
"""Smallest distance of a camera from the centre of a subject, in radii of the subject."""
TILTS = (-12.0, 0.0, 12.0)
"""Elevations of the views of a scene with surroundings, relative to the training cameras' median, in degrees."""
GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True)
class Surroundings:
    """How a scene was filmed, in normalised units."""

    overview: Overview
    closed: bool
    """True for a subject in front of nothing, seen from all around: its surface is closed. Else the scene goes on
    beyond what the cameras saw."""
    focal: float
    """Focal length of the training images in pixels."""
    antialiased: bool

    def low_pass(self, camera: Camera) -> float:
        """Return the variance, in pixels of the camera, that training added to splats in pixels of its images."""
        return LOW_PASS * (float(camera.K[0, 0]) / self.focal) ** 2


def surroundings_of(scene: Scene, gaussians: Gaussians) -> Surroundings:
    """Tell how a scene was filmed.

    Args:
        gaussians: posed, in normalised units.
    """
    world, unit = scene.overview, scene.normalisation
    x, y, z = ((np.array(world.centre) - unit.centre) * unit.scale).tolist()
    overview = replace(world, centre=(x, y, z), radius=world.radius * unit.scale)
    size = round(overview.longer_side) or USUAL_SIZE
    focal = image_size(overview, size)[0] / (2.0 * math.tan(math.radians(overview.fov_x) / 2.0))
    found = Surroundings(overview, True, focal, scene.config.antialiased)
    return replace(found, closed=overview.sweep >= 360.0 and _covered_border(found, gaussians) < BORDER_SHARE)


def _covered_border(surroundings: Surroundings, gaussians: Gaussians) -> float:
    """Return the share of opaque pixels on the borders of images like those of the training."""
    overview, covered = surroundings.overview, []
    for index in range(BORDER_VIEWS):
        camera = orbit_camera(overview, overview.azimuth + 360.0 * index / BORDER_VIEWS, BORDER_SIZE)
        _, alpha = draw(gaussians, camera.to(gaussians.means.device), antialiased=surroundings.antialiased)
        covered += [alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]]
    return float((torch.cat(covered) > LEVEL).float().mean())


def cameras_around(
    surroundings: Surroundings, centre: np.ndarray, radius: float, count: int, size: int
) -> list[Camera]:
    """Return cameras from which the ball around ``centre`` [3] is seen.

    For a closed subject, they are spread evenly over all directions and show the ball as large as their images allow,
    from the distance of the training cameras. Otherwise they stand where the training cameras stood.

    Args:
        size: longer side of the images in pixels.
    """
    overview = surroundings.overview
    if not surroundings.closed:
        tilts = [overview.elevation + TILTS[index % len(TILTS)] for index in range(count)]
        arc = 360.0 if overview.sweep >= 360.0 else SWING_SHARE * overview.sweep
        azimuths = [overview.azimuth + arc * ((GOLDEN * index) % 1.0 - 0.5) for index in range(count)]
        return [orbit_camera(overview, azimuth, size, tilt) for azimuth, tilt in zip(azimuths, tilts)]
    distance = max(overview.radius, NEAREST * radius)
    focal = size / (2.0 * math.tan(math.asin(min(radius / distance, 0.99))))
    K = torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    eyes = centre + distance * _directions(count, np.array(overview.up))
    return [Camera(look_at(eye, centre, overview.up), K, size, size) for eye in eyes]


def _directions(count: int, up: np.ndarray) -> np.ndarray:
    """Return unit vectors [count, 3] spread evenly over the sphere, on a spiral about ``up``."""
    turn = 2.0 * math.pi * ((GOLDEN * np.arange(count)) % 1.0)
    rise = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    flat = np.sqrt(1.0 - rise * rise)
    helper = np.eye(3)[np.abs(up).argmin()]
    side = np.cross(up, helper)
    side /= np.linalg.norm(side)
    axes = np.stack([side, np.cross(up, side), up])
    return np.column_stack([flat * np.cos(turn), flat * np.sin(turn), rise]) @ axes


class Sight(NamedTuple):
    """What a camera sees."""

    depth: Tensor
    """[H, W] camera z of the surface; 0 where there is none."""
    rgb: Tensor
    """[H, W, 3] colours without background."""
    alpha: Tensor
    """[H, W]"""


def depth_of(surroundings: Surroundings, gaussians: Gaussians, camera: Camera) -> Tensor:
    """Return the depth [H, W] of the surface that a camera sees; 0 where it sees none."""
    camera = camera.to(gaussians.means.device)
    splats, tiles = _splats(surroundings, gaussians, camera)
    return surface_depth(gaussians, splats, tiles, camera, LEVEL)


@torch.no_grad()
def sight_of(surroundings: Surroundings, gaussians: Gaussians, camera: Camera) -> Sight:
    """Return the depth and the colours of what a camera sees."""
    camera = camera.to(gaussians.means.device)
    splats, tiles = _splats(surroundings, gaussians, camera)
    degree = min(math.isqrt(gaussians.sh_rest.shape[1] + 1) - 1, MAX_DEGREE)
    harmonics = gaussians.sh_dc, gaussians.sh_rest, gaussians.means
    image, alpha = composite(splats, spherical_harmonics(*harmonics, camera.position, degree), tiles)
    rgb = image.permute(1, 2, 0) / alpha.clamp_min(1e-6)[..., None]
    return Sight(surface_depth(gaussians, splats, tiles, camera, LEVEL), rgb, alpha)


@torch.no_grad()
def _splats(surroundings: Surroundings, gaussians: Gaussians, camera: Camera) -> tuple[Splats, Tiles]:
    shapes = gaussians.quats, gaussians.scales, gaussians.opacities
    splats = project(
        gaussians.means, *shapes, camera.viewmat, camera.K, camera.width, camera.height,
        eps2d=surroundings.low_pass(camera), antialiased=surroundings.antialiased, sharpness=gaussians.sharpness,
    )  # fmt: skip
    return splats, bin_splats(splats)


def points_of(depth: Tensor, camera: Camera) -> np.ndarray:
    """Return the points [P, 3] of a depth image at which it shows a surface, float64."""
    depths = depth.cpu().double().numpy()
    y, x = np.nonzero(depths)
    z = depths[y, x]
    K, viewmat = camera.K.cpu().double().numpy(), camera.viewmat.cpu().double().numpy()
    local = np.column_stack([z * (x + 0.5 - K[0, 2]) / K[0, 0], z * (y + 0.5 - K[1, 2]) / K[1, 1], z])
    return (local - viewmat[:3, 3]) @ viewmat[:3, :3]
