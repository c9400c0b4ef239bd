"""Frames of films as players show them: turned, mirrored, cut out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from helpers.films import pan
from scgs_warp.capture.as_shown import turned
from scgs_warp.capture.cut_out import is_cut_out
from scgs_warp.capture.source import Video


def displayed(path: Path, matrix: tuple[int, ...] | None, picture: np.ndarray) -> np.ndarray:
    """Write a film of one picture with a display matrix, and return its first frame."""
    import av

    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=10, options={"qp": "4"})
        stream.width, stream.height, stream.pix_fmt = picture.shape[1], picture.shape[0], "yuv444p"
        if matrix is not None:
            a, b, c, d = (value << 16 for value in matrix)
            stream.set_display_matrix([a, b, 0, c, d, 0, 0, 0, 1 << 30])
        for _ in range(3):
            out.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        out.mux(stream.encode())
    return next(iter(Video(path).frames(1000))).image


@pytest.mark.parametrize(
    ("matrix", "shown"),
    [
        (None, lambda image: image),
        ((1, 0, 0, 1), lambda image: image),
        ((0, 1, -1, 0), lambda image: np.rot90(image, 3)),  # a phone held upright
        ((-1, 0, 0, -1), lambda image: np.rot90(image, 2)),
        ((0, -1, 1, 0), lambda image: np.rot90(image, 1)),
        ((-1, 0, 0, 1), lambda image: image[:, ::-1]),  # a front camera
        ((1, 0, 0, -1), lambda image: image[::-1]),
        ((0, 1, 1, 0), lambda image: image.swapaxes(0, 1)),
        ((0, -1, -1, 0), lambda image: image[::-1, ::-1].swapaxes(0, 1)),
    ],
)
def test_films_are_turned_and_mirrored_as_players_do(tmp_path, matrix, shown):
    picture = pan([0])[0]
    found, expected = displayed(tmp_path / "film.mp4", matrix, picture), shown(picture)
    assert found.shape == expected.shape
    assert np.abs(found.astype(int) - expected).mean() < 4


def test_side_data_of_unknown_kinds_is_no_obstacle():
    """The turn is then what PyAV says."""
    from scgs_warp.capture import as_shown

    class Frame:
        rotation = -90

        @property
        def side_data(self):
            raise ValueError("36 is not a valid Type")

    image = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    assert np.array_equal(turned(image, as_shown._display_matrix(Frame())), np.rot90(image, 3))


@pytest.mark.parametrize(
    ("name", "codec", "pixels", "tolerance"),
    [
        ("film.mov", "png", "rgba", 2),
        ("film.webm", "libvpx-vp9", "yuva420p", 40),
        ("vp8.webm", "libvpx", "yuva420p", 40),
    ],
)
def test_films_keep_their_alpha(tmp_path, name, codec, pixels, tolerance):
    """Of WebM, whose alpha is a film of its own, ffmpeg's own decoders see the colours only."""
    import av

    pictures = pan(range(0, 30, 3))
    with av.open(str(tmp_path / name), "w") as out:
        stream = out.add_stream(codec, rate=10, options={"crf": "4", "b": "4M", "auto-alt-ref": "0"})
        stream.width, stream.height, stream.pix_fmt = 160, 120, pixels
        for picture in pictures:
            alpha = np.zeros((120, 160, 1), np.uint8)
            alpha[30:90, 40:120] = 255
            out.mux(stream.encode(av.VideoFrame.from_ndarray(np.dstack([picture, alpha]), format="rgba")))
        out.mux(stream.encode())
    stills = list(Video(tmp_path / name).frames(80))
    assert [still.seconds for still in stills] == pytest.approx([k / 10 for k in range(10)], abs=1e-3)
    still = stills[0]
    assert still.alpha is not None and is_cut_out(still.alpha) and still.alpha.shape == (60, 80)
    assert (still.alpha[16:44, 21:59] == 255).all() and not still.alpha[:14].any()
    assert not still.image[:14].any(), "what is hidden has no colour"
    inside = pictures[0][32:88, 42:118].reshape(28, 2, 38, 2, 3).mean((1, 3))
    assert np.abs(still.image[16:44, 21:59] - inside).max() < tolerance
