"""Worker thread that does all computation: calls of callbacks, poses for every page, and pieces of jobs.

Solving and rendering share caches and use every core, and so run one after another, in this order of priority: calls,
poses, pieces of jobs.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any, TypeVar

import torch

from ..runtime import addresses
from .pose_schedule import PoseSchedule, Wanted

Result = TypeVar("Result")
PATIENCE = 1.0
"""Seconds after which a piece of a job takes precedence over poses."""


class Worker:
    """Thread that runs calls and computes the poses that ``schedule`` says are due.

    Args:
        schedule: poses that are due; guarded by this worker's lock.
        pose: called with (client, wanted) without the lock, from this thread only.
        failed: called with the client and the error if ``pose`` raises, inside the ``except`` block; with 0 and the
            error if what ``post`` was given raises.
    """

    def __init__(
        self,
        schedule: PoseSchedule,
        pose: Callable[[int, Wanted | None], None],
        failed: Callable[[int, Exception], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.schedule, self._pose, self._failed, self._clock = schedule, pose, failed, clock
        self._condition = threading.Condition()
        self._calls: deque[tuple[Future[Any], Callable[[], Any]]] = deque()
        self._patient: deque[tuple[float, Future[Any], Callable[[], Any]]] = deque()
        self._stopped = False
        self._working = False
        self._thread = threading.Thread(target=self._run, name="editor", daemon=True)

    def start(self) -> None:
        addresses.start(self._thread)

    @property
    def here(self) -> bool:
        """True on the worker's own thread."""
        return threading.current_thread() is self._thread

    @property
    def idle(self) -> bool:
        """True if there is no work now, nor later unless something changes."""
        with self._condition:
            if self._working or self._calls or self._patient:
                return False
            return self.schedule.settled

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
        if self._thread.is_alive() and not self.here:
            self._thread.join(timeout=30)

    @contextlib.contextmanager
    def changing(self) -> Iterator[PoseSchedule]:
        """Yield the schedule for changes, under the lock; then compute what is due."""
        with self._condition:
            yield self.schedule
            self._condition.notify_all()

    def call(self, action: Callable[[], Result], *, patient: bool = False) -> Result:
        """Run ``action`` on the worker's thread and return its result.

        Args:
            patient: let poses go first, for at most ``PATIENCE`` seconds.

        Raises:
            concurrent.futures.CancelledError: the worker was stopped; or whatever ``action`` raises.
        """
        if self.here:
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
                future: Future[Any] = Future()
                future.add_done_callback(self._report)  # nobody waits for it
                self._calls.append((future, action))
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
                    self._condition.wait()
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
            overdue = bool(self._patient) and self._clock() - self._patient[0][0] > PATIENCE
            due = None if overdue else self.schedule.next()  # what is taken from the schedule must be sent
            if due is not None:
                client, wanted = due
                return lambda: self._send(client, wanted)
            if self._patient:
                _, future, action = self._patient.popleft()
                return lambda: _fulfil(future, action)
            return None

    def _report(self, future: Future[Any]) -> None:
        if future.cancelled():
            return
        try:
            future.result()
        except Exception as error:
            self._tell(0, error)

    def _send(self, client: int, wanted: Wanted | None) -> None:
        try:
            self._pose(client, wanted)
        except Exception as error:  # a failed pose must not end the editor
            self._tell(client, error)

    def _tell(self, client: int, error: Exception) -> None:
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
