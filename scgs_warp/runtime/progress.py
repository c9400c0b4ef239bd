"""Progress display with rate and time left: a bar on a terminal, occasional plain lines in a log file.

``advance`` takes well under a microsecond unless a redraw is due, so that every training step may call it.
"""

from __future__ import annotations

import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from contextvars import ContextVar
from typing import Any, TextIO, TypeVar

REDRAW_SECONDS = 0.2
"""Seconds between two drawings on a terminal."""
LINE_FRACTION = 0.05
"""Fraction of the work after which a log file gets a line, within the two limits below."""
LINE_SHORTEST = 2.0
"""Smallest number of seconds between two lines in a log file."""
LINE_LONGEST = 30.0
"""Largest number of seconds between two lines in a log file."""
RATE_SECONDS = 15.0
"""Seconds over which the rate is measured: only recent steps count, because added Gaussians slow the steps down."""

Result = TypeVar("Result")
Report = Callable[[str, int, int], Any]
"""Function that is called with (work, done, total) after each step."""
ShowProgress = Callable[[int, str], AbstractContextManager[Any]]
"""Function from a number of steps and the name of the work to a context manager like that of :func:`progress`."""
_report: ContextVar[Report | None] = ContextVar("report", default=None)


@contextmanager
def reported(report: Report) -> Iterator[None]:
    """Call ``report`` with (work, done, total) after each step, instead of drawing progress and printing lines."""
    token = _report.set(report)
    try:
        yield
    finally:
        _report.reset(token)


def quiet() -> AbstractContextManager[None]:
    """Draw no progress and print no line."""
    return reported(lambda work, done, total: None)


def mute(stream: TextIO) -> None:
    """Discard all further output to ``stream``, whose terminal is closed or whose pipe has no reader."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def encodable(text: str, stream: TextIO | None) -> str:
    """Return a text with the characters escaped that a stream cannot encode: lines name files, and a program's output
    may go to a file in the encoding of the system."""
    encoding = getattr(stream, "encoding", None) or "utf-8"
    return text.encode(encoding, "backslashreplace").decode(encoding)


def say(text: str) -> None:
    """Print a line on standard output. A closed terminal or pipe does not raise an error."""
    if _report.get() is not None:
        return
    try:
        print(encodable(text, sys.stdout), flush=True)
    except OSError:
        mute(sys.stdout)


def clock(seconds: float) -> str:
    """Format seconds as ``1:02:03`` or ``2:03``."""
    minutes, second = divmod(int(seconds + 0.5), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02d}:{second:02d}" if hours else f"{minute}:{second:02d}"


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.2f}" if abs(value) >= 0.1 or value == 0 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


class Progress:
    """Number of finished steps and newest value of each field, drawn from time to time."""

    def __init__(self, total: int, description: str, stream: TextIO, start: int = 0) -> None:
        self.total = total
        self.done = start
        self.description = description
        self.fields: dict[str, Any] = {}
        self.stop: Callable[[], object] | None = None
        """Called if the function of ``reported`` raises an error, which is then kept; None: the error is raised."""
        self.raised: BaseException | None = None
        """Error of the function of ``reported``, for the loop to raise once it has stopped."""
        self._stream = stream
        self._began = time.perf_counter()
        self._start = start
        self._marks: deque[tuple[float, int]] = deque([(self._began, start)])
        self._next = self._last = self._began

    def advance(self, n: int = 1, **fields: Any) -> None:
        """Count ``n`` more steps; ``fields`` (numbers, text) replace those of the same name, and None removes one. A
        total that turns out too small, as of a film whose header does not count its frames, grows."""
        self.done += n
        self.total = max(self.total, self.done)
        if fields:
            self.fields.update(fields)
        now = self._last = time.perf_counter()
        if now >= self._next:
            self._next = self._safely(lambda: self._draw(now), now)

    def beside(self, **fields: Any) -> None:
        """Replace fields during work that is no step; its time, since the last call, does not count in the rate."""
        now = time.perf_counter()
        self._marks = deque((then + now - self._last, done) for then, done in self._marks)
        self.advance(0, **fields)

    def print(self, text: str) -> None:
        """Print a line that stays, above the bar."""
        self._safely(lambda: self._print(text), None)

    def finish(self, completed: bool = True) -> None:
        """Draw the last state; called by ``progress``."""
        self._safely(lambda: self._finish(completed), None)

    def _safely(self, draw: Callable[[], Result], otherwise: Result) -> Result:
        """Draw, or return ``otherwise`` and stop all output if the terminal is closed or the pipe has no reader."""
        try:
            return draw()
        except OSError:
            mute(self._stream)
            return otherwise

    def _print(self, text: str) -> None:
        print(encodable(text, self._stream), file=self._stream, flush=True)

    def _finish(self, completed: bool) -> None:
        raise NotImplementedError

    def _draw(self, now: float) -> float:
        """Draw the state and return the time of the next drawing."""
        raise NotImplementedError

    def _mark(self, now: float) -> None:
        self._marks.append((now, self.done))
        while len(self._marks) > 2 and now - self._marks[1][0] > RATE_SECONDS:
            self._marks.popleft()

    @property
    def elapsed(self) -> float:
        """Number of seconds since the start."""
        return time.perf_counter() - self._began

    @property
    def rate(self) -> float:
        """Steps per second over the last ``RATE_SECONDS``; 0 while unknown."""
        (then, before), (now, after) = self._marks[0], self._marks[-1]
        return (after - before) / (now - then) if now > then else 0.0

    def describe_rate(self) -> str:
        """Format the rate as ``12.3 it/s``, or as ``4.5 s/it`` if a step takes longer than a second."""
        rate = self.rate
        if rate <= 0:
            return "- it/s"
        return f"{rate:.1f} it/s" if rate >= 1 else f"{1 / rate:.1f} s/it"

    def describe_left(self) -> str:
        """Format the time left as ``2:03``, or ``-`` while it is unknown."""
        return clock(max(self.total - self.done, 0) / self.rate) if self.rate > 0 else "-"

    def describe_fields(self) -> str:
        return "  ".join(f"{name} {_text(value)}" for name, value in self.fields.items() if value is not None)


class _Reported(Progress):
    """Steps that a function is told of, and nothing printed."""

    def advance(self, n: int = 1, **fields: Any) -> None:
        self.done += n
        self.total = max(self.total, self.done)
        report = _report.get()
        if report is None or self.raised is not None:
            return
        try:
            report(self.description, self.done, self.total)
        except BaseException as error:
            if self.stop is None:
                raise
            self.raised = error
            self.stop()

    def _print(self, text: str) -> None:
        pass

    def _finish(self, completed: bool) -> None:
        pass


class _LogLines(Progress):
    """Plain lines from time to time, for log files, to which rich would write only the final state."""

    def __init__(self, total: int, description: str, stream: TextIO, start: int) -> None:
        super().__init__(total, description, stream, start)
        self._line_at, self._line_done = self._began, start

    def _draw(self, now: float) -> float:
        self._mark(now)
        waited = now - self._line_at
        if waited >= LINE_LONGEST or (
            waited >= LINE_SHORTEST and self.done - self._line_done >= LINE_FRACTION * self.total
        ):
            self._line_at, self._line_done = now, self.done
            self._line(f"{self.describe_rate()}  elapsed {clock(self.elapsed)}  left {self.describe_left()}")
        return now + 0.5

    def _line(self, timing: str) -> None:
        share = 100 * self.done / self.total if self.total else 100
        parts = [f"{self.description} {self.done}/{self.total} ({share:.0f} %)", timing, self.describe_fields()]
        self._print("  ".join(part for part in parts if part))

    def _finish(self, completed: bool) -> None:
        elapsed = self.elapsed
        if not completed and self.done == self._start:
            return  # refused before the first step
        rate = (self.done - self._start) / elapsed if elapsed > 0 else 0.0
        self._line(f"{rate:.1f} it/s  {'done' if completed else 'stopped'} after {clock(elapsed)}")


class _TerminalBar(Progress):
    """A bar drawn by rich, for terminals. ``advance`` refreshes it: a separate thread would compete for a core."""

    def __init__(self, total: int, description: str, stream: TextIO, start: int) -> None:
        super().__init__(total, description, stream, start)
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn
        from rich.progress import Progress as RichProgress

        self._rich = RichProgress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=28),
            TextColumn("{task.completed}/{task.total}"),
            TextColumn("{task.fields[timing]}", style="cyan"),
            TextColumn("{task.fields[text]}", style="dim"),
            console=Console(file=stream),
            auto_refresh=False,
        )
        self._task = self._rich.add_task(description, total=total, completed=start, timing="", text="")
        self._safely(self._rich.start, None)

    def _draw(self, now: float) -> float:
        self._mark(now)
        timing = f"{self.describe_rate()}  {clock(self.elapsed)} < {self.describe_left()}"
        # rich would read [words] in square brackets as markup.
        text = self.describe_fields().replace("[", "(").replace("]", ")")
        self._rich.update(self._task, completed=self.done, total=self.total, timing=timing, text=text, refresh=True)
        return now + REDRAW_SECONDS

    def _print(self, text: str) -> None:
        self._rich.console.print(encodable(text, self._stream), markup=False, highlight=False)

    def _finish(self, completed: bool) -> None:
        self._draw(time.perf_counter())
        self._rich.stop()


@contextmanager
def progress(total: int, description: str, *, start: int = 0, stream: TextIO | None = None) -> Iterator[Progress]:
    """Show the progress of a loop of ``total`` steps.

    Args:
        total: number of steps.
        description: name of the work, in a word or two.
        start: steps done before (in a resumed run); they do not count for the rate.
        stream: output, by default standard output. A terminal gets a bar, anything else plain lines.

    Yields:
        An object whose ``advance(n=1, **fields)`` the loop calls.
    """
    # A daemon may have no standard output.
    shown_on: TextIO = stream or sys.stdout or open(os.devnull, "w", encoding="utf-8")
    report = _report.get()
    if report is not None:
        shown: Progress = _Reported(total, description, shown_on, start)
    else:
        shown = (_TerminalBar if shown_on.isatty() else _LogLines)(total, description, shown_on, start)
    try:
        yield shown
    except BaseException:
        shown.finish(completed=False)
        raise
    shown.finish()
