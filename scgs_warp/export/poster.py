"""A picture of a scene as its page first shows it: the poster while the page loads, and that of a link to it."""

from __future__ import annotations

import io

from PIL import Image

from ..edit import EditSession
from ..edit.filming import film_camera
from ..geometry.cameras import orbit_camera
from ..scene.scene import Scene
from ..types import Camera
from ..types import Image as Picture
from ..visualization.figures import to_bytes

POSTER_SIZE, CARD_SIZE = 480, 1200
"""Longer side in pixels while the page loads, and where other sites show a link."""
QUALITY = 70


def opening_camera(scene: Scene, size: int) -> Camera:
    """Return the camera with which a page begins."""
    return orbit_camera(scene.overview, scene.overview.azimuth, size)


def poster(scene: Scene, size: int = POSTER_SIZE) -> bytes:
    """Return a JPEG of the scene at time 0 with the given longer side."""
    return _jpeg(scene.render(opening_camera(scene, size).to(scene.device), 0.0))


def edited_poster(session: EditSession, size: int = POSTER_SIZE) -> bytes:
    """Return a JPEG of the first frame of an edit's film."""
    camera = film_camera(session, 0.0, size).to(session.scene.device)
    return _jpeg(session.render(camera, session.scene_time(0.0), 0.0, session.edit.film.background))


def _jpeg(image: Picture) -> bytes:
    file = io.BytesIO()
    Image.fromarray(to_bytes(image.rgb)).save(file, "JPEG", quality=QUALITY, optimize=True)
    return file.getvalue()
