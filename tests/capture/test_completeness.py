"""Films that end before their headers say."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.films import cut_film, encoded, pan, spoil
from scgs_warp.capture.completeness import Header, Incomplete, header_of, incomplete, lost_in_gaps
from scgs_warp.capture.rig.instants import recorded
from scgs_warp.capture.source import Video
from scgs_warp.errors import UserError

FRAMES = 100
FASTSTART, PIECES = {"movflags": "faststart"}, {"movflags": "frag_keyframe+empty_moov"}


def read(path: Path) -> tuple[int, Incomplete | None]:
    video = Video(path)
    return len(list(video.frames(64))), video.incomplete


@pytest.mark.parametrize(
    ("name", "options"), [("a.mp4", FASTSTART), ("b.mp4", PIECES), ("c.mov", FASTSTART), ("d.mkv", {}), ("e.avi", {})]
)
def test_a_copy_that_was_cut_off_is_noticed(tmp_path, name, options):
    path = tmp_path / name
    encoded(path, FRAMES, options)
    assert read(path) == (FRAMES, None)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    decoded, found = read(path)
    assert found is not None and 15 < decoded < 70
    assert (found.decoded, found.announced) == (decoded, FRAMES) and abs(found.seconds - decoded / 25) < 0.1
    assert f"{decoded} of 100 frames can be decoded, until second {found.seconds:.2f}; " in found.describe()


def test_damage_within_a_film_is_noticed(tmp_path):
    path = tmp_path / "film.mp4"
    encoded(path, FRAMES, FASTSTART)
    spoil(path, 0.5, 0.25)
    decoded, found = read(path)
    assert found is not None and found.decoded == decoded < 90 and found.seconds > 3.8


@pytest.mark.parametrize("kind", ["mkv", "ts"])
def test_damage_that_leaves_a_gap_is_noticed(tmp_path, kind):
    """These containers do not count their frames, and skip what is damaged."""
    path = tmp_path / f"film.{kind}"
    encoded(path, FRAMES, gop=20)
    assert read(path) == (FRAMES, None)
    spoil(path, 0.5, 0.2)
    decoded, found = read(path)
    assert found is not None and found.decoded == decoded < 85 and found.announced in (FRAMES, FRAMES + 1)
    there = recorded(path).incomplete
    assert there is not None and abs(there.decoded - decoded) <= 1


def test_gaps_in_an_even_rate():
    even = np.arange(100) / 25
    assert lost_in_gaps(even) == lost_in_gaps([]) == lost_in_gaps([1.0]) == lost_in_gaps([1.0] * 5) == 0
    assert lost_in_gaps(even[::20]) == 0
    assert lost_in_gaps(np.delete(even, range(40, 60))) == 20
    assert lost_in_gaps(np.delete(even, range(40, 47))) == 0, "encoders leave out a few"
    assert lost_in_gaps(np.cumsum(np.tile([0.04, 0.04, 0.04, 0.5], 20))) == 0, "an uneven rate"
    assert lost_in_gaps(np.concatenate([even, even + 3600.0])) == 0, "a film that rests"


def test_a_film_of_which_hardly_anything_is_left_is_refused(tmp_path):
    encoded(tmp_path / "film.mp4", 220, FASTSTART)
    content = (tmp_path / "film.mp4").read_bytes()
    (tmp_path / "film.mp4").write_bytes(content[: content.index(b"mdat") + 9000])
    with pytest.raises(UserError, match=r"film\.mp4: only \d of 220 frames can be decoded.*copy it again"):
        read(tmp_path / "film.mp4")


def test_a_film_that_is_left_before_its_end_is_not_judged(tmp_path):
    encoded(tmp_path / "film.mp4", FRAMES, FASTSTART)
    video = Video(tmp_path / "film.mp4")
    for still in video.frames(64):
        if still.index == 30:
            break
    assert video.incomplete is None


def test_what_is_cut_or_at_rest_or_heard_is_not_missing(tmp_path):
    """Frames before the first one shown, frames at rest that are not stored, and sound that lasts longer."""
    encoded(tmp_path / "whole.mp4", FRAMES, FASTSTART)
    cut_film(tmp_path / "whole.mp4", tmp_path / "cut.mp4", 30)
    assert read(tmp_path / "cut.mp4") == (70, None)
    for name in ("sound.mp4", "sound.mkv"):
        encoded(tmp_path / name, FRAMES, sound=9.0)
        assert read(tmp_path / name) == (FRAMES, None)
    write_avi(tmp_path / "rest.avi", [picture if index % 3 == 0 else None for index, picture in enumerate(PICTURES)])
    assert read(tmp_path / "rest.avi") == (20, None)
    write_avi(tmp_path / "halves.avi", [*PICTURES[:30], *[None] * 30])
    assert read(tmp_path / "halves.avi") == (30, Incomplete(30, 60, 29 / 25))


def test_halves_of_frames_may_be_stored_alone():
    header = Header(200, 4.0, True)
    assert incomplete(header, 25.0, decoded=100, hidden=0, seconds=3.96, latest=3.96) is None
    assert incomplete(header, 25.0, decoded=100, hidden=0, seconds=1.96, latest=1.96) == Incomplete(100, 200, 1.96)


def test_a_header_that_says_nothing_is_not_believed():
    class Container:
        class format:
            name = "matroska,webm"

        streams = (0, 1)
        duration = 9_000_000

    class Stream:
        average_rate, metadata = 25, {"DURATION": "soon"}

    assert header_of(Container, Stream) == Header(0, 0.0, False)
    assert incomplete(Header(0, 0.0, False), 25.0, decoded=3, hidden=0, seconds=0.1, latest=0.1) is None
    Stream.metadata = {"DURATION": "00:01:02.500000000"}
    assert header_of(Container, Stream) == Header(1562, 62.5, False)


PICTURES = pan(range(0, 180, 3))


def write_avi(path: Path, pictures: list[np.ndarray | None]) -> None:
    """Write an .avi of JPEG images, 25 a second; None stands for an empty one, which repeats the one before."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return name + struct.pack("<I", len(content)) + content + bytes(len(content) % 2)

    body, index = b"", b""
    for picture in pictures:
        content = b"" if picture is None else cv2.imencode(".jpg", picture)[1].tobytes()
        index += struct.pack("<4sIII", b"00dc", 16, 4 + len(body), len(content))
        body += chunk(b"00dc", content)
    height, width = PICTURES[0].shape[:2]
    count = len(pictures)
    main = chunk(b"avih", struct.pack("<14I", 40000, 0, 0, 16, count, 0, 1, 0, width, height, 0, 0, 0, 0))
    lens = (0, 0, 0, 0, 1, 25, 0, count, 0, 2**32 - 1, 0, 0, 0, width, height)
    stream = chunk(b"strh", struct.pack("<4s4sIHHIIIIIIII4H", b"vids", b"MJPG", *lens))
    stream += chunk(b"strf", struct.pack("<IiiHH4sIiiII", 40, width, height, 1, 24, b"MJPG", 0, 0, 0, 0, 0))
    headers = chunk(b"LIST", b"hdrl" + main + chunk(b"LIST", b"strl" + stream))
    content = b"AVI " + headers + chunk(b"LIST", b"movi" + body) + chunk(b"idx1", index)
    path.write_bytes(chunk(b"RIFF", content))
