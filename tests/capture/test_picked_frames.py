"""The choice of a film's frames: progress counts the part that is looked at."""

from __future__ import annotations

from contextlib import contextmanager
from types import SimpleNamespace

import pytest
from PIL import Image

from helpers.films import encoded, pan
from scgs_warp.capture.picked_frames import choose
from scgs_warp.capture.request import CaptureRequest
from scgs_warp.capture.source import open_source


@pytest.mark.parametrize("kind", ["film.mp4", "film.webp", "folder"])
def test_progress_ends_where_the_part_ends(tmp_path, kind):
    """With --end, it counted the whole film, and the time left was that of the rest, too."""
    path, pictures = tmp_path / kind, [Image.fromarray(picture) for picture in pan(range(0, 80, 2))]
    if kind == "folder":
        path.mkdir()
        for index, picture in enumerate(pictures):
            picture.save(path / f"{index:04d}.png")
    elif kind == "film.webp":
        pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=40)
    else:
        encoded(path, 40)
    counts = []

    @contextmanager
    def show(total: int, text: str):
        steps: list[int] = []
        yield SimpleNamespace(advance=lambda: steps.append(1))
        counts.append((total, len(steps)))

    choose(CaptureRequest(path), open_source(path), show)
    assert counts.pop() == (40, 40)
    if kind != "folder":
        for end, count in ((0.81, 21), (9.0, 40)):
            choose(CaptureRequest(path, end=end), open_source(path), show)
            assert counts.pop() == (count, count)
