"""Background jobs: one at a time, with progress, stoppable."""

from __future__ import annotations

import threading

import pytest

from helpers.edit_scenes import bar_scene
from scgs_warp.edit import EditSession, Film, render_film
from scgs_warp.editor.jobs import Jobs
from scgs_warp.errors import UserError


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
