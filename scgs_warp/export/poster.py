"""A picture of a scene as its page first shows it: the poster while the page loads, and that of a link to it."""

from __future__ import annotations

import io

from PIL import Image

from ..geometry.cameras import orbit_camera
from ..scene.scene import Scene
from ..types import Camera
from ..visualization.figures import to_bytes

POSTER_SIZE, CARD_SIZE = 480, 1200
"""Longer side in pixels while the page loads, and where other sites show a link."""
QUALITY = 70


def opening_camera(scene: Scene, size: int) -> Camera:
    """Return the camera with which a page begins."""
    return orbit_camera(scene.overview, scene.overview.azimuth, size)


def poster(scene: Scene, size: int = POSTER_SIZE) -> bytes:
    """Return a JPEG of the scene at time 0 with the given longer side."""
    image = scene.render(opening_camera(scene, size).to(scene.device), 0.0)
    file = io.BytesIO()
    Image.fromarray(to_bytes(image.rgb)).save(file, "JPEG", quality=QUALITY, optimize=True)
    return file.getvalue()
