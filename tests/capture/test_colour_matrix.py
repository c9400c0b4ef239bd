"""Colours of films, stored as brightness and colour differences: by the matrix and range that a film names, or else by
those that players take."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scgs_warp.capture import as_shown
from scgs_warp.capture.source import Video
from scgs_warp.data.synthetic.films.encoding import write_film

COLOURS = np.array([[0, 0, 0], [255, 255, 255], [230, 20, 30], [20, 220, 40], [30, 20, 210], [200, 120, 60]])
WEIGHTS = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 9: (0.2627, 0.0593)}
"""Of red and blue in brightness, by the number of the matrix (ITU-T H.273)."""
SD, PAL, HD, UPRIGHT = (640, 480), (720, 576), (1280, 720), (720, 1280)


def stored(matrix: int, full: bool) -> np.ndarray:
    """Return the stored values [6, 3] of the colours, 8 bits."""
    red, blue = WEIGHTS[matrix]
    r, g, b = COLOURS.T / 255.0
    luma = red * r + (1 - red - blue) * g + blue * b
    differences = 0.5 * (b - luma) / (1 - blue), 0.5 * (r - luma) / (1 - red)
    scale, base = (255.0, 0.0) if full else (219.0, 16.0)
    chroma = 255.0 if full else 224.0
    return np.rint(np.stack([base + scale * luma, *(128 + chroma * each for each in differences)], 1)).astype(np.uint8)


def write(path: Path, size: tuple[int, int], matrix: int, full: bool, tagged: bool) -> None:
    """Write three frames of the colours, in columns."""
    import av

    width, height = size
    column = np.minimum(np.arange(width) // (width // len(COLOURS)), len(COLOURS) - 1)
    planes = stored(matrix, full)[column].T[:, None, :].repeat(height, 1)
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=10, options={"qp": "0", "preset": "ultrafast"})
        (stream.width, stream.height), stream.pix_fmt = size, "yuv444p"
        stream.codec_context.color_range = 2 if full else 1
        if tagged:
            stream.codec_context.colorspace = matrix
        for _ in range(3):
            frame = av.VideoFrame.from_ndarray(planes, format="yuv444p")
            frame.color_range = 2 if full else 1
            out.mux(stream.encode(frame))
        out.mux(stream.encode())


def error(path: Path) -> int:
    """Return the largest error of the colours in a film's first frame."""
    image = next(iter(Video(path).frames(10_000))).image
    step = image.shape[1] // len(COLOURS)
    found = image[image.shape[0] // 2, step // 2 :: step][: len(COLOURS)]
    return int(np.abs(found.astype(int) - COLOURS).max())


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize(
    ("size", "matrix", "tagged"),
    [
        *((size, matrix, True) for size in (SD, HD) for matrix in WEIGHTS),
        *((size, 5, False) for size in (SD, PAL)),
        *((size, 1, False) for size in (HD, UPRIGHT, (1280, 534), (960, 720))),
    ],
)
def test_colours_are_those_of_the_film(tmp_path, size, matrix, tagged, full):
    """Without a tag, large films are BT.709 and small ones BT.601: HD films were shifted by up to 40 levels."""
    write(tmp_path / "film.mkv", size, matrix, full, tagged)
    assert error(tmp_path / "film.mkv") <= 2


@pytest.mark.parametrize("size", [SD, HD])
def test_made_films_say_how_their_colours_are_stored(tmp_path, size):
    column = np.minimum(np.arange(size[0]) // (size[0] // len(COLOURS)), len(COLOURS) - 1)
    picture = COLOURS.astype(np.uint8)[column][None].repeat(size[1], 0)
    write_film(tmp_path / "film.mp4", [picture] * 3, 10.0, 1, None)
    assert error(tmp_path / "film.mp4") <= 4


def test_untagged_films_of_high_dynamic_range_are_bt2020():
    assert as_shown._usual_matrix(*SD, rich=True) == 9
