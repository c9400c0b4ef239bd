"""Progress on a terminal, in a log file, and where nobody reads it."""

from __future__ import annotations

import io
import os

import pytest

from scgs_warp.runtime import progress as module
from scgs_warp.runtime.progress import clock, progress, reported, say


@pytest.mark.parametrize(("seconds", "text"), [(0, "0:00"), (59.6, "1:00"), (123, "2:03"), (3723, "1:02:03")])
def test_clock(seconds: float, text: str) -> None:
    assert clock(seconds) == text


def test_a_log_file_gets_few_lines(capsys: pytest.CaptureFixture) -> None:
    with progress(1000, "train") as shown:
        for _ in range(1000):
            shown.advance(psnr=31.234, gaussians=12345, stage="main", gone=None)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 3
    assert "train 1000/1000 (100 %)" in lines[-1] and "it/s" in lines[-1]
    assert "psnr 31.23  gaussians 12,345  stage main" in lines[-1] and "gone" not in lines[-1]


def test_the_last_line_tells_where_it_was_stopped(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(KeyboardInterrupt), progress(10, "train") as shown:
        shown.advance(3)
        raise KeyboardInterrupt
    assert "train 3/10 (30 %)" in capsys.readouterr().out


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_gets_a_bar_and_lines_above_it() -> None:
    stream = Terminal()
    with progress(10, "train", start=4, stream=stream) as shown:
        shown.print("a line [red] that stays")
        for _ in range(6):
            shown.advance(loss=0.5)
    text = stream.getvalue()
    assert "a line [red] that stays" in text and "10/10" in text and "loss 0.50" in text


def test_steps_before_a_resumed_run_do_not_count_for_the_rate() -> None:
    with progress(10, "train", start=8, stream=io.StringIO()) as shown:
        assert shown.rate == 0.0 and shown.describe_rate() == "- it/s" and shown.describe_left() == "-"
        shown.advance(2)
        assert shown.done == 10


class Broken(io.StringIO):
    """A pipe that nobody reads."""

    def __init__(self) -> None:
        super().__init__()
        self.file = open(os.devnull, "w")

    def write(self, text: str) -> int:
        raise BrokenPipeError

    def fileno(self) -> int:
        return self.file.fileno()


def test_work_beside_the_steps_does_not_count_for_the_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr(module.time, "perf_counter", lambda: now)
    bar = module._LogLines(100, "training", io.StringIO(), 0)
    for _ in range(10):
        now += 1.0
        bar.advance(1)
    for _ in range(5):
        now += 20.0
        bar.beside(turns="looking")
    now += 1.0
    bar.advance(1)
    bar.beside(turns=None)
    assert bar.rate == pytest.approx(1.0)
    assert bar.fields["turns"] is None


def test_work_goes_on_where_nobody_reads() -> None:
    stream = Broken()
    with progress(3, "train", stream=stream) as shown:
        shown.print("unread")
        for _ in range(3):
            shown.advance()
    assert shown.done == 3
    stream.file.close()


def test_what_a_stream_cannot_encode_is_escaped(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.TextIOWrapper(io.BytesIO(), encoding="cp1252")
    monkeypatch.setattr("sys.stdout", stream)
    say("\u6570\u636e/\udcff: 3 images left out")
    with progress(1, "training") as shown:
        shown.print("runs/\u6570\u636e")
        shown.advance(note="\u2192")
    stream.seek(0)
    lines = stream.buffer.read().decode("cp1252").splitlines()
    assert (
        lines[:2] == [r"\u6570\u636e/\udcff: 3 images left out", r"runs/\u6570\u636e"] and r"note \u2192" in lines[-1]
    )


def test_say_prints_one_line(capsys: pytest.CaptureFixture) -> None:
    say("done")
    assert capsys.readouterr().out == "done\n"


def test_a_total_that_is_too_small_grows(capsys: pytest.CaptureFixture) -> None:
    """Films that were recorded by a browser do not say how many frames they have."""
    seen: list[tuple[int, int]] = []
    with progress(1, "looking") as bar:
        for _ in range(24):
            bar.advance()
    assert "looking 24/24 (100 %)" in capsys.readouterr().out
    with reported(lambda work, done, total: seen.append((done, total))), progress(1, "looking") as bar:
        bar.advance(3)
    assert seen == [(3, 3)]
