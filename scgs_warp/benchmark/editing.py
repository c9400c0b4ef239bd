"""What a user of the editor waits for: from a drag of a handle to the new picture, ready to be sent."""

from __future__ import annotations

import math
import sys
from typing import Any

import cv2
import numpy as np

from ..edit import EditSession, Target, engine
from ..edit.handles import STAY
from ..edit.rotations import from_matrix
from ..editor import frame_image
from ..editor.frame_image import QUALITY, Picture, take_picture
from ..editor.model import EditorModel
from ..editor.views import ClientCamera
from ..ops.sampling import farthest_points
from ..rendering import render
from ..types import Camera
from .plan import Place
from .scenes import scene_camera
from .workloads import draw_stages

HANDLES = 3
STEP = 0.25
"""How far a handle goes from one picture to the next, in edges of the graph."""


def edit_rows(place: Place) -> list[dict[str, Any]]:
    """A drag of one of three handles at the scene's far ends, nothing pinned: every Gaussian moves and turns."""
    session = EditSession(place.scene)
    model = EditorModel(session)
    model.pin_rings = None
    hold(model)
    client = client_of(scene_camera(place.scene, place.plan.size))
    reach = STEP * session.graph.edge_length / session.engine.units[1]

    def drag(index: int) -> None:
        along = reach * index
        model.drag(Target((0.0, 4 * reach * math.sin(along / (4 * reach)), 0.0)))
        encode(take_picture(session, model.moment(), client, max(client.width, client.height)))

    targets = {
        "solve": [(session.engine, "bend_live")],
        "skin": [(engine, "pose_gaussians")],
        **draw_stages(render),
        "bytes": [(frame_image, "to_bytes"), (frame_image, "_depth")],
        "encode": [(sys.modules[__name__], "encode")],
    }
    return place.rows("edit/drag", drag, targets)


def hold(model: EditorModel) -> None:
    """Three handles, far from each other; the first one is in hand."""
    session = model.session
    points = session.scene.gaussians.means.new_tensor(session.node_positions(0.0))
    ends = farthest_points(points, min(HANDLES, len(points))).tolist()
    for end in reversed(ends):
        model.select(session.ring([end], 1))
        model.grab(STAY)
        model.drag(STAY)  # what was not moved would be let go of
        model.release()
    model.grab(STAY)


def client_of(camera: Camera) -> ClientCamera:
    """A browser that sees what a camera does."""
    wxyz = from_matrix(camera.viewmat[:3, :3].double().cpu().numpy().T)
    fov = 2 * math.atan(camera.height / (2 * float(camera.K[1, 1])))
    return ClientCamera(tuple(wxyz.tolist()), tuple(camera.position.tolist()), fov, camera.width, camera.height)


def encode(shown: Picture) -> int:
    """As the editor's server does while something moves: JPEG, and depth as three bytes of a PNG; bytes."""
    image = cv2.imencode(".jpg", shown.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
    fixed = np.clip(shown.depth * 1e5, 0, 2**24 - 1).astype(np.uint32)[..., None].view(np.uint8)
    return len(image) + len(cv2.imencode(".png", np.ascontiguousarray(fixed[..., :3]))[1])
