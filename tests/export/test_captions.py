"""Captions from WebVTT."""

from __future__ import annotations

import pytest

from scgs_warp.errors import UserError
from scgs_warp.export.captions import MAX_BYTES, read_captions

GOOD = """\ufeffWEBVTT Title

NOTE
a note --> that is none

STYLE
::cue { color: red }

1
00:00.500 --> 00:01.250 align:start
Hello <b>there</b> &amp; here
second line

01:00:00.000 --> 01:00:02.000
<i></i>

00:02.000 --> 00:03.000
late
"""


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_cues_are_read(newline, tmp_path):
    path = tmp_path / "film.vtt"
    path.write_bytes(GOOD.replace("\n", newline).encode())
    assert read_captions(path) == [
        {"from": 0.5, "to": 1.25, "text": "Hello there & here\nsecond line"},
        {"from": 2.0, "to": 3.0, "text": "late"},
    ]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"1\n00:00:01,000 --> 00:00:02,000\nSubRip\n", "does not begin with WEBVTT"),
        (b"WEBVTT\n\n00:02.000 --> 00:01.000\nbackwards\n", "no time span"),
        (b"WEBVTT\n\n0:1 --> 0:2\nshort\n", "no time span"),
        (b"WEBVTT\n\n\xff\xfe", "not UTF-8"),
        (b"WEBVTT\n\n" + b"x" * MAX_BYTES, "larger than"),
        (b"WEBVTT\n\n" + b"00:01.000 --> 00:02.000\nx\n\n" * 10_001, "more than 10,000"),
    ],
)
def test_what_is_no_webvtt_is_refused_in_one_line(content, message, tmp_path):
    (tmp_path / "film.vtt").write_bytes(content)
    with pytest.raises(UserError, match=message) as error:
        read_captions(tmp_path / "film.vtt")
    assert "\n" not in str(error.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(UserError, match="no such file"):
        read_captions(tmp_path / "film.vtt")
