"""The worker: calls first, newest poses only, jobs in between."""

from __future__ import annotations

import threading
import time
from concurrent.futures import CancelledError

import pytest

from scgs_warp.editor.pose_schedule import PoseSchedule, Wanted
from scgs_warp.editor.worker import PATIENCE, Worker
from scgs_warp.errors import UserError

LIVE = (0, None)


def fail_loudly(client: int, error: Exception) -> None:
    raise AssertionError("no pose may fail here") from error


class Bench:
    """A worker that notes what it sends."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, Wanted | None]] = []
        self.failed: list[tuple[int, str]] = []
        self.begun = threading.Event()
        """Set when a pose is begun."""
        self.gate = threading.Event()
        self.gate.set()
        self.worker = Worker(PoseSchedule(), self.pose, self.fail)
        self.worker.start()

    def pose(self, client: int, wanted: Wanted | None) -> None:
        self.begun.set()
        assert self.gate.wait(20)
        self.sent.append((client, wanted))
        if client == 13:
            raise ValueError("a pose that fails")

    def fail(self, client: int, error: Exception) -> None:
        self.failed.append((client, str(error)))
        raise error  # whoever is told may fail as well

    def ask_live(self) -> None:
        with self.worker.changing() as schedule:
            schedule.ask_live()

    def ask(self, client: int, *frames: int) -> None:
        with self.worker.changing() as schedule:
            schedule.ask_frames(client, 1, list(frames))

    def block(self) -> None:
        """Let the worker begin a live pose, and keep it there until the gate is opened."""
        self.gate.clear()
        self.begun.clear()
        self.ask_live()
        assert self.begun.wait(20)

    def settle(self) -> None:
        end = time.monotonic() + 20
        while not self.worker.idle:
            assert time.monotonic() < end
            time.sleep(0.01)


@pytest.fixture
def bench():
    made = Bench()
    yield made
    made.gate.set()
    made.worker.stop()


def test_of_a_drag_the_newest_pose_only_is_computed(bench):
    bench.block()
    for _ in range(50):
        bench.ask_live()
    bench.ask(2, 7)
    assert not bench.worker.idle
    bench.gate.set()
    bench.settle()
    assert bench.sent == [LIVE, LIVE, (2, Wanted(1, 7))]


def test_calls_go_before_poses(bench):
    bench.block()
    bench.ask_live()
    order = []
    bench.worker.post(lambda: order.append(len(bench.sent)))
    bench.gate.set()
    bench.settle()
    assert order == [1] and bench.sent == [LIVE, LIVE]


def test_a_pose_that_fails_takes_nobody_along(bench, capfd):
    bench.ask(13, 0)
    bench.settle()
    bench.ask(1, 4)
    bench.settle()
    assert bench.sent[-1] == (1, Wanted(1, 4)) and bench.failed == [(13, "a pose that fails")]
    assert "a pose that fails" in capfd.readouterr().err, "the error of whoever is told is printed"


def test_what_is_posted_and_fails_is_told(bench):
    bench.worker.post(lambda: (_ for _ in ()).throw(UserError("posted")))
    bench.settle()
    assert bench.failed == [(0, "posted")]
    bench.block()
    bench.worker.post(lambda: 1)
    stopping = threading.Thread(target=bench.worker.stop)
    stopping.start()
    bench.gate.set()
    stopping.join(10)
    assert bench.failed == [(0, "posted")], "what is cancelled has not failed"


def test_calls_return_raise_and_are_cancelled(bench):
    name = bench.worker.call(lambda: threading.current_thread().name)
    assert name == "editor" and bench.worker.call(lambda: bench.worker.call(lambda: 3)) == 3
    with pytest.raises(UserError, match="no"):
        bench.worker.call(lambda: (_ for _ in ()).throw(UserError("no")))
    bench.block()
    caught = []

    def ask() -> None:
        try:
            bench.worker.call(lambda: 1)
        except CancelledError as error:
            caught.append(error)

    asking = threading.Thread(target=ask)
    asking.start()
    end = time.monotonic() + 20
    while not bench.worker.backlog and time.monotonic() < end:
        time.sleep(0.005)
    stopping = threading.Thread(target=bench.worker.stop)
    stopping.start()
    asking.join(10)
    bench.gate.set()
    stopping.join(10)
    assert caught and not stopping.is_alive()
    with pytest.raises(CancelledError):
        bench.worker.call(lambda: 1)


def test_patient_calls_wait_for_poses_but_not_for_ever():
    now = [0.0]
    sent: list[tuple[int, Wanted | None]] = []
    worker = Worker(PoseSchedule(), lambda *pose: sent.append(pose), fail_loudly, lambda: now[0])
    done = []

    def work() -> None:
        task = worker.next_task()
        assert task is not None
        task()

    for index in range(2):
        waiting = threading.Thread(
            target=lambda i=index: worker.call(lambda: done.append(i), patient=True), daemon=True
        )
        waiting.start()
        end = time.monotonic() + 20
        while len(worker._patient) <= index and time.monotonic() < end:
            time.sleep(0.005)
    with worker.changing() as schedule:
        schedule.ask_live()
    work()
    assert done == [] and sent == [LIVE], "the pose first"
    work()
    assert done == [0], "then the job"
    now[0] = PATIENCE + 0.1
    with worker.changing() as schedule:
        schedule.ask_frames(1, 1, [5])
    work()
    assert done == [0, 1] and sent == [LIVE], "who has waited for long comes before a pose"
    work()
    assert sent == [LIVE, (1, Wanted(1, 5))], "which is not lost"
    assert worker.next_task() is None and worker.idle


def test_whoever_asked_for_a_pose_that_fails_is_told():
    told = []

    def fail(client: int, wanted: Wanted | None) -> None:
        raise UserError("no room")

    worker = Worker(PoseSchedule(), fail, lambda client, error: told.append((client, str(error))))
    with worker.changing() as schedule:
        schedule.ask_frames(3, 1, [0])
    task = worker.next_task()
    assert task is not None
    task()
    assert told == [(3, "no room")]
