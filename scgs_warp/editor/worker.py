"""The one thread that computes: pictures for every client, what callbacks ask for, and jobs in the gaps.

Solving and rendering keep caches and use every core, so they happen one after the other. What a user waits for comes
first: calls, then pictures, then the pictures of a film in the making.
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
from typing import Any, TypeVar

import torch

from .views import PictureSchedule

Result = TypeVar("Result")
PATIENCE = 1.0
"""Seconds after which a job's call comes before the next picture."""


class Worker:
    """Runs calls and draws the pictures that ``views`` says are due.

    Args:
        views: who needs a picture; guarded by this worker's lock.
        draw: called with (client, quality) without the lock, from this thread only.
        busy: whether something is being dragged or played.
        failed: called with the client and the error where ``draw`` raises, while that is being handled.
    """

    def __init__(
        self,
        schedule: PictureSchedule,
        draw: Callable[[int, str], None],
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
        """Whether there is nothing to do and nothing will be unless something changes."""
        with self._condition:
            if self._working or self._calls or self._patient:
                return False
            return self.schedule.settled(self._clock(), self._busy())

    def stop(self) -> None:
        """Returns when the picture under way is done; calls that still wait are cancelled."""
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
        """Hold this to change ``views``; whatever is due then is drawn."""
        with self._condition:
            yield self.schedule
            self._condition.notify_all()

    def call(self, action: Callable[[], Result], *, patient: bool = False) -> Result:
        """What ``action`` returns, computed on the worker's thread.

        Args:
            patient: pictures for users come first, but not for ever.

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

    def _run(self) -> None:
        torch.set_flush_denormal(True)  # a property of the thread: without it bits differ from a script's
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

    def _picture(self, client: int, quality: str) -> None:
        try:
            self._draw(client, quality)
        except Exception as error:  # a picture that fails must not take the editor with it
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
