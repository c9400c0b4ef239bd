"""One time line: common time, nearest frames, their own moments."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.field_films import write_fields
from helpers.films import cut_film, encoded, pan, without_beginning
from scgs_warp.capture.rig.instants import recorded, shortened_by, time_line
from scgs_warp.capture.source import Video
from scgs_warp.data.synthetic.films.encoding import write_film
from scgs_warp.errors import UserError

NAMES = ("a", "b", "c")


def test_frames_are_those_nearest_to_common_instants():
    own = np.arange(60) / 30
    starts = [0.0, 0.213, 0.05]
    line = time_line(NAMES, starts, [own] * 3, None)
    assert line.frames.shape == (3, len(line.seconds)) and line.seconds[0] == 0
    first = np.ceil(0.213 * 30) / 30
    for camera, start in enumerate(starts):
        true = start + own[line.frames[camera]] - first
        assert np.abs(true - line.seconds).max() <= 0.5 / 30 + 1e-9
        assert np.abs(true - line.moments[camera]).max() < 0.08 / 30 + 1e-9
    assert (line.moments[0] == line.seconds).all() and (np.abs(line.moments[1] - line.seconds) > 1e-3).all()
    times = line.times(range(3))
    assert times.min() == 0 and times.max() == 1
    assert line.moments.min() < 0, "a frame is taken before the first instant, and is not shifted to it"
    np.testing.assert_allclose(np.diff(times), np.diff(line.moments) / np.ptp(line.moments))
    some = line.times([0, 1])[:2]  # a camera that is left out does not count
    assert some.min() == 0 and some.max() == 1 and times[:2].min() > 0


def test_frames_before_a_cut_do_not_count(tmp_path):
    """A film that was cut without being encoded anew begins with frames that are not shown."""
    write_film(tmp_path / "whole.mp4", pan(range(60)), 30.0, 20, None)
    cut_film(tmp_path / "whole.mp4", tmp_path / "cut.mp4", 10)
    shown = list(Video(tmp_path / "cut.mp4").frames(64))
    assert len(shown) == 50 and len(recorded(tmp_path / "cut.mp4").seconds) == len(shown)


@pytest.mark.parametrize("kind", ["mp4", "mkv", "ts"])
def test_frames_before_the_first_key_frame_do_not_count(tmp_path, kind):
    """No decoder shows them, and sound is on the clock of the first frame that is shown."""
    encoded(tmp_path / f"whole.{kind}", 60, gop=20)
    without_beginning(tmp_path / f"whole.{kind}", tmp_path / f"cut.{kind}", 7)
    shown = list(Video(tmp_path / f"cut.{kind}").frames(64))
    found = recorded(tmp_path / f"cut.{kind}").seconds
    np.testing.assert_allclose(found, [still.seconds for still in shown], atol=1e-6)
    assert len(shown) == 40


def test_locked_cameras_share_their_moments():
    own = np.arange(40) / 25
    line = time_line(NAMES, [0.0, 0.0012, 0.2001], [own] * 3, None)
    assert (line.moments == line.seconds).all()


def test_instants_lie_in_the_given_part_and_are_thinned_to_their_number():
    own = np.arange(300) / 30
    line = time_line(NAMES, [0.0, 0.0, 0.0], [own] * 3, 20, 2.0, 4.0)
    assert len(line.seconds) == 20 and line.seconds[-1] == pytest.approx(2.0, abs=0.04)
    assert line.frames[0, 0] == 60
    assert len(time_line(NAMES, [0.0] * 3, [own] * 3, None).seconds) == 150


def test_cameras_of_different_rates_share_instants():
    line = time_line(NAMES[:2], [0.0, 0.01], [np.arange(60) / 30, np.arange(100) / 50], None)
    assert np.abs(line.moments[1] - line.seconds).max() <= 0.5 / 50 + 1e-9


def test_no_frame_is_used_twice_where_the_first_camera_is_the_fastest():
    own = [np.arange(count) / rate for count, rate in ((120, 59.94), (60, 30), (50, 25))]
    line = time_line(NAMES, [0.0, 0.0077, 0.0123], own, None)
    assert [len(np.unique(frames)) for frames in line.frames] == [len(line.seconds)] * 3 == [50] * 3
    alike = [np.arange(count) / rate for count, rate in ((61, 30), (60, 29.97))]
    line = time_line(NAMES[:2], [0.0, 0.002], alike, None)
    assert (line.moments[0] == line.seconds).all(), "rates that are alike leave the instants to the first camera"


def test_no_time_in_common_is_said():
    own = np.arange(30) / 30
    with pytest.raises(UserError, match="b begins when a has ended"):
        time_line(NAMES[:2], [0.0, 5.0], [own, own], None)
    with pytest.raises(UserError, match="3 frames in common"):
        time_line(NAMES[:2], [0.0, 0.9], [own, own], None)


def test_a_camera_that_was_stopped_early_is_named():
    """Most of a film was lost without a word."""
    long, short = np.arange(300) / 30, np.arange(60) / 30
    (line,) = shortened_by(NAMES, [0.0, 0.5, 0.1], [long, short, long])
    assert line == "note: b limits the time in common to 1.97 s; without its video, it is 9.87 s"
    (line,) = shortened_by(NAMES, [0.0, 0.5, 6.0], [long, long, long])
    assert line.startswith("note: c limits")
    assert shortened_by(NAMES, [0.0, 0.5, 1.0], [long, long, long]) == []
    assert shortened_by(NAMES[:2], [0.0, 0.5], [long, short]) == [], "two cameras are needed"


def test_moments_are_those_of_the_frames_of_a_film(tmp_path):
    write_film(tmp_path / "film.mp4", [np.full((64, 64, 3), k * 8, np.uint8) for k in range(20)], 12.5, 20, None)
    np.testing.assert_allclose(recorded(tmp_path / "film.mp4").seconds, np.arange(20) / 12.5, atol=1e-6)
    (tmp_path / "text.mp4").write_text("no film")
    with pytest.raises(UserError, match="not a video"):
        recorded(tmp_path / "text.mp4")


@pytest.mark.parametrize(("kind", "all_timed"), [("mts", True), ("mts", False), ("mp4", True), ("mp4", False)])
def test_fields_that_are_stored_one_by_one_are_no_frames(tmp_path, kind, all_timed):
    """Films of camcorders had twice as many frames as can be decoded, and were refused as damaged."""
    rng = np.random.default_rng(0)
    path = tmp_path / f"film.{kind}"
    write_fields(path, rng.integers(40, 200, (20, 64, 96), np.uint8), all_timed)
    made = recorded(path)
    np.testing.assert_allclose(made.seconds, np.arange(20) / 25, atol=1e-6)
    assert made.timed and made.incomplete is None
    shown = list(Video(path).frames(96))
    np.testing.assert_allclose([frame.seconds for frame in shown], made.seconds, atol=1e-6)
