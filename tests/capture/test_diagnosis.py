"""Messages about captures in which too few frames got a camera."""

from __future__ import annotations

from scgs_warp.capture.diagnosis import Outcome, likely_reason, notes, too_few, unseen_between, unseen_ends
from scgs_warp.capture.features import Links

LINKS = Links(2000, 300, 1.0, 0.3)


def test_the_likeliest_reason_is_given():
    assert "texture" in likely_reason(Outcome(50, 0, 0, Links(30, 0, 0.0, 0.0), 0.1))
    assert (
        "masks hide 90 %" in (said := likely_reason(Outcome(50, 0, 0, Links(30, 0, 0.0, 0.0), 0.9))) and "inv" in said
    )
    assert "--frames 100" in likely_reason(Outcome(50, 4, 9, Links(2000, 12, 0.5, 0.2), 0.1))
    assert "--masks none" in likely_reason(Outcome(50, 4, 9, Links(2000, 12, 0.5, 0.2), 0.4))
    assert "walking" in likely_reason(Outcome(50, 0, 0, Links(2000, 300, 1.0, 1.0), 0.1))
    assert "walking" in likely_reason(Outcome(50, 50, 0.4, LINKS, 0.1))
    for links in (LINKS, Links(800, 480, 1.0, 0.02), Links(1000, 30, 0.7, 0.5)):
        assert "camera stands still" in likely_reason(Outcome(50, 0, 0, links._replace(moved=0.0004), 0.35))
    assert "stands still" in notes(Outcome(50, 50, 9, LINKS._replace(moved=0.0004), 0.1))[0]
    assert "--matching" in likely_reason(Outcome(50, 20, 9, LINKS, 0.1))
    assert "straight ahead" in likely_reason(Outcome(30, 5, 2.4, Links(2000, 1100, 1.0, 0.34), 0.1, True))
    assert "parts" in likely_reason(Outcome(30, 5, 2.4, Links(2000, 1100, 0.97, 0.34), 0.1, True)), "a cut"
    assert "give --frames 100, or" in likely_reason(Outcome(50, 20, 9, LINKS, 0.1, True)), "matching was exhaustive"
    for alone in (
        Outcome(12, 0, 0, Links(2000, 0, 0.0, 0.2), 0.1, True, True),
        Outcome(12, 5, 9, LINKS, 0.1, True, True),
    ):
        assert "--frames" not in (said := likely_reason(alone)) and "part" in said, "there are no more frames"
    assert "--matching" in likely_reason(Outcome(50, 20, 9, LINKS, 0.1, False, True))
    for links in (LINKS, Links(2000, 12, 0.5, 0.2)):
        images = likely_reason(Outcome(50, 20, 9, links, 0.1, film=False))
        assert "part of the images" in images and "--start" not in images and "the film" not in images
    line = too_few("out", Outcome(50, 20, 9, LINKS, 0.1))
    assert line.startswith("out: 20 of 50 frames registered") and "--least 0.4 " in line
    assert "--least" not in too_few("out", Outcome(50, 0, 0, LINKS, 0.1))
    assert not notes(Outcome(50, 50, 9, LINKS, 0.1)) and len(notes(Outcome(50, 40, 9, LINKS, 0.1))) == 1
    assert "turns or zooms" in notes(Outcome(50, 50, 9, LINKS._replace(planar=1.0), 0.1))[0], "any depth fits a turn"
    assert "uncertain" in notes(Outcome(50, 50, 1.0, LINKS, 0.1))[0]


def test_ends_of_the_film_without_cameras_are_named():
    """Times go from 0 to 1 over the whole film, and motion there is made up."""
    assert unseen_ends([0.2, 5.0, 9.7], (0.0, 10.0)) == []
    assert "--start 6 and another" in unseen_ends([6.004, 14.6], (0.0, 14.7))[0]
    assert "--end 4.27 and another" in unseen_ends([2.0, 4.262], (2.0, 9.0))[0]
    assert "--start 3 --end 5 and another" in unseen_ends([3.0, 5.0], (0.0, 9.0))[0]


def test_parts_of_a_film_that_do_not_connect_are_told():
    seconds = [0.0, 1.0, 2.104, 6.048, 7.0]
    note = unseen_between(seconds, [3.0, 4.0, 5.0, 7.1], (0.0, 8.0))
    assert "between seconds 2.11 and 6.04 has" in note[0] and "--end 2.11 or --start 6.04, with" in note[0]
    assert unseen_between(seconds, [], (0.0, 8.0)) == [], "a film that rests has lost nothing"
    assert unseen_between(seconds, [0.5, 8.0], (0.0, 30.0)) == [], "a short gap, and the end"
