"""Scene time at moments of the film."""

from __future__ import annotations

import pytest

from scgs_warp.edit import Playback
from scgs_warp.errors import UserError


@pytest.mark.parametrize(
    ("playback", "times"),
    [
        (Playback(), [0.0, 0.25, 0.5, 1.0, 1.0]),
        (Playback(speed=0.5), [0.0, 0.125, 0.25, 0.5, 0.75]),
        (Playback(speed=-1.0), [1.0, 0.75, 0.5, 0.0, 0.0]),
        (Playback(seconds=2.0, repeat="loop"), [0.0, 0.5, 0.0, 0.0, 0.0]),
        (Playback(seconds=2.0, repeat="swing"), [0.0, 0.5, 1.0, 0.0, 1.0]),
        (Playback(freeze=0.3), [0.3] * 5),
        (Playback(start=0.5, seconds=4.0), [0.5, 0.75, 1.0, 1.0, 1.0]),
        (Playback(map=((0.0, 0.2), (2.0, 0.8), (4.0, 0.4))), [0.2, 0.5, 0.8, 0.4, 0.4]),
    ],
)
def test_playback(playback, times):
    found = [playback.time_at(moment, 4.0) for moment in (0.0, 1.0, 2.0, 4.0, 6.0)]
    assert found == pytest.approx(times)


@pytest.mark.parametrize("field", [{"freeze": 3.0}, {"freeze": -0.1}, {"start": 2.0}, {"speed": float("nan")}])
def test_a_scene_time_outside_the_motion_is_refused(field):
    with pytest.raises(UserError, match=f"playback: {next(iter(field))} is"):
        Playback(**field)
