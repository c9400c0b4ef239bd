"""Benchmark of the editor: from a drag of a handle to the new picture, ready to be sent."""

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
from .plan import BenchCase
from .scenes import scene_camera
from .workloads import draw_stages

HANDLES = 3
STEP = 0.25
"""Motion of a handle from one picture to the next, in edge lengths of the graph."""


def edit_rows(case: BenchCase) -> list[dict[str, Any]]:
    """Measure drags of one of three handles at the scene's far ends; nothing is pinned, so every Gaussian moves."""
    session = EditSession(case.scene)
    model = EditorModel(session)
    model.pin_rings = None
    hold(model)
    client = client_of(scene_camera(case.scene, case.plan.size))
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
    return case.rows("edit/drag", drag, targets)


def hold(model: EditorModel) -> None:
    """Set three handles far from each other, and grab the first one."""
    session = model.session
    points = session.scene.gaussians.means.new_tensor(session.node_positions(0.0))
    ends = farthest_points(points, min(HANDLES, len(points))).tolist()
    for end in reversed(ends):
        model.select(session.ring([end], 1))
        model.grab(STAY)
        model.drag(STAY)  # A handle that never moved would be dropped.
        model.release()
    model.grab(STAY)


def client_of(camera: Camera) -> ClientCamera:
    """Return the view of a browser that sees what ``camera`` sees."""
    wxyz = from_matrix(camera.viewmat[:3, :3].double().cpu().numpy().T)
    fov = 2 * math.atan(camera.height / (2 * float(camera.K[1, 1])))
    return ClientCamera(tuple(wxyz.tolist()), tuple(camera.position.tolist()), fov, camera.width, camera.height)


def encode(shown: Picture) -> int:
    """Encode a picture as the editor does during motion (JPEG; depth as three bytes of a PNG); return its bytes."""
    image = cv2.imencode(".jpg", shown.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
    fixed = np.clip(shown.depth * 1e5, 0, 2**24 - 1).astype(np.uint32)[..., None].view(np.uint8)
    return len(image) + len(cv2.imencode(".png", np.ascontiguousarray(fixed[..., :3]))[1])
