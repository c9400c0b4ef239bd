"""Pictures in time: the newest and never a queue, calls first, jobs in the gaps. Files stay in their folder."""

from __future__ import annotations

import math
import threading
import time
from concurrent.futures import CancelledError

import pytest

from helpers.edit_scenes import bar_scene
from scgs_warp.edit import EditSession, Film, render_film
from scgs_warp.editor import files
from scgs_warp.editor.jobs import Jobs
from scgs_warp.editor.views import FULL, LOW, MIN_SIZE, STILL, ClientCamera, Pace, PictureSchedule
from scgs_warp.editor.worker import PATIENCE, Worker
from scgs_warp.errors import UserError


def camera(x: float = 0.0, width: int = 100) -> ClientCamera:
    return ClientCamera((1.0, 0.0, 0.0, 0.0), (x, 0.0, -4.0), 0.7, width, 50)


def test_low_while_moving_then_full():
    schedule = PictureSchedule()
    schedule.move(1, camera(), 10.0)
    assert schedule.next(10.0, False) == (1, LOW) and schedule.next(10.0, False) is None
    assert schedule.wait(10.1, False) == pytest.approx(STILL - 0.1)
    schedule.move(1, camera(1.0), 10.2)
    assert schedule.next(10.2, False) == (1, LOW)
    assert not schedule.settled(10.2 + STILL / 2, False)
    assert schedule.next(10.3 + STILL, False) == (1, FULL) and schedule.next(20.0, False) is None
    assert schedule.settled(20.0, False) and schedule.wait(20.0, False) is None
    schedule.move(1, camera(1.0), 30.0)
    assert schedule.next(40.0, False) is None, "a camera that stays is no change"
    schedule.change(50.0)
    assert schedule.next(50.0, True) == (1, LOW) and schedule.next(60.0, True) is None, "while dragged never in full"
    assert schedule.next(60.0, False) == (1, FULL)


def test_clients_take_turns_and_leave():
    schedule = PictureSchedule()
    for number in (1, 2):
        schedule.move(number, camera(), 0.0)
    drawn = []
    for now in (1.0, 2.0, 3.0, 4.0):
        schedule.change(now)
        drawn.append(schedule.next(now, True)[0])
    assert drawn == [1, 2, 1, 2]
    schedule.drop(1)
    assert len(schedule) == 1 and schedule.camera(1) is None


@pytest.mark.parametrize(
    "broken",
    [camera(math.nan), camera(width=0), ClientCamera((0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.7, 10, 10)],
)
def test_windows_that_cannot_be_drawn_wait(broken):
    schedule = PictureSchedule()
    schedule.move(1, broken, 0.0)
    assert schedule.next(1.0, False) is None and schedule.wait(1.0, False) is None and schedule.settled(1.0, False)


def test_cameras_keep_their_field_of_view():
    small, half = camera().at_size(50), camera().at_size(50, 0.5)
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
            schedule.move(client, camera(x), time.monotonic())

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
        schedule.move(1, camera(), 0.0)
    worker.next_task()()
    assert done == [], "the picture first"
    worker.next_task()()
    assert done == [0], "then the job"
    now[0] = PATIENCE + 0.1
    with worker.changing() as schedule:
        schedule.change(now[0])
    worker.next_task()()
    assert done == [0, 1], "who has waited for long comes before a picture"


def test_jobs_one_at_a_time_with_progress():
    shown, ended = [], []
    jobs = Jobs(shown.append, lambda *what: ended.append(what))
    go = threading.Event()

    def work(advance):
        for _ in range(3):
            go.wait(10)
            advance()
        return "result"

    jobs.start("a film", 3, work, "me")
    with pytest.raises(UserError, match="a film is still running"):
        jobs.start("another", 1, work)
    go.set()
    assert jobs.wait(10)
    assert ended == [("me", "a film", "result", None)] and shown[0].total == 3 and shown[-1] is None
    assert any(one is not None and 0 < one.percent <= 100 for one in shown)


@pytest.mark.parametrize(
    ("error", "words"), [(UserError("no space"), "no space"), (ValueError("odd"), "ValueError: odd")]
)
def test_jobs_that_fail_say_so(error, words, capfd):
    ended = []
    jobs = Jobs(lambda progress: None, lambda *what: ended.append(what))

    def work(advance):
        raise error

    jobs.start("a film", 1, work)
    assert jobs.wait(10) and ended == [(None, "a film", None, words)]
    assert ("Traceback" in capfd.readouterr().err) == isinstance(error, ValueError)


def test_a_job_is_stopped_and_leaves_nothing(tmp_path):
    session = EditSession(bar_scene())
    session.apply(session.edit.__class__(film=Film(seconds=3.0, fps=10, size=32)))
    ended = []
    jobs = Jobs(lambda progress: None, lambda *what: ended.append(what))

    def work(advance):
        def slowly() -> None:
            advance()
            jobs.cancel()

        return render_film(session, tmp_path / "film.mp4", slowly)

    jobs.start("a film", 30, work)
    jobs.stop()
    assert ended == [(None, "a film", None, "stopped; nothing was written")] and list(tmp_path.iterdir()) == []
    jobs.cancel()


@pytest.mark.parametrize(
    "name",
    ["", "..", "../a", "a/b", "/etc/passwd", "a\\b", ".hidden", "a\nb", "C:a", "a" * 200, "-rf", "a.", "caf\u00e9"],
)
def test_names_lead_nowhere_else(tmp_path, name):
    with pytest.raises(UserError, match="file name"):
        files.output_path(tmp_path / "edits", name, ".json")
    assert not (tmp_path / "edits").exists()


def test_names(tmp_path):
    folder = tmp_path / "edits"
    assert files.saved_edits(folder) == ()
    assert files.output_path(folder, " raise arm.v2 ", ".json") == folder / "raise arm.v2.json"
    path = files.output_path(folder, "raise.JSON", ".json")
    assert path == folder / "raise.json"
    path.write_text("{}")
    assert files.saved_edits(folder) == ("raise.json",)
    (folder / "link.json").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="link"):
        files.output_path(folder, "link", ".json")
    with pytest.raises(UserError, match="cannot be made"):
        files.output_path(path, "a", ".json")
    for name in ("-rf.json", "caf\u00e9.json", "a..json", f"{'a' * 120}.json"):
        (folder / name).write_text("{}")
    assert files.saved_edits(folder) == ("raise.json",), "what is listed can be loaded"


def test_names_that_are_taken_are_numbered(tmp_path):
    long = tmp_path / f"{'a' * 100}.mp4"
    assert files.unused_path(long) == long
    for path in (tmp_path / "film.mp4", tmp_path / "film 2.mp4", long):
        path.write_text("")
    assert files.unused_path(tmp_path / "film.mp4") == tmp_path / "film 3.mp4"
    found = files.unused_path(long)
    assert found != long and files.output_path(tmp_path, found.name, ".mp4") == found
    (tmp_path / "gone.ply").symlink_to(tmp_path / "nowhere")
    assert files.unused_path(tmp_path / "gone.ply").name == "gone 2.ply"
