"""Films of high dynamic range show the colours that they were made of."""

from __future__ import annotations

import av
import numpy as np
import pytest

from scgs_warp.capture.high_dynamic_range import HLG, PQ, to_standard
from scgs_warp.capture.source import Video

COLORS = np.array([[40, 40, 40], [128, 128, 128], [200, 60, 40], [30, 160, 70], [50, 60, 190], [180, 170, 60]])
"""sRGB, all below the highlights."""


def linear(colors):
    x = colors / 255.0
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def signal(colors, transfer):
    """What a camera records of sRGB colours [N, 3], of which white is paper, as [N, 3] of 0 to 1."""
    light = linear(colors) @ np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]]).T
    if transfer == PQ:
        power = (light * 203.0 / 10_000.0) ** 0.1593017578125
        return ((0.8359375 + 18.8515625 * power) / (1.0 + 18.6875 * power)) ** 78.84375
    shown = light * 0.203
    luminance = shown @ [0.2627, 0.6780, 0.0593]
    scene = shown * luminance[:, None] ** (1.0 / 1.2 - 1.0)
    bright = 0.17883277 * np.log(np.maximum(12.0 * scene - 0.28466892, 1e-3)) + 0.55991073
    return np.where(scene <= 1 / 12, np.sqrt(3.0 * scene), bright)


@pytest.mark.parametrize("transfer", [HLG, PQ])
def test_colours_are_those_of_the_scene(tmp_path, transfer):
    picture = np.rint(65535 * signal(COLORS, transfer)).astype(np.uint16)[None].repeat(16, 0).repeat(8, 1)
    with av.open(str(tmp_path / "film.mkv"), "w") as out:
        stream = out.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = picture.shape[1], picture.shape[0], "gbrp16le"
        stream.codec_context.color_trc, stream.codec_context.color_primaries = transfer, 9
        for packet in [*stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb48le")), *stream.encode(None)]:
            out.mux(packet)
    (frame,) = Video(tmp_path / "film.mkv").frames(100)
    assert frame.image.dtype == np.uint8
    assert np.abs(frame.image[8, 4::8].astype(int) - COLORS).max() <= 2


def test_highlights_keep_their_differences():
    bright = (65535 * np.array([0.75, 0.8, 0.85, 0.9])).astype(np.uint16)  # white paper and brighter
    shown = to_standard(np.repeat(bright[None, :, None], 3, 2), HLG)[0, :, 0].astype(int)
    assert 235 <= shown[0] < 250
    assert (np.diff(shown) >= 1).all()
