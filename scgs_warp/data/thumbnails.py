"""What a few images of a data set show, coarsely: enough to notice that a run is given other images of equal names.

Thumbnails do not depend on the folder, nor on how the files are compressed, and decoders may differ a little.
"""

from __future__ import annotations

import torch

from ..errors import UserError
from .dataset import Dataset, spread

IMAGES, SIDE = 8, 8
"""Number of images, and width and height of their thumbnails in pixels."""


def thumbnails(data: Dataset) -> str:
    """Return the thumbnails of up to ``IMAGES`` frames, evenly spaced, as hexadecimal bytes; nothing if one of them is
    not finite or no longer readable."""
    content = bytearray()
    for index in spread(len(data), IMAGES):
        try:
            image = data[index].image
        except UserError:
            return ""
        if not image.isfinite().all():
            return ""
        small = torch.nn.functional.adaptive_avg_pool2d(image.permute(2, 0, 1), SIDE)
        content += bytes((small.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).flatten().tolist())
    return content.hex()
