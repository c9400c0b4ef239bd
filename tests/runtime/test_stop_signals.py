"""Signals that ask a run to stop."""

from __future__ import annotations

import os
import signal
import threading

import pytest

from scgs_warp.runtime.stop_signals import like_ctrl_c, stop_signals

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


@pytest.mark.skipif(os.name != "posix", reason="signals of this kind are of POSIX")
@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_asks_and_the_handler_comes_back(number: int):
    def own(*_) -> None:
        raise AssertionError("the earlier handler must not run")

    before = signal.signal(number, own)
    try:
        with stop_signals() as asked:
            assert not asked.is_set()
            os.kill(os.getpid(), number)
            assert asked.wait(5)
            if number != signal.SIGINT:
                os.kill(os.getpid(), number)  # they come twice of themselves
        assert signal.getsignal(number) is own
    finally:
        signal.signal(number, before)


@pytest.mark.skipif(os.name != "posix", reason="signals of this kind are of POSIX")
def test_a_second_interrupt_ends_the_process():
    with pytest.raises(KeyboardInterrupt), stop_signals() as asked:
        os.kill(os.getpid(), signal.SIGINT)
        assert asked.wait(5)
        os.kill(os.getpid(), signal.SIGINT)
        asked.wait(5)


@pytest.mark.skipif(os.name != "posix", reason="signals of this kind are of POSIX")
@pytest.mark.parametrize("number", SIGNALS[1:])
def test_a_signal_is_taken_for_ctrl_c_once(number: int):
    before = signal.signal(number, signal.SIG_DFL)  # the tests themselves may run under nohup
    try:
        with pytest.raises(KeyboardInterrupt), like_ctrl_c():
            try:
                os.kill(os.getpid(), number)
            finally:
                os.kill(os.getpid(), number)  # it comes again while files are removed
        assert signal.getsignal(number) is signal.SIG_DFL
    finally:
        signal.signal(number, before)


def test_other_threads_leave_signals_alone():
    before, seen = signal.getsignal(signal.SIGINT), []

    def enter() -> None:
        with stop_signals() as asked:
            seen.append((asked.is_set(), signal.getsignal(signal.SIGINT) is before))

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert seen == [(False, True)]
