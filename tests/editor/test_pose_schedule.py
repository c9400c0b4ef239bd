"""Order in which poses are computed."""

from __future__ import annotations

from scgs_warp.editor.pose_schedule import MAX_WANTED, PoseSchedule, Wanted


def drained(schedule: PoseSchedule) -> list[tuple[int, Wanted | None]]:
    found = []
    while (item := schedule.next()) is not None:
        found.append(item)
    assert schedule.settled
    return found


def test_the_pose_of_a_drag_comes_first_and_once():
    schedule = PoseSchedule()
    schedule.ask_frames(1, 5, [3])
    for _ in range(9):
        schedule.ask_live()
    assert not schedule.settled
    assert drained(schedule) == [(0, None), (1, Wanted(5, 3))]


def test_pages_take_turns_and_old_versions_are_dropped():
    schedule = PoseSchedule()
    schedule.ask_frames(1, 1, [7, 8])
    schedule.ask_frames(1, 2, [0, 1, 2, 1])
    schedule.ask_frames(2, 2, [9])
    schedule.ask_frames(3, 2, [4])
    schedule.drop(3)
    assert drained(schedule) == [(1, Wanted(2, 0)), (2, Wanted(2, 9)), (1, Wanted(2, 1)), (1, Wanted(2, 2))]


def test_requests_are_bounded():
    schedule = PoseSchedule()
    schedule.ask_frames(1, 1, list(range(3 * MAX_WANTED)))
    assert [wanted.frame for _, wanted in drained(schedule)] == list(range(2 * MAX_WANTED, 3 * MAX_WANTED))
