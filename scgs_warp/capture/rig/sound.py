"""Sound tracks of videos, on the clock of the video's first frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...errors import UserError
from ...storage.files import for_ffmpeg
from ..source import main_pictures

RATE = 16_000
"""Samples per second at which sound is compared."""
MAX_SECONDS = 300.0
"""Length of the beginning of a sound track that is read."""
LEAST_SECONDS = 2.0
"""Least length of the sound before damage, or before the end of a copy that was cut off, for it to be used."""


class Sound(NamedTuple):
    """A mono sound track."""

    samples: np.ndarray
    """[S] float32 at ``RATE``."""
    start: float
    """Second of the first sample, counted from the video's first frame."""


def read_sound(path: Path) -> Sound | None:
    """Read the first ``MAX_SECONDS`` of a video's sound, or what precedes damage; return None if it has none.

    Raises:
        UserError: the file cannot be decoded.
    """
    import av
    from av.error import FFmpegError

    try:
        with av.open(for_ffmpeg(path)) as container:
            if not container.streams.audio:
                return None
            first_frame = _first_second(container)
            container.seek(0)
            pieces, start, length = [], None, 0
            resampler = av.AudioResampler(format="flt", layout="mono", rate=RATE)
            try:
                for frame in container.decode(audio=0):
                    if start is None:
                        start = float(frame.pts * frame.time_base) if frame.pts is not None else 0.0
                    fresh = [piece.to_ndarray()[0] for piece in resampler.resample(frame)]
                    pieces += fresh
                    length += sum(len(piece) for piece in fresh)
                    if length > MAX_SECONDS * RATE:
                        break
            except FFmpegError:  # The sound before the damage has no gaps, and it suffices.
                if length < LEAST_SECONDS * RATE:
                    raise
            pieces += [piece.to_ndarray()[0] for piece in resampler.resample(None)]
    except (FFmpegError, OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or type(error).__name__
        raise UserError(f"{path}: its sound does not decode ({reason}); give --offsets instead") from None
    samples = np.concatenate([np.zeros(0, np.float32), *pieces])
    if start is None or not len(samples):
        return None
    return Sound(np.where(np.isfinite(samples), samples, 0.0).astype(np.float32), start - first_frame)


def _first_second(container: Any) -> float:
    """Return the time of the first video frame on the container's clock."""
    if not container.streams.video:
        return 0.0
    for frame in container.decode(main_pictures(container)):
        return float(frame.time) if frame.time is not None else 0.0
    return 0.0
