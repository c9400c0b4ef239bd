"""The worker: calls first, newest pictures only, jobs in between."""

from __future__ import annotations

import threading
import time
from concurrent.futures import CancelledError

import pytest

from helpers.editor_models import canvas_camera
from scgs_warp.editor.views import FULL, PictureSchedule
from scgs_warp.editor.worker import PATIENCE, Worker
from scgs_warp.errors import UserError


class Bench:
    """A worker that notes what it draws."""

    def __init__(self) -> None:
        self.drawn: list[tuple[int, str]] = []
        self.gate = threading.Event()
        self.gate.set()
        self.worker = Worker(PictureSchedule(), self.draw, lambda: False)
        self.worker.start()

    def draw(self, client: int, quality: str) -> None:
        self.gate.wait(10)
        self.drawn.append((client, quality))
        if client == 13:
            raise ValueError("a picture that fails")

    def move(self, client: int, x: float) -> None:
        with self.worker.changing() as schedule:
            schedule.move(client, canvas_camera(x), time.monotonic())

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


def test_the_worker_draws_the_newest_only(bench):
    bench.gate.clear()
    for step in range(50):
        bench.move(1, float(step))
        time.sleep(0.002)
    bench.gate.set()
    bench.settle()
    assert bench.drawn[-1] == (1, FULL) and 2 <= len(bench.drawn) <= 4


def test_a_picture_that_fails_takes_nobody_along(bench, capfd):
    bench.move(13, 0.0)
    bench.settle()
    bench.move(1, 0.0)
    bench.settle()
    assert bench.drawn[-1] == (1, FULL) and "a picture that fails" in capfd.readouterr().err


def test_calls_return_raise_and_are_cancelled(bench):
    name = bench.worker.call(lambda: threading.current_thread().name)
    assert name == "editor" and bench.worker.call(lambda: bench.worker.call(lambda: 3)) == 3
    with pytest.raises(UserError, match="no"):
        bench.worker.call(lambda: (_ for _ in ()).throw(UserError("no")))
    bench.gate.clear()
    bench.move(1, 0.0)
    time.sleep(0.05)
    caught = []

    def ask() -> None:
        try:
            bench.worker.call(lambda: 1)
        except CancelledError as error:
            caught.append(error)

    asking = threading.Thread(target=ask)
    asking.start()
    time.sleep(0.05)
    stopping = threading.Thread(target=bench.worker.stop)
    stopping.start()
    asking.join(10)
    bench.gate.set()
    stopping.join(10)
    assert caught and not stopping.is_alive()
    with pytest.raises(CancelledError):
        bench.worker.call(lambda: 1)


def test_patient_calls_wait_for_pictures_but_not_for_ever():
    now = [0.0]
    worker = Worker(PictureSchedule(), lambda client, quality: None, lambda: True, lambda: now[0])
    done = []
    for index in range(2):
        waiting = threading.Thread(
            target=lambda i=index: worker.call(lambda: done.append(i), patient=True), daemon=True
        )
        waiting.start()
        time.sleep(0.05)
    with worker.changing() as schedule:
        schedule.move(1, canvas_camera(), 0.0)
    worker.next_task()()
    assert done == [], "the picture first"
    worker.next_task()()
    assert done == [0], "then the job"
    now[0] = PATIENCE + 0.1
    with worker.changing() as schedule:
        schedule.change(now[0])
    worker.next_task()()
    assert done == [0, 1], "who has waited for long comes before a picture"


def test_whoever_asked_for_a_picture_that_fails_is_told():
    told = []

    def fail(client: int, quality: str) -> None:
        raise UserError("no room")

    worker = Worker(
        PictureSchedule(), fail, lambda: False, failed=lambda client, error: told.append((client, str(error)))
    )
    with worker.changing() as schedule:
        schedule.move(3, canvas_camera(), 0.0)
    task = worker.next_task()
    assert task is not None
    task()
    assert told == [(3, "no room")]
