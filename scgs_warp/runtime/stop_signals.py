"""Signals with which a user, the system or a terminal asks a run to stop."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def stop_signals() -> Iterator[threading.Event]:
    """Turn Ctrl-C, SIGTERM and SIGHUP (a closed terminal) into a request to stop; a second Ctrl-C ends the process.

    A second SIGTERM or SIGHUP has no effect, because the shell and the system may each send one. Outside the main
    thread, signals are left alone.

    Yields:
        An event that is set once a stop is requested.
    """
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return

    def ask(number: int, frame: Any) -> None:
        if asked.is_set() and number == signal.SIGINT:
            raise KeyboardInterrupt
        asked.set()

    with _handled([signal.SIGINT, *_others()], ask):
        yield asked


@contextmanager
def like_ctrl_c() -> Iterator[None]:
    """Let SIGTERM and SIGHUP raise KeyboardInterrupt, as Ctrl-C does, so that unfinished files are removed.

    Further ones have no effect, as in :func:`stop_signals`. Outside the main thread, signals are left alone."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = _others()

    def end(number: int, frame: Any) -> None:
        for other in numbers:
            signal.signal(other, signal.SIG_IGN)
        raise KeyboardInterrupt

    with _handled(numbers, end):
        yield


def _others() -> list[int]:
    """Return the signals beside Ctrl-C that end a program."""
    hang_up = getattr(signal, "SIGHUP", None)  # not on Windows
    if hang_up is None or signal.getsignal(hang_up) == signal.SIG_IGN:  # under nohup the program continues
        return [signal.SIGTERM]
    return [signal.SIGTERM, hang_up]


@contextmanager
def _handled(numbers: list[int], handler: Callable[[int, Any], Any]) -> Iterator[None]:
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)
