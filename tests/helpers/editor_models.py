"""Models for tests of the editor: a bar, and a browser that shows it."""

from __future__ import annotations

import functools
import math

from helpers.edit_scenes import bar_scene
from scgs_warp.edit import EditSession
from scgs_warp.edit.rotations import from_matrix
from scgs_warp.editor.model import EditorModel
from scgs_warp.editor.views import ClientCamera
from scgs_warp.geometry.cameras import orbit_camera

LEFT, RIGHT = (-0.1, -1.0, 0.25), (1.1, -1.0, 0.25)


@functools.cache
def loaded() -> EditSession:
    return EditSession(bar_scene(gaussians=1500))


def new_model() -> EditorModel:
    """Return the editor's initial model, without automatic pins around handles."""
    made = EditorModel(loaded().fork())
    made.pin_rings = None
    return made


def chosen(model: EditorModel, point=RIGHT, rings: int = 1) -> tuple[int, ...]:
    return model.session.ring([model.session.nearest(point, model.time)], rings)


def client(session: EditSession, azimuth: float = 40.0, size: int = 96) -> ClientCamera:
    """Return a browser client with the view of the film's camera."""
    camera = orbit_camera(session.scene.overview, azimuth, size)
    wxyz = from_matrix(camera.viewmat[:3, :3].double().numpy().T)
    fov = 2 * math.atan(camera.height / (2 * float(camera.K[1, 1])))
    return ClientCamera(tuple(wxyz.tolist()), tuple(camera.position.tolist()), fov, camera.width, camera.height)


def canvas_camera(x: float = 0.0, width: int = 100) -> ClientCamera:
    """A browser of 100 x 50 pixels in front of the origin."""
    return ClientCamera((1.0, 0.0, 0.0, 0.0), (x, 0.0, -4.0), 0.7, width, 50)
