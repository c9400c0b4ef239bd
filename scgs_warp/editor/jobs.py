"""Slow work in the background, one piece at a time, with its progress for all to see and a way to stop it."""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable
from concurrent.futures import CancelledError
from dataclasses import dataclass
from typing import Any

from ..errors import UserError

REPORT_SECONDS = 0.2
"""Seconds between two reports of progress."""


@dataclass(frozen=True)
class JobProgress:
    """What runs, how many of its pieces are done."""

    name: str
    done: int
    total: int
    stopping: bool = False

    @property
    def percent(self) -> float:
        return 100.0 * min(self.done / max(self.total, 1), 1.0)


class Jobs:
    """Runs one job at a time on a thread of its own.

    Args:
        shown: called with the progress now and then, and with None when nothing runs any more.
        ended: called with whoever started it, the job's name, what it returned (None: it failed or was stopped), and
            what to say if so.
    """

    def __init__(
        self, shown: Callable[[JobProgress | None], None], ended: Callable[[Any, str, Any, str | None], None]
    ) -> None:
        self._shown, self._ended = shown, ended
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._progress: JobProgress | None = None
        self._reported = 0.0

    @property
    def progress(self) -> JobProgress | None:
        return self._progress

    def start(self, name: str, total: int, action: Callable[[Callable[[], None]], Any], who: Any = None) -> None:
        """Run ``action(advance)``; it calls ``advance`` after each of ``total`` pieces, which raises CancelledError if
        the job is to end.

        Raises:
            UserError: another job runs.
        """
        with self._lock:
            if self._progress is not None:
                raise UserError(f"{self._progress.name} is still running; wait for it, or stop it")
            self._stop.clear()
            self._progress = JobProgress(name, 0, total)
        self._shown(self._progress)
        self._thread = threading.Thread(target=self._run, args=(name, action, who), name="job", daemon=True)
        self._thread.start()

    def cancel(self) -> None:
        """Ask the job to end; it does so after the piece under way."""
        with self._lock:
            if self._progress is None:
                return
            self._stop.set()
            self._progress = JobProgress(self._progress.name, self._progress.done, self._progress.total, True)
        self._shown(self._progress)

    def stop(self) -> None:
        """As ``cancel``, and wait for it."""
        self.cancel()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(timeout=30)

    def wait(self, seconds: float) -> bool:
        """Whether nothing runs, after at most so many seconds."""
        thread = self._thread
        if thread is not None:
            thread.join(timeout=seconds)
        return self._progress is None

    def _advance(self) -> None:
        if self._stop.is_set():
            raise CancelledError
        with self._lock:
            now = self._progress
            if now is None:
                return
            self._progress = JobProgress(now.name, now.done + 1, now.total)
        if time.monotonic() - self._reported >= REPORT_SECONDS:
            self._reported = time.monotonic()
            self._shown(self._progress)

    def _run(self, name: str, action: Callable[[Callable[[], None]], Any], who: Any) -> None:
        result, problem = None, None
        try:
            result = action(self._advance)
        except CancelledError:
            problem = "stopped; nothing was written"
        except UserError as error:
            problem = str(error)
        except Exception as error:
            traceback.print_exc(file=sys.stderr)
            problem = f"{type(error).__name__}: {error}"
        with self._lock:
            self._progress = None
        self._shown(None)
        self._ended(who, name, result, problem)
