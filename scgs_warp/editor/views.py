"""Schedule of the clients' pictures and their sizes. Only the newest state of a client is drawn; nothing queues up."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ..edit.rotations import to_matrix
from ..types import Camera

STILL = 0.25
"""Seconds without a change after which a picture is drawn at full size."""
LOW, FULL = "low", "full"
MIN_SIZE = 96


@dataclass(frozen=True)
class ClientCamera:
    """Camera of a browser: OpenCV pose, vertical field of view in radians, canvas in pixels."""

    wxyz: tuple[float, ...]
    position: tuple[float, ...]
    fov: float
    width: int
    height: int

    @property
    def usable(self) -> bool:
        """True if a picture can be drawn: a hidden window has no size, and a page may send anything."""
        numbers = (*self.wxyz, *self.position, self.fov)
        return all(map(math.isfinite, numbers)) and any(self.wxyz) and self.width > 0 and self.height > 0

    def at_size(self, size: int, share: float = 1.0) -> Camera:
        """Return a camera of the renderer, on the CPU.

        Args:
            size: longer side of the whole canvas in pixels.
            share: share of the canvas' width to draw; the vertical field of view stays.
        """
        scale = size / max(self.width, self.height)
        height = max(1, round(self.height * scale))
        width = max(1, round(self.width * scale * share))
        focal = height / (2 * math.tan(min(max(self.fov, 1e-3), 3.1) / 2))
        K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
        quat = np.array(self.wxyz, np.float64)
        rotation = to_matrix(quat / np.linalg.norm(quat)).T
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ np.array(self.position, np.float64)
        return Camera(torch.from_numpy(viewmat).float(), K, width, height)


@dataclass
class _ClientState:
    camera: ClientCamera
    changed: float
    """Time of the latest change that needs another picture."""
    drawn: float = -math.inf
    state: Any = None
    """(version, camera) of the latest picture."""
    quality: str = ""


class PictureSchedule:
    """Schedule that decides whose picture is drawn next. Not thread safe: the worker's lock guards it."""

    def __init__(self) -> None:
        self._clients: dict[int, _ClientState] = {}
        self._version = 0

    def __len__(self) -> int:
        return len(self._clients)

    def move(self, client: int, camera: ClientCamera, now: float) -> None:
        """Register a client's camera, new or changed."""
        view = self._clients.get(client)
        if view is None:
            self._clients[client] = _ClientState(camera, now)
        elif view.camera != camera:
            view.camera, view.changed = camera, now

    def drop(self, client: int) -> None:
        self._clients.pop(client, None)

    def change(self, now: float) -> None:
        """Register a change of the scene, which all clients see."""
        self._version += 1
        for view in self._clients.values():
            view.changed = now

    def camera(self, client: int) -> ClientCamera | None:
        view = self._clients.get(client)
        return None if view is None else view.camera

    def _wants(self, view: _ClientState, now: float, busy: bool) -> str | None:
        if not view.camera.usable:
            return None
        still = not busy and now - view.changed >= STILL
        if view.state != (self._version, view.camera):
            return FULL if still else LOW
        return FULL if still and view.quality == LOW else None

    def next(self, now: float, busy: bool) -> tuple[int, str] | None:
        """Return (client, quality) of the picture that is due, for the client that has waited longest. The picture
        counts as drawn from now on, so that changes during its drawing request another."""
        due = [(view.drawn, client) for client, view in self._clients.items() if self._wants(view, now, busy)]
        if not due:
            return None
        client = min(due)[1]
        view = self._clients[client]
        quality = self._wants(view, now, busy) or LOW
        view.drawn, view.state, view.quality = now, (self._version, view.camera), quality
        return client, quality

    def settled(self, now: float, busy: bool) -> bool:
        """Return whether every visible client has its latest picture at full size."""
        return all(self._wants(view, now, busy) is None and view.quality == FULL for view in self._seen())

    def _seen(self) -> list[_ClientState]:
        return [view for view in self._clients.values() if view.camera.usable]

    def wait(self, now: float, busy: bool) -> float | None:
        """Return the seconds until the next picture is due without further changes; None: never."""
        rough = [view for view in self._seen() if view.quality == LOW]
        if not rough or busy:
            return None
        return max(0.005, min(view.changed + STILL - now for view in rough))


class Pace:
    """Control of the size of pictures, so that drawing one takes a target time.

    Args:
        seconds: target time of a picture.
        size: initial longer side in pixels.
        limit: largest longer side in pixels.
    """

    def __init__(self, seconds: float, size: int, limit: int) -> None:
        self.seconds, self.limit = seconds, limit
        self._size = float(size)

    @property
    def size(self) -> int:
        return max(MIN_SIZE, min(self.limit, 16 * round(self._size / 16)))

    def took(self, seconds: float) -> None:
        """Adapt to the time that a picture of the present size took, by at most 20 percent."""
        change = math.sqrt(self.seconds / max(seconds, 1e-4))
        self._size = min(max(self._size * min(max(change, 0.8), 1.2), MIN_SIZE), self.limit)
