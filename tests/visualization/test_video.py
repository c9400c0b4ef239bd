"""Films are decoded again: size, number, rate and colours of what was written; nothing is left of what failed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from scgs_warp.errors import UserError
from scgs_warp.visualization.video import check_path, film


def frames(count: int, height: int, width: int) -> list[np.ndarray]:
    """A colour gradient with a white square that walks to the right."""
    y, x = np.mgrid[0:height, 0:width]
    found = []
    for index in range(count):
        image = np.stack([255 * x / width, 255 * y / height, np.full(x.shape, 60.0)], axis=-1)
        left = 4 + index * 2
        image[8:16, left : left + 8] = 255
        found.append(image.astype(np.uint8))
    return found


def write(path: Path, images: list[np.ndarray], fps: float = 25) -> None:
    with film(path, fps) as writer:
        for image in images:
            writer.write(image)


def read_mp4(path: Path):
    import av

    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        about = (stream.codec_context.name, stream.codec_context.pix_fmt, float(stream.average_rate))
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)], about


@pytest.mark.parametrize("size", [(48, 64), (47, 63), (1, 1)])
def test_mp4_decodes_to_what_was_written(tmp_path: Path, size: tuple[int, int]) -> None:
    images = frames(7, 48, 64) if size == (48, 64) else [image[: size[0], : size[1]] for image in frames(7, 48, 64)]
    path = tmp_path / "made" / "film.mp4"
    write(path, images)
    found, about = read_mp4(path)
    assert about == ("h264", "yuv420p", 25.0)
    assert len(found) == 7
    assert found[0].shape == (size[0] + size[0] % 2, size[1] + size[1] % 2, 3)
    for image, truth in zip(found, images):
        error = np.abs(image[: size[0], : size[1]].astype(int) - truth)
        assert error.mean() < 4 and np.median(error) < 4  # colours: BT.601 read as BT.709 is off by 10 and more
    assert [entry.name for entry in path.parent.iterdir()] == ["film.mp4"]


def test_mp4_starts_fast(tmp_path: Path) -> None:
    """The index comes before the data, so that a browser plays while it loads."""
    write(tmp_path / "film.mp4", frames(3, 32, 32))
    data = (tmp_path / "film.mp4").read_bytes()
    assert 0 < data.find(b"moov") < data.find(b"mdat")


def test_gif_plays_and_loops(tmp_path: Path) -> None:
    from PIL import Image

    images = frames(5, 40, 50)
    write(tmp_path / "film.gif", images, fps=20)
    with Image.open(tmp_path / "film.gif") as picture:
        assert picture.n_frames == 5 and picture.info["loop"] == 0 and picture.info["duration"] == 50
        for index, truth in enumerate(images):
            picture.seek(index)
            found = np.asarray(picture.convert("RGB"), int)
            assert np.abs(found - truth).mean() < 12
            assert (found[9:15, 5 + 2 * index : 11 + 2 * index] > 240).all()  # the square has walked


@pytest.mark.parametrize("fps", [7.0, 29.97, 30.0, 40.0, 49.9, 50.0])
def test_a_gif_lasts_as_long_as_the_film(tmp_path: Path, fps: float) -> None:
    """At 30 frames a second, frames of 3 hundredths each would play a tenth too fast."""
    from PIL import Image, ImageSequence

    write(tmp_path / "film.gif", frames(20, 24, 60), fps=fps)
    with Image.open(tmp_path / "film.gif") as picture:
        shown = [frame.info["duration"] for frame in ImageSequence.Iterator(picture)]
    assert sum(shown) == pytest.approx(1000 * 20 / fps, abs=5)
    assert min(shown) >= 20 and max(shown) - min(shown) <= 10


def test_what_no_gif_can_show_is_refused(tmp_path: Path) -> None:
    still = [np.full((16, 16, 3), 128, np.uint8)] * 7
    with pytest.raises(UserError, match=r"film\.gif: a GIF shows at most 50 frames a second, and 60 .*--fps"):
        write(tmp_path / "film.gif", still, fps=60)
    with pytest.raises(UserError, match=r"film\.gif: stands still for more than 655 s"):
        write(tmp_path / "film.gif", still, fps=0.01)
    assert list(tmp_path.iterdir()) == []
    write(tmp_path / "film", still, fps=60)


def test_folder_of_pngs_is_lossless_and_replaced_as_a_whole(tmp_path: Path) -> None:
    import cv2

    images = frames(6, 17, 23)
    write(tmp_path / "film", images)
    write(tmp_path / "film", images[:4])
    names = sorted(entry.name for entry in (tmp_path / "film").iterdir())
    assert names == [f"frame_{index:05d}.png" for index in range(4)]
    for name, truth in zip(names, images):
        np.testing.assert_array_equal(cv2.imread(str(tmp_path / "film" / name))[..., ::-1], truth)
    assert [entry.name for entry in tmp_path.iterdir()] == ["film"]


def test_frames_follow_links_and_leave_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    for count in (3, 2):
        write(tmp_path / "link", frames(count, 16, 16))
        assert (tmp_path / "link").is_symlink() and len(list((tmp_path / "real").iterdir())) == count
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["link", "real"]
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for name in (".", "..", "/"):
        with pytest.raises(UserError, match=r"current folder .*; name a new folder"):
            check_path(name)


@pytest.mark.parametrize("name", ["ü" * 125 + ".mp4", "ü" * 125 + ".gif", "ü" * 127])
def test_the_longest_names_are_written(tmp_path: Path, name: str) -> None:
    for _ in range(2):  # the second replaces the first
        write(tmp_path / name, frames(1, 16, 16))
        assert [entry.name for entry in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", ["film.mp4", "film.gif", "film"])
def test_a_failure_leaves_nothing(tmp_path: Path, name: str) -> None:
    with pytest.raises(RuntimeError, match="mid-film"):
        with film(tmp_path / name) as writer:
            writer.write(frames(1, 32, 32)[0])
            raise RuntimeError("mid-film")
    assert list(tmp_path.iterdir()) == []


def test_a_failure_keeps_the_earlier_film(tmp_path: Path) -> None:
    write(tmp_path / "film.mp4", frames(3, 32, 32))
    before = (tmp_path / "film.mp4").read_bytes()
    with pytest.raises(ValueError, match="like the first one"):
        write(tmp_path / "film.mp4", [*frames(1, 32, 32), *frames(1, 32, 30)])
    assert (tmp_path / "film.mp4").read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


def test_mistakes_are_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("precious")
    (tmp_path / "dir.mp4").mkdir()
    for path, words in [
        (tmp_path / "film.avi", ".avi"),
        (tmp_path / "full", "other files"),
        (tmp_path / "file", "is a file"),
        (tmp_path / "dir.mp4", "is a folder"),
        (tmp_path / ".mp4", "a suffix without a name"),
        (tmp_path / "file" / "film.mp4", "cannot be written"),
    ]:
        with pytest.raises(UserError, match=words) as caught:
            check_path(path)
        assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)
    assert (tmp_path / "full" / "thesis.txt").read_text() == "precious"
    with pytest.raises(UserError, match="at least one frame"), film(tmp_path / "empty.mp4"):
        pass
    with pytest.raises(UserError, match="fps"), film(tmp_path / "film.mp4", fps=0.009):
        pass


@pytest.mark.parametrize("frame", [np.zeros((4, 4, 4), np.uint8), np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3))])
def test_wrong_frames_raise(tmp_path: Path, frame: np.ndarray) -> None:
    with pytest.raises(ValueError, match="uint8"), film(tmp_path / "film.gif") as writer:
        writer.write(frame)


FRESH_MEMORY = """
import sys
import numpy as np
from scgs_warp.visualization.video import film
y, x = np.mgrid[0:64, 0:95]
with film(sys.argv[1], 8) as writer:
    for k in range(4):
        disc = np.hypot(x - 32 - 2 * k, y - 32) < 16
        picture = np.stack([disc * (120 + 3 * ((x * y) % 7)), (x + y + k) % 200 * disc, x % 255], -1)
        writer.write(picture.astype(np.uint8))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="fills fresh memory through glibc")
def test_the_same_frames_are_the_same_film_whatever_lay_in_memory(tmp_path):
    """x264's macroblock tree read what it never wrote: the film's first picture then changed from run to run."""
    films = []
    for fill in ("1", "254"):
        path = tmp_path / f"{fill}.mp4"
        environ = {**os.environ, "MALLOC_PERTURB_": fill}
        subprocess.run([sys.executable, "-c", FRESH_MEMORY, str(path)], env=environ, check=True)
        films.append(path.read_bytes())
    assert films[0] == films[1]


def test_earlier_frames_outlive_a_replacement_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "frames"
    write(folder, frames(2, 16, 24))
    plain = os.replace

    def refuse(source: Path, target: Path) -> None:
        if Path(target) == folder and Path(source).suffix == ".tmp":
            raise OSError(5, "Input/output error")
        plain(source, target)

    monkeypatch.setattr("os.replace", refuse)
    with pytest.raises(UserError, match="cannot be written"):
        write(folder, frames(3, 16, 24))
    assert len(list(folder.iterdir())) == 2 and [entry.name for entry in tmp_path.iterdir()] == ["frames"]
