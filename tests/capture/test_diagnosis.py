"""Messages about captures in which too few frames got a camera."""

from __future__ import annotations

import pytest

from scgs_warp.capture.diagnosis import Outcome, likely_reason, notes, too_few
from scgs_warp.capture.features import Links

LINKS = Links(2000, 300, 1.0, 0.3)
FEW_FEATURES = Links(30, 0, 0.0, 0.0)
FEW_MATCHES = Links(2000, 12, 0.5, 0.2)
TURNED_ALONE = Links(2000, 300, 1.0, 1.0)


@pytest.mark.parametrize(
    ("outcome", "said"),
    [
        (Outcome(50, 0, 0, FEW_FEATURES, 0.1), ["texture"]),
        (Outcome(50, 0, 0, FEW_FEATURES, 0.9), ["masks hide 90 %", "inv"]),
        (Outcome(50, 4, 9, FEW_MATCHES, 0.1), ["--frames 100"]),
        (Outcome(50, 4, 9, FEW_MATCHES, 0.4), ["--masks none"]),
        (Outcome(50, 0, 0, TURNED_ALONE, 0.1), ["walking"]),
        (Outcome(50, 50, 0.4, LINKS, 0.1), ["walking"]),
        (Outcome(50, 20, 9, LINKS, 0.1), ["--matching"]),
    ],
)
def test_the_likeliest_reason_is_given(outcome, said):
    assert all(words in likely_reason(outcome) for words in said)


def test_too_few_cameras_are_counted_and_may_be_accepted_if_there_are_any():
    line = too_few("out", Outcome(50, 20, 9, LINKS, 0.1))
    assert line.startswith("out: 20 of 50 frames registered") and "--least 0.4 " in line
    assert "--least" not in too_few("out", Outcome(50, 0, 0, LINKS, 0.1))


def test_a_capture_that_is_good_enough_gets_notes_on_its_faults_alone():
    assert not notes(Outcome(50, 50, 9, LINKS, 0.1))
    assert len(notes(Outcome(50, 40, 9, LINKS, 0.1))) == 1
    assert "uncertain" in notes(Outcome(50, 50, 1.0, LINKS, 0.1))[0]
