"""Worker thread that does all computation: calls of callbacks, pictures for every client, and pieces of jobs.

Solving and rendering share caches and use every core, and so run one after another, in this order of priority: calls,
pictures, pieces of jobs.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Protocol, TypeVar

import torch

Result = TypeVar("Result")
PATIENCE = 1.0
"""Seconds after which a piece of a job takes precedence over pictures."""


class Schedule(Protocol):
    """Order of the work that pages wait for; the worker's lock guards it."""

    def next(self, now: float, busy: bool) -> tuple[int, Any] | None: ...
    def settled(self, now: float, busy: bool) -> bool: ...
    def wait(self, now: float, busy: bool) -> float | None: ...


class Worker:
    """Thread that runs calls and draws the pictures that ``schedule`` says are due.

    Args:
        schedule: pictures that are due; guarded by this worker's lock.
        draw: called with (client, quality) without the lock, from this thread only.
        busy: returns whether something is being dragged or played.
        failed: called with the client and the error if ``draw`` raises, inside the ``except`` block.
    """

    def __init__(
        self,
        schedule: Any,
        draw: Callable[[int, Any], None],
        busy: Callable[[], bool],
        clock: Callable[[], float] = time.monotonic,
        failed: Callable[[int, Exception], None] | None = None,
    ) -> None:
        self._failed = failed
        self.schedule, self._draw, self._busy, self._clock = schedule, draw, busy, clock
        self._condition = threading.Condition()
        self._calls: deque[tuple[Future[Any], Callable[[], Any]]] = deque()
        self._patient: deque[tuple[float, Future[Any], Callable[[], Any]]] = deque()
        self._stopped = False
        self._working = False
        self._thread = threading.Thread(target=self._run, name="editor", daemon=True)

    def start(self) -> None:
        self._thread.start()

    @property
    def idle(self) -> bool:
        """True if there is no work now, nor later unless something changes."""
        with self._condition:
            if self._working or self._calls or self._patient:
                return False
            return self.schedule.settled(self._clock(), self._busy())

    @property
    def backlog(self) -> int:
        """Number of calls that wait."""
        with self._condition:
            return len(self._calls)

    def stop(self) -> None:
        """Finish the present task, cancel waiting calls, and return."""
        with self._condition:
            self._stopped = True
            waiting = [call[0] for call in self._calls] + [call[1] for call in self._patient]
            self._calls.clear()
            self._patient.clear()
            self._condition.notify_all()
        for future in waiting:
            future.cancel()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join(timeout=30)

    @contextlib.contextmanager
    def changing(self):
        """Yield the schedule for changes, under the lock; then draw what is due."""
        with self._condition:
            yield self.schedule
            self._condition.notify_all()

    def call(self, action: Callable[[], Result], *, patient: bool = False) -> Result:
        """Run ``action`` on the worker's thread and return its result.

        Args:
            patient: let pictures go first, for at most ``PATIENCE`` seconds.

        Raises:
            concurrent.futures.CancelledError: the worker was stopped; or whatever ``action`` raises.
        """
        if threading.current_thread() is self._thread:
            return action()
        future: Future[Result] = Future()
        with self._condition:
            if self._stopped:
                future.cancel()
            elif patient:
                self._patient.append((self._clock(), future, action))
            else:
                self._calls.append((future, action))
            self._condition.notify_all()
        return future.result()

    def post(self, action: Callable[[], Any], *, once: bool = False) -> None:
        """Run ``action`` on the worker's thread soon, without waiting for it; nothing happens after ``stop``.

        Args:
            once: leave it out if the same function is waiting already.
        """
        with self._condition:
            if not self._stopped and not (once and any(call[1] == action for call in self._calls)):
                self._calls.append((Future(), action))
                self._condition.notify_all()

    def _run(self) -> None:
        torch.set_flush_denormal(True)  # set per thread; without it results differ from a script's
        while True:
            with self._condition:
                task = self.next_task()
                while task is None:
                    if self._stopped:
                        return
                    self._working = False
                    self._condition.wait(self.schedule.wait(self._clock(), self._busy()))
                    task = self.next_task()
                self._working = True
            task()

    def next_task(self) -> Callable[[], None] | None:
        """Take the next piece of work; the worker's thread runs it. None: nothing is due, or the worker was stopped."""
        with self._condition:
            if self._stopped:
                return None
            if self._calls:
                future, action = self._calls.popleft()
                return lambda: _fulfil(future, action)
            now = self._clock()
            due = self.schedule.next(now, self._busy())
            if self._patient and (due is None or now - self._patient[0][0] > PATIENCE):
                _, future, action = self._patient.popleft()
                return lambda: _fulfil(future, action)
            if due is None:
                return None
            client, quality = due
            return lambda: self._picture(client, quality)

    def _picture(self, client: int, quality: Any) -> None:
        try:
            self._draw(client, quality)
        except Exception as error:  # a failed picture must not end the editor
            if self._failed is None:
                traceback.print_exc(file=sys.stderr)
                return
            try:
                self._failed(client, error)
            except Exception:
                traceback.print_exc(file=sys.stderr)


def _fulfil(future: Future[Any], action: Callable[[], Any]) -> None:
    if not future.set_running_or_notify_cancel():
        return
    try:
        future.set_result(action())
    except BaseException as error:
        future.set_exception(error)
