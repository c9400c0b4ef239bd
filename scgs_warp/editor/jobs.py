"""Background jobs: one at a time, with progress reports, and stoppable."""

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
from ..runtime import addresses

REPORT_SECONDS = 0.2
"""Shortest time between two progress reports in seconds."""


@dataclass(frozen=True)
class JobProgress:
    """Name of the running job and count of its finished pieces."""

    name: str
    done: int
    total: int
    stopping: bool = False

    @property
    def percent(self) -> float:
        return 100.0 * min(self.done / max(self.total, 1), 1.0)


class Jobs:
    """Runner of one job at a time, on a thread of its own.

    Args:
        shown: called with the progress from time to time, and with None when the job has ended.
        ended: called with the client that started the job, the job's name, its result (None: it failed or was
            stopped), and the reason if it has no result.
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
        """Run ``action(advance)``, which calls ``advance`` after each of ``total`` pieces; ``advance`` raises
        CancelledError once the job is cancelled.

        Raises:
            UserError: another job is running, or there is no room for its thread.
        """
        with self._lock:
            if self._progress is not None:
                raise UserError(f"{self._progress.name} is still running; wait for it, or stop it")
            self._stop.clear()
            self._progress = JobProgress(name, 0, total)
        self._shown(self._progress)
        thread = threading.Thread(target=self._run, args=(name, action, who), name="job", daemon=True)
        try:
            addresses.start(thread)
        except UserError:
            with self._lock:
                self._progress = None
            self._shown(None)
            raise
        self._thread = thread

    def cancel(self) -> None:
        """Ask the job to end after its present piece."""
        with self._lock:
            if self._progress is None:
                return
            self._stop.set()
            self._progress = JobProgress(self._progress.name, self._progress.done, self._progress.total, True)
        self._shown(self._progress)

    def stop(self) -> None:
        """Cancel the job and wait for its end."""
        self.cancel()
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(timeout=30)

    def wait(self, seconds: float) -> bool:
        """Wait for the job; return whether it has ended after ``seconds``."""
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
