"""Sources of frames: videos and folders of images, and files that are neither."""

from __future__ import annotations

import hashlib
import os
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from helpers.films import encoded, mask_images, pan, stream
from scgs_warp.capture.digests import DIGEST_BYTES
from scgs_warp.capture.folder_content import photographs_left_out
from scgs_warp.capture.rig.instants import recorded
from scgs_warp.capture.source import Folder, Video, open_source
from scgs_warp.errors import UserError
from scgs_warp.storage import heif_files
from scgs_warp.storage.png_files import write_png
from scgs_warp.visualization.video import film


def test_a_video_keeps_its_moments(tmp_path):
    with film(tmp_path / "film.mp4", 12.5) as out:
        for frame in pan(range(0, 30, 3)):
            out.write(frame)
    video = open_source(tmp_path / "film.mp4")
    stills = list(video.frames(80))
    assert video.count == 10 and [still.index for still in stills] == list(range(10))
    np.testing.assert_allclose([still.seconds for still in stills], np.arange(10) / 12.5, atol=1e-3)
    assert stills[0].image.shape == (60, 80, 3)


@pytest.mark.skipif(os.name == "nt", reason="Windows allows no colon in a file's name")
def test_raw_dv_has_the_rate_of_its_frames(tmp_path):
    """Its header gives the rate of the clock, 60,000 a second, and progress counted to 72,000 for 30 frames."""
    encoded(tmp_path / "film.dv", 30, codec="dvvideo", size=(720, 576))
    film = Video(tmp_path / "film.dv")
    assert film.rate == 25.0 and film.count == 30 == len(list(film.frames(64)))
    assert len(recorded(film.path).seconds) == 30


def test_the_name_of_a_film_may_hold_a_colon(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with film("take:2.mp4", 10) as writer:
        for level in (0, 100, 200):
            writer.write(np.full((16, 16, 3), level, np.uint8))
    assert open_source(Path("take:2.mp4")).count == 3 and len(recorded(Path("take:2.mp4")).seconds) == 3


def test_pixels_are_made_square(tmp_path):
    import av

    with av.open(str(tmp_path / "film.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 144, 120, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        for frame in pan([0, 3], 120, 144):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    assert {still.image.shape for still in Video(tmp_path / "film.mp4").frames(1000)} == {(120, 192, 3)}


def test_the_fields_of_interlaced_films_are_not_mixed(tmp_path):
    import av

    early, late = pan([0, 12], 120, 144)
    mixed = early.copy()
    mixed[1::2] = late[1::2]
    with av.open(str(tmp_path / "film.mkv"), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 144, 120, "yuv444p"
        stream.options = {"x264-params": "interlaced=1:tff=1:qp=4"}
        container.mux(stream.encode(av.VideoFrame.from_ndarray(mixed, format="rgb24")))
        container.mux(stream.encode())
    (still,) = Video(tmp_path / "film.mkv").frames(1000)
    off = np.abs(still.image.astype(int) - early).mean((1, 2))
    assert np.abs(late.astype(int) - early).mean() > 10
    assert off[0::2].max() < 3 and off[1::2].max() < 8


def test_a_cover_before_the_film_is_passed_over(tmp_path):
    import av

    pictures = pan(range(0, 60, 3), 120, 144)
    with av.open(str(tmp_path / "film.mkv"), "w") as container:
        cover, film_of_it = container.add_stream("mjpeg", rate=10), container.add_stream("libx264", rate=10)
        for stream, kind in ((cover, "yuvj420p"), (film_of_it, "yuv420p")):
            stream.width, stream.height, stream.pix_fmt = 144, 120, kind
        container.mux(cover.encode(av.VideoFrame.from_ndarray(pictures[0], format="rgb24")))
        for picture in pictures:
            container.mux(film_of_it.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        for stream in (cover, film_of_it):
            container.mux(stream.encode())
    assert len(list(Video(tmp_path / "film.mkv").frames(200))) == 20
    assert len(recorded(tmp_path / "film.mkv").seconds) == 20


def test_a_film_that_changes_its_size_is_usable_up_to_there(tmp_path):
    (tmp_path / "call.h264").write_bytes(stream(pan(range(0, 60, 3), 120, 144)) + stream(pan(range(9), 60, 80)))
    seen = []
    with pytest.raises(UserError, match=r"call\.h264: its pictures are 144 x 120 pixels, but 80 x 60"):
        for still in Video(tmp_path / "call.h264").frames(200):
            seen.append(still.image.shape)
    assert len(seen) >= 15 and set(seen) == {(120, 144, 3)}
    assert len(list(Video(tmp_path / "call.h264").frames(200, range(22, 26)))) == 4, "other frames do not matter"


def test_what_is_no_film_is_refused(tmp_path):
    (tmp_path / "film.mp4").write_bytes(b"not a film" * 1000)
    (tmp_path / "empty").mkdir()
    with film(tmp_path / "cut.mp4") as out:
        for frame in pan(range(0, 60, 3)):
            out.write(frame)
    (tmp_path / "cut.mp4").write_bytes((tmp_path / "cut.mp4").read_bytes()[:300])
    for name, said in (("film.mp4", "is not a video"), ("empty", "holds no images"), ("nowhere", "no such file")):
        with pytest.raises(UserError, match=said):
            open_source(tmp_path / name)
    with pytest.raises(UserError, match=r"cut\.mp4"):
        list(open_source(tmp_path / "cut.mp4").frames(64))
    mixed = mask_images(tmp_path / "mixed", 3)
    write_png(mixed / "010.png", np.zeros((50, 50, 3), np.uint8))
    with pytest.raises(UserError, match=r"010\.png.*one size"):
        list(open_source(mixed).frames(64))
    (mixed / "010.png").write_bytes(b"x")
    with pytest.raises(UserError, match=r"010\.png: is not an image"):
        list(open_source(mixed).frames(64))


def test_what_came_in_place_of_a_film_is_named(tmp_path):
    for content, said in (
        (
            b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n",
            "is a pointer of Git LFS, not the video",
        ),
        (b"<!DOCTYPE html>\n<html>", "is a web page, not the video; download the video itself"),
        (b"", "is empty; copy it again"),
    ):
        (tmp_path / "film.mp4").write_bytes(content)
        with pytest.raises(UserError, match=rf"film\.mp4: {said}"):
            open_source(tmp_path / "film.mp4")


def photograph(path, sensor: np.ndarray, orientation: int) -> None:
    """Write what a camera stores, with the orientation in which it was held."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(sensor).save(path, exif=exif, quality=95)


@pytest.mark.parametrize("most", [6, 8, 1])
def test_photographs_held_in_different_ways_have_one_lens(most, tmp_path):
    """As the sensor saw them: a quarter turn more or less would move the lens off its centre."""
    sensor = pan([0])[0]
    turns = {1: 0, 3: 2, 6: 3, 8: 1}
    for index, orientation in enumerate((most, 1, 6, 8, 3, most, most, most)):
        photograph(tmp_path / f"{index}.jpg", sensor, orientation)
    stills = list(Folder(tmp_path).frames(1000))
    for still, orientation in zip(stills, (most, 1, 6, 8, 3, most, most, most)):
        as_most = np.rot90(sensor, turns[most])
        upright = (turns[orientation] - turns[most]) % 2 == 0  # of most photographs' sides
        expected = np.rot90(sensor, turns[orientation]) if upright else as_most
        assert still.image.shape == as_most.shape
        assert np.abs(still.image.astype(int) - expected).mean() < 8, (orientation, most)
        assert still.turns == (0 if upright else (turns[most] - turns[orientation]) % 4)


def test_images_that_were_turned_before_have_one_size(tmp_path):
    sensor = pan([0])[0]
    for index in range(5):
        write_png(tmp_path / f"{index}.png", sensor if index % 2 == 0 else np.rot90(sensor))
    stills = list(Folder(tmp_path).frames(1000))
    assert {still.image.shape for still in stills} == {(120, 160, 3)} and [s.turns for s in stills] == [0, 1, 0, 1, 0]


def test_animated_images_are_films(tmp_path):
    pictures = pan(range(0, 60, 3))
    first, *others = [Image.fromarray(picture) for picture in pictures]
    for name, options in (("a.webp", {"lossless": True}), ("a.png", {}), ("still.webp", None)):
        more = {} if options is None else {"save_all": True, "append_images": others, "duration": 80, **options}
        first.save(tmp_path / name, **more)
    for name in ("a.webp", "a.png"):
        source = open_source(tmp_path / name)
        stills = list(source.frames(80))
        assert source.video and len(stills) == 20 and (source.count == 20 or name == "a.png")
        np.testing.assert_allclose([still.seconds for still in stills], 0.08 * np.arange(20), atol=0.011)
        assert stills[-1].image.shape == (60, 80, 3) and stills[0].alpha is None
    (still,) = open_source(tmp_path / "still.webp").frames(1000)
    assert still.image.shape == (120, 160, 3)
    content = (tmp_path / "a.webp").read_bytes()
    (tmp_path / "cut.webp").write_bytes(content[: len(content) // 2])
    with pytest.raises(UserError, match=r"cut\.webp: is not an animation that decodes"):
        list(open_source(tmp_path / "cut.webp").frames(80))


def test_a_film_with_its_picture_beside_it_is_named(tmp_path):
    write_png(tmp_path / "cover.png", np.zeros((8, 8, 3), np.uint8))
    (tmp_path / "film.mp4").write_bytes(b"x")
    with pytest.raises(UserError, match=r"holds 1 images, but film\.mp4; give \S+film\.mp4"):
        Folder(tmp_path)
    for index in range(5):
        write_png(tmp_path / f"{index}.png", np.zeros((8, 8, 3), np.uint8))
    assert Folder(tmp_path).count == 6


def test_files_that_are_hidden_are_no_images(tmp_path):
    for name in ("1.png", "2.png", ".trashed-1700-3.png"):
        write_png(tmp_path / name, np.zeros((8, 8, 3), np.uint8))
    (tmp_path / "._1.png").write_bytes(b"\0\5\x16\7")
    assert [file.name for file in Folder(tmp_path).files] == ["1.png", "2.png"]


@pytest.fixture
def without_heif(monkeypatch):
    monkeypatch.setattr(heif_files, "reads_heif", lambda: False)


def test_folders_without_images_say_what_they_hold(tmp_path, without_heif):
    for name, files, said in (
        ("phone", ["IMG_1.HEIC", "IMG_2.HEIC"], r"holds 2 photographs .*\(\.heic\), .*as JPEG, or pip install .*heic"),
        ("camera", ["1.CR2", "2.CR2"], r"holds 2 photographs in other formats \(\.cr2\), .*as JPEG$"),
        ("film", ["clip.mp4"], r"give \S+clip\.mp4$"),
        ("rig", ["a.mp4", "b.MOV"], r"give \S+a\.mp4, or --rig \S+rig for films"),
        ("scene", ["images/1.png"], r"but images does; give \S+images$"),
    ):
        for file in files:
            (tmp_path / name / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name / file).write_bytes(b"x")
        with pytest.raises(UserError, match=said):
            Folder(tmp_path / name)


def test_photographs_in_other_formats_are_counted(tmp_path, without_heif):
    for name in ("1.jpg", "1.dng", "2.HEIC", "3.heic"):
        (tmp_path / name).write_bytes(b"x")
    (note,) = photographs_left_out(tmp_path)
    assert "2 photographs in other formats (.heic) are left out" in note
    (tmp_path / "2.HEIC").unlink()
    (tmp_path / "3.heic").unlink()
    assert photographs_left_out(tmp_path) == []


def test_what_identifies_a_source_covers_whole_files(tmp_path):
    file = tmp_path / "1.png"
    for size in (100, DIGEST_BYTES, 2 * DIGEST_BYTES + 1):
        content = bytearray(np.random.default_rng(0).bytes(size))
        file.write_bytes(content)
        first = Folder(tmp_path).digest()
        for place in (0, size // 2, size - 1):
            content[place] ^= 1
            file.write_bytes(content)
            assert Folder(tmp_path).digest() != first
            content[place] ^= 1
    file.write_bytes(content)
    assert Folder(tmp_path).digest() == first
    file.rename(tmp_path / "2.png")
    assert Folder(tmp_path).digest() != first, "names tell times"


def test_earlier_versions_identified_large_files_by_both_ends(tmp_path):
    file, whole = tmp_path / "1.png", 2 * DIGEST_BYTES
    for size in (100, DIGEST_BYTES, whole + 1):
        content = bytearray(np.random.default_rng(0).bytes(size))
        file.write_bytes(content)
        seen = hashlib.sha256(f"{size},".encode() + content[:DIGEST_BYTES])
        if size > whole:
            seen.update(content[-DIGEST_BYTES:])
        assert Folder(tmp_path).digest(earlier=True) == seen.hexdigest()


def test_a_codec_that_nobody_knows(tmp_path):
    encoded(tmp_path / "film.mkv", 10)
    content = (tmp_path / "film.mkv").read_bytes()
    assert content.count(b"V_MPEG4/ISO/AVC") == 1
    (tmp_path / "film.mkv").write_bytes(content.replace(b"V_MPEG4/ISO/AVC", b"V_UNHEARD/OF/XX"))
    with pytest.raises(UserError, match=r"film\.mkv"):
        list(Video(tmp_path / "film.mkv").frames(64))


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["0001.png", "0002.png", "0003.png", "0010.png"], [0.0, 1.0, 2.0, 9.0]),
        (["5.png", "10.png", "20.png"], [0.0, 0.5, 1.5]),
        (["1403636579763555584.png", "1403636579813555584.png", "1403636579913555584.png"], [0.0, 0.5, 1.5]),
        (["a12.png", "b3.png", "c7.png"], [0.0, 1.0, 2.0]),  # not in the order of the names
        (["0001_a.png", "0001_b.png", "0002_a.png"], [0.0, 1.0, 2.0]),  # twice the same
        (["1.png", "2.png", "3.png", "1403636579763555584.png"], [0.0, 1.0, 2.0, 3.0]),  # not of one counter
        (["x.png", "y.png"], [0.0, 1.0]),
    ],
)
def test_images_of_a_folder_have_the_times_in_their_names(names, expected, tmp_path):
    for name in names:
        write_png(tmp_path / name, np.zeros((8, 8, 3), np.uint8))
    assert [frame.seconds for frame in Folder(tmp_path).frames(8)] == expected
