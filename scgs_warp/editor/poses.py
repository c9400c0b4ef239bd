"""Poses of control points as the page draws them, and messages that carry them."""

from __future__ import annotations

import struct
from collections.abc import Mapping

import numpy as np

from ..edit import EditSession
from ..edit.rotations import rotate, to_matrix, unit
from ..export.page_edit import edited_pose
from .model import Moment

WIDTH, LAYERED_WIDTH = 28, 44
"""Numbers of a control point's pose, without and with a motion mask; ``web/data.js`` names them."""
HEADER = struct.Struct("<4i")
"""Kind of the message, version of the edit, frame of the film (-1: the moment of a drag), reserved."""
POSE, PICTURE = 1, 2
"""Kinds of messages."""


def pose_table(session: EditSession, moment: Moment) -> np.ndarray:
    """Return the poses of all control points at a moment, [M, 28 or 44] float32, normalised units. Call it on the
    worker's thread."""
    pose = edited_pose(session, min(max(moment.time, 0.0), 1.0), moment.at, live=moment.live)
    return _table(pose, session.engine.rig.positions.detach().cpu().double().numpy())


def _table(pose: Mapping[str, np.ndarray], rest: np.ndarray) -> np.ndarray:
    """Put the poses of control points at ``rest`` [M, 3] into one table."""
    rotation = unit(pose["rotation"])
    layered = "further" in pose
    table = np.zeros((len(rest), LAYERED_WIDTH if layered else WIDTH))
    table[:, :12] = _maps(rotation, rest, pose["translation"])
    table[:, 12:16] = unit(pose.get("shape", rotation))
    extra = pose.get("log_scale", pose.get("tint"))
    if extra is not None:
        table[:, 16:19] = extra
    table[:, 20:24] = unit(pose["own"])
    table[:, 24:28] = unit(pose["turn"])
    if layered:
        table[:, 40:44] = further = unit(pose["further"])
        table[:, 28:40] = _maps(further, rest + pose["translation"], pose["shift"])
    return table.astype(np.float32)


def _maps(rotation: np.ndarray, points: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Return maps [M, 12], by rows, that turn by ``rotation`` [M, 4] about ``points`` [M, 3], then shift."""
    rows = np.zeros((len(points), 3, 4))
    rows[:, :, :3] = to_matrix(rotation)
    rows[:, :, 3] = points + shifts - rotate(rotation, points)
    return rows.reshape(-1, 12)


def pose_message(table: np.ndarray, version: int, frame: int) -> bytes:
    """Return the message of a pose."""
    return HEADER.pack(POSE, version, frame, 0) + np.ascontiguousarray(table, "<f4").tobytes()


def picture_message(jpeg: bytes, version: int) -> bytes:
    """Return the message of a picture, for pages without WebGL."""
    return HEADER.pack(PICTURE, version, -1, 0) + jpeg
