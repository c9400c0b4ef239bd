"""Conversion of a client's view to a view of the film's camera."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from ..edit import EditSession, View
from ..errors import UserError
from ..geometry.cameras import STEEPEST, azimuth_of
from .views import ClientCamera


def view_of(session: EditSession, camera: ClientCamera) -> View:
    """Return the film camera's view that shows what a client sees. Its target is the point on the client's optical axis
    nearest to the scene's centre; the camera stays upright.

    Raises:
        UserError: the client looks from too steeply above or below.
    """
    overview = session.scene.overview
    seen = camera.at_size(64)
    viewmat = seen.viewmat.double().numpy()
    eye, forward = -viewmat[:3, :3].T @ viewmat[:3, 3], viewmat[2, :3]
    centre, up = np.array(overview.centre), np.array(overview.up)
    distance = max(float((centre - eye) @ forward), 0.05 * overview.radius)
    elevation = math.degrees(math.asin(float(np.clip(-forward @ up, -1.0, 1.0))))
    if abs(elevation) > STEEPEST:
        raise UserError(f"a film's camera tilts by {STEEPEST:g} degrees at most; look from the side")
    target = eye + distance * forward
    azimuth = azimuth_of(dataclasses.replace(overview, centre=tuple(target.tolist())), eye)
    return View(0.0, azimuth, elevation, distance, tuple(target.tolist()))
