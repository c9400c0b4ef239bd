"""Framing of the subject: the distance from which a film shows all of it, from all sides and at all times."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
import torch

from ..errors import UserError
from ..geometry.cameras import Overview, orbit_camera, turntable
from ..scene.scene import Scene

MOMENTS = 9
"""Number of times at which the subject is measured."""
SIDES = 24
"""Number of azimuths from which the subject must fit into the picture."""
OPAQUE = 0.3
"""Opacity from which a Gaussian counts as part of the subject."""
SIGMAS = 1.5
"""Standard deviations of a Gaussian that must be in the picture."""
STRAYS = 0.002
"""Share of the Gaussians at each end of each axis that may lie outside."""
MARGIN = 1.08
"""Ratio of the half width of the picture to that of the subject."""
EDGE_ALPHA = 0.5
"""Mean alpha on the edge of the picture below which a scene counts as a cut-out subject."""
SMALL = 96
"""Longer side in pixels of the pictures that tell a cut-out subject from a filled scene."""


def is_cut_out(scene: Scene) -> bool:
    """Return whether the pictures of a scene show a subject in front of nothing."""
    alphas = []
    for azimuth in (0.0, 90.0) if scene.overview.sweep >= 360.0 else (0.0,):
        camera = orbit_camera(scene.overview, scene.overview.azimuth + azimuth, SMALL)
        alpha = scene.render(camera, 0.5).alpha
        alphas.append(torch.cat([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]]).mean())
    return float(torch.stack(alphas).mean()) < EDGE_ALPHA


def subject_points(scene: Scene) -> tuple[np.ndarray, float]:
    """Return the means [P, 3] of the opaque Gaussians at ``MOMENTS`` times, without strays, and how far a Gaussian
    reaches beyond its mean, both in world units.

    Raises:
        UserError: no Gaussian is opaque.
    """
    moments, reaches = [], []
    for time in np.linspace(0.0, 1.0, MOMENTS):
        gaussians = scene.gaussians_at(float(time))
        opaque = gaussians.opacities >= OPAQUE
        means = gaussians.means[opaque].double().cpu().numpy()
        if len(means):
            reaches.append(SIGMAS * float(gaussians.scales[opaque].amax(dim=1).quantile(0.9)))
            # Quantiles of few points would lie between them, and exclude all.
            strays = STRAYS if STRAYS * len(means) >= 1.0 else 0.0
            low, high = np.quantile(means, strays, axis=0), np.quantile(means, 1.0 - strays, axis=0)
            inside = means[((means >= low) & (means <= high)).all(axis=1)]
            moments.append(inside if len(inside) else means)
    if not moments:
        raise UserError("--frame subject: the scene has no opaque Gaussians; use --frame cameras")
    return np.concatenate(moments), max(reaches)


def frame_subject(scene: Scene) -> Overview:
    """Return the scene's overview, aimed at the middle of the subject and from so far that it stays in the picture on
    the whole turntable, at all times.

    Raises:
        UserError: the scene has no opaque Gaussians.
    """
    points, reach = subject_points(scene)
    overview = scene.overview
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    aimed = replace(overview, centre=tuple(map(float, centre)), radius=max(overview.radius, 1e-6))
    return replace(aimed, radius=max(distance_to_fit(aimed, points, reach), 1e-6))


def framed(scene: Scene) -> Overview:
    """Return the overview from which films show a scene: aimed at the subject if it is cut out and opaque, otherwise
    that of the training cameras."""
    with suppress(UserError):
        if is_cut_out(scene):
            return frame_subject(scene)
    return scene.overview


def distance_to_fit(overview: Overview, points: np.ndarray, reach: float = 0.0) -> float:
    """Return the distance from the centre at which spheres of radius ``reach`` around ``points`` [P, 3] project into
    the picture, from every azimuth of the turntable."""
    centre, needed = np.array(overview.centre), 0.0
    for camera in turntable(overview, SIDES, SMALL):
        local = (points - centre) @ camera.viewmat[:3, :3].double().numpy().T
        across = float(camera.K[0, 0]) / (0.5 * camera.width), float(camera.K[1, 1]) / (0.5 * camera.height)
        # A point at distance D of the centre has the depth D + z, and is inside where |x| f / (w / 2) <= D + z.
        for axis, focal in enumerate(across):
            aside = np.abs(local[:, axis]) + reach
            needed = max(needed, float((MARGIN * focal * aside - local[:, 2]).max()))
    return needed


def aim(overview: Overview, target: Sequence[float] | None, zoom: float) -> Overview:
    """Return the overview with another target and a longer focal length.

    Args:
        target: point to look at, world units; the distance stays. None: the present one.
        zoom: factor on the focal length; 2 shows half as much, twice as large.

    Raises:
        UserError: a number is out of range.
    """
    if not (math.isfinite(zoom) and 0.01 <= zoom <= 100):
        raise UserError(f"--zoom {zoom:g}: give 0.01 to 100; 2 shows half as much, twice as large")
    if target is not None and not all(math.isfinite(value) and abs(value) < 1e9 for value in target):
        raise UserError("--target: give three finite numbers, world units")
    fov = 2.0 * math.degrees(math.atan(math.tan(math.radians(overview.fov_x) / 2.0) / zoom))
    aimed = overview if target is None else replace(overview, centre=tuple(map(float, target)))
    return replace(aimed, fov_x=fov)
