"""Animated WebP, which ffmpeg's libraries do not decode."""

from __future__ import annotations

import math
import struct
from collections.abc import Container, Iterator
from pathlib import Path

import numpy as np

from ..data.images import oversized_claim
from ..errors import UserError
from ..storage.files import open_regular
from . import cut_out
from .completeness import Incomplete
from .digests import digest
from .source_frame import SourceFrame

HEAD = 21
"""Number of bytes by which an animation is recognised."""
ANIMATED = 0x02
"""Flag in the last of them."""


def is_animation(path: Path) -> bool:
    """Return whether a file is an animated WebP."""
    try:
        with open_regular(path) as file:
            head = file.read(HEAD)
    except OSError:
        return False
    return len(head) == HEAD and head[:4] == b"RIFF" and head[8:16] == b"WEBPVP8X" and bool(head[20] & ANIMATED)


class Animation:
    """An animated WebP as a film."""

    video = True
    incomplete: Incomplete | None = None

    def __init__(self, path: Path) -> None:
        """
        Raises:
            UserError: the file does not decode.
        """
        self.path = path
        moments = [seconds for _, seconds in self._moments()]
        self.count = len(moments)
        self.rate = (self.count - 1) / moments[-1] if moments[-1] > 0 else math.inf

    def _moments(self) -> Iterator[tuple[np.ndarray, float]]:
        """Yield the pictures [H, W, 4] and their times in seconds."""
        from PIL import Image

        seconds = 0.0
        try:
            with open_regular(self.path) as file:
                claim = oversized_claim(file.read())
                if claim is not None:
                    raise UserError(f"{self.path}: says it is {claim}; save it again, smaller")
                with Image.open(file, formats=("WEBP",)) as image:
                    for index in range(getattr(image, "n_frames", 1)):
                        image.seek(index)
                        yield np.asarray(image.convert("RGBA")), seconds
                        seconds += float(image.info.get("duration", 0)) / 1000.0
        except (OSError, ValueError, SyntaxError, EOFError, struct.error, Image.DecompressionBombError):
            raise UserError(
                f"{self.path}: is not an animation that decodes; save it as .mp4, or give a folder of images"
            ) from None

    def frames(self, longest: int, wanted: Container[int] | None = None) -> Iterator[SourceFrame]:
        """Yield all frames in order, or only the ``wanted`` ones by their index."""
        for index, (pixels, seconds) in enumerate(self._moments()):
            if wanted is None or index in wanted:
                image, alpha = cut_out.reduced(*cut_out.split(pixels), longest)
                yield SourceFrame(index, seconds, image, "", alpha)

    def digest(self, earlier: bool = False) -> str:
        """Return a hash that identifies the source; earlier versions took none."""
        return digest([self.path])
