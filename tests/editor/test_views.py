"""The schedule of pictures and their sizes."""

from __future__ import annotations

import math

import pytest

from helpers.editor_models import canvas_camera
from scgs_warp.editor.views import FULL, LOW, MIN_SIZE, STILL, ClientCamera, Pace, PictureSchedule


def test_low_while_moving_then_full():
    schedule = PictureSchedule()
    schedule.move(1, canvas_camera(), 10.0)
    assert schedule.next(10.0, False) == (1, LOW) and schedule.next(10.0, False) is None
    assert schedule.wait(10.1, False) == pytest.approx(STILL - 0.1)
    schedule.move(1, canvas_camera(1.0), 10.2)
    assert schedule.next(10.2, False) == (1, LOW)
    assert not schedule.settled(10.2 + STILL / 2, False)
    assert schedule.next(10.3 + STILL, False) == (1, FULL) and schedule.next(20.0, False) is None
    assert schedule.settled(20.0, False) and schedule.wait(20.0, False) is None
    schedule.move(1, canvas_camera(1.0), 30.0)
    assert schedule.next(40.0, False) is None, "a camera that stays is no change"
    schedule.change(50.0)
    assert schedule.next(50.0, True) == (1, LOW) and schedule.next(60.0, True) is None, "while dragged never in full"
    assert schedule.next(60.0, False) == (1, FULL)


def test_clients_take_turns_and_leave():
    schedule = PictureSchedule()
    for number in (1, 2):
        schedule.move(number, canvas_camera(), 0.0)
    drawn = []
    for now in (1.0, 2.0, 3.0, 4.0):
        schedule.change(now)
        drawn.append(schedule.next(now, True)[0])
    assert drawn == [1, 2, 1, 2]
    schedule.drop(1)
    assert len(schedule) == 1 and schedule.camera(1) is None


@pytest.mark.parametrize(
    "broken",
    [canvas_camera(math.nan), canvas_camera(width=0), ClientCamera((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.7, 10, 10)],
)
def test_windows_that_cannot_be_drawn_wait(broken):
    schedule = PictureSchedule()
    schedule.move(1, broken, 0.0)
    assert schedule.next(1.0, False) is None and schedule.wait(1.0, False) is None and schedule.settled(1.0, False)


def test_cameras_keep_their_field_of_view():
    small, half = canvas_camera().at_size(50), canvas_camera().at_size(50, 0.5)
    assert (small.width, small.height) == (50, 25) and (half.width, half.height) == (25, 25)
    assert float(small.K[1, 1]) == float(half.K[1, 1]) == pytest.approx(25 / (2 * math.tan(0.35)))
    assert float(half.K[0, 2]) == 12.5


def test_pace_finds_the_size():
    pace = Pace(0.1, 512, 1024)
    for _ in range(30):
        pace.took(1e-6 * pace.size**2)  # 0.1 s at 316
    assert 290 <= pace.size <= 340
    for _ in range(60):
        pace.took(100.0)
    assert pace.size == MIN_SIZE
    for _ in range(60):
        pace.took(0.0)
    assert pace.size == 1024
