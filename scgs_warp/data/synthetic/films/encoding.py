"""Compressed films with sound (H.264 and AAC in .mp4), and their pictures as a decoder returns them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ....storage.files import for_ffmpeg
from .sound import SAMPLE_RATE


def write_film(path: Path, pictures: Sequence[np.ndarray], fps: float, crf: int, sound: np.ndarray | None) -> None:
    """Write pictures [H, W, 3] uint8 RGB of even width and height.

    Args:
        crf: x264's constant rate factor; phones are near 23.
        sound: mono at ``SAMPLE_RATE``, float32 in [-1, 1]; None: a film without sound.

    Raises:
        OSError: the file cannot be written.
    """
    import av
    from av.video.reformatter import ColorRange, Colorspace

    height, width = pictures[0].shape[:2]
    with av.open(for_ffmpeg(path), "w", format="mp4") as container:
        # One thread and no macroblock tree: the same pictures give the same bytes.
        options = {"crf": str(crf), "preset": "medium", "x264-params": "mbtree=0:threads=1"}
        video: Any = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000), options=options)
        video.width, video.height, video.pix_fmt = width, height, "yuv420p"
        # ffmpeg converts by this matrix unless told otherwise; without the tag, players take another for large films.
        video.codec_context.colorspace, video.codec_context.color_range = Colorspace.ITU601, ColorRange.MPEG
        audio: Any = None if sound is None else container.add_stream("aac", rate=SAMPLE_RATE, layout="mono")
        for picture in pictures:
            container.mux(video.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(video.encode())
        if audio is not None and sound is not None:
            frame = av.AudioFrame.from_ndarray(sound[None], format="fltp", layout="mono")
            frame.sample_rate, frame.pts, frame.time_base = SAMPLE_RATE, 0, Fraction(1, SAMPLE_RATE)
            resampler = av.AudioResampler("fltp", "mono", SAMPLE_RATE, frame_size=audio.frame_size or 1024)
            for piece in [*resampler.resample(frame), *resampler.resample(None)]:
                container.mux(audio.encode(piece))
            container.mux(audio.encode())


def decoded(path: Path) -> Iterator[np.ndarray]:
    """Yield the pictures [H, W, 3] uint8 RGB of a film."""
    import av

    with av.open(for_ffmpeg(path)) as container:
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="rgb24")
