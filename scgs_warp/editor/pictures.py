"""Pictures of the scene for pages that cannot draw it: cameras that pages send, and JPEGs."""

from __future__ import annotations

import io

import numpy as np
import torch
from PIL import Image

from ..edit import EditSession
from ..edit.field_reader import FieldReader
from ..types import Camera
from ..visualization.figures import to_bytes
from .model import Moment

MAX_SIDE = 2048
"""Longest side of a picture in pixels."""
QUALITY = 80


def camera_of(fields: FieldReader) -> Camera:
    """Read a camera as the page has it: ``viewmat``, ``K``, ``width`` and ``height``.

    Raises:
        UserError: naming the field.
    """
    width, height = (fields.integer(name, 0, 1, MAX_SIDE) for name in ("width", "height"))
    return Camera(_matrix(fields, "viewmat", 4), _matrix(fields, "K", 3), width, height)


def _matrix(fields: FieldReader, name: str, size: int) -> torch.Tensor:
    rows = fields.items(name, size)
    values = [FieldReader({"row": row}, "the page", name).vector("row", size) for row in rows]
    if len(values) != size or any(value is None for value in values):
        raise fields.wrong(name, "is no camera's matrix", f"give {size} rows of {size} numbers")
    return torch.tensor(values, dtype=torch.float32)


def scene_jpeg(session: EditSession, moment: Moment, camera: Camera) -> bytes:
    """Return a picture of the edited scene. Call it on the worker's thread."""
    background = session.edit.film.background
    view = camera.to(session.scene.device)
    image = session.render(view, moment.time, moment.at, background, live=moment.live)
    return _jpeg(to_bytes(image.rgb))


def _jpeg(rgb: np.ndarray) -> bytes:
    """Encode a picture [H, W, 3] uint8."""
    file = io.BytesIO()
    Image.fromarray(rgb).save(file, "JPEG", quality=QUALITY)
    return file.getvalue()
