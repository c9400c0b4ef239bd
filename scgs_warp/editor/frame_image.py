"""Rendering of one client's picture, with depth for the overlays that the browser draws."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from ..edit import EditSession
from ..types import Image
from ..visualization.figures import to_bytes
from .model import Moment
from .views import ClientCamera

QUALITY, FINE_QUALITY = 75, 90
"""JPEG qualities: while something moves, and while all is still."""


class Picture(NamedTuple):
    rgb: np.ndarray
    """[H, W, 3] uint8"""
    depth: np.ndarray
    """[H, W] float32 along the optical axis, world units; infinite for the background."""


def take_picture(session: EditSession, moment: Moment, camera: ClientCamera, size: int) -> Picture:
    """Render a client's picture.

    Args:
        size: longer side in pixels.
    """
    if moment.show == "side by side":
        halves = [_image(session, moment, camera, size, 0.5, edited) for edited in (False, True)]
        rgb = np.concatenate([half.rgb for half in halves], 1)
        return Picture(_line(rgb), np.concatenate([half.depth for half in halves], 1))
    if moment.show == "split":
        first, second = (_image(session, moment, camera, size, 1.0, edited) for edited in (False, True))
        middle = first.rgb.shape[1] // 2
        rgb = np.concatenate([first.rgb[:, :middle], second.rgb[:, middle:]], 1)
        return Picture(_line(rgb), np.concatenate([first.depth[:, :middle], second.depth[:, middle:]], 1))
    return _image(session, moment, camera, size, 1.0, moment.show != "original")


def _image(
    session: EditSession, moment: Moment, camera: ClientCamera, size: int, share: float, edited: bool
) -> Picture:
    view = camera.at_size(size, share).to(session.scene.device)
    if edited:
        image = session.render(view, moment.time, moment.at, live=moment.live)
    else:
        image = session.scene.render(view, moment.time)
    return Picture(to_bytes(image.rgb), _depth(image))


def _depth(image: Image) -> np.ndarray:
    solid = image.alpha >= 0.5
    depth = torch.where(solid, image.depth, torch.full_like(image.depth, torch.inf))
    return depth.nan_to_num(torch.inf, torch.inf).float().cpu().numpy()


def _line(rgb: np.ndarray) -> np.ndarray:
    """Draw a grey line between the halves."""
    rgb[:, rgb.shape[1] // 2] = 128
    return rgb
