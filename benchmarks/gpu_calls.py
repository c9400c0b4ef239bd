"""One call of ``gpu_check``: which part runs next, in a process of its own, and what becomes of it at the deadline.

A part that crashes, hangs, or leaves the GPU in an error thus takes no other part with it.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from gpu_session import CUT, FAILED, NOT_RUN, PASSED, UNFINISHED, Part, Record

from scgs_warp.runtime.progress import clock, say

SCRIPT = Path(__file__).with_name("gpu_check.py")
STARTS_WITH = 40.0
"""Least number of seconds left for a part that can continue later."""
HANGS_AFTER = 4.0, 120.0
"""A part that takes this many times its estimate, and this many seconds, hangs."""
TO_STOP = 10.0
"""Seconds that a part which can continue has after the deadline, to save its progress."""
LOOKS_EVERY = 0.1
LONGER = 1.5
"""Ratio of the new estimate to the time that a part had until it was cut off."""
END_OF_OUTPUT = 3000
"""Number of characters of a dead part's messages that are kept."""


class Plan(NamedTuple):
    parts: Mapping[str, Part]
    """The parts of this call, in order."""
    record: Record
    quick: bool
    deadline: float
    options: list[str]
    """Options of this call that its parts need, too."""
    work: Path
    blocked: Callable[[], str | None]
    """Says why no part that is ``timed`` can run now, if so."""


def run_parts(plan: Plan) -> None:
    """Run the parts that have not ended, until the deadline."""
    tried: list[str] = []
    while (name := _next(plan, tried)) is not None:
        tried.append(name)
        left = sum(_estimate(plan, other) for other in _open(plan, tried)) + _estimate(plan, name)
        number = list(plan.parts).index(name) + 1
        say(
            f"[{number}/{len(plan.parts)}] {name}: about {clock(_estimate(plan, name))}; all that is left about "
            f"{clock(left)}{_until(plan)}"
        )
        _run(plan, name)
        _tell(plan, name)
    for name in _open(plan, tried):
        before = plan.record.part(name)
        reason = (plan.parts[name].timed and plan.blocked()) or (
            f"no time left in this call: it takes about {clock(_estimate(plan, name))}"
        )
        plan.record.put(name, plan.record.state(name) or NOT_RUN, before, reason)
        _tell(plan, name)


def _open(plan: Plan, tried: list[str]) -> list[str]:
    ended = (PASSED, FAILED)
    return [name for name in plan.parts if name not in tried and plan.record.state(name) not in ended]


def _next(plan: Plan, tried: list[str]) -> str | None:
    """Return the first part that can run and end before the deadline; wait for one that is blocked, if it can then."""
    told = False
    while True:
        left, reason = plan.deadline - time.time(), plan.blocked()
        fitting = [name for name in _open(plan, tried) if _needs(plan, name) <= left]
        if not fitting and not tried and left > 0:
            fitting = _open(plan, tried)[:1]  # longer than a whole call, by the estimate: the estimate may be wrong
        free = [name for name in fitting if not (reason and plan.parts[name].timed)]
        if free or not fitting:
            return free[0] if free else None
        if not told:
            say(f"waiting: {reason}{_until(plan)}")
        told = True
        time.sleep(min(1.0, max(left, 0.0)))


def _estimate(plan: Plan, name: str) -> float:
    return plan.record.estimate(name, plan.parts[name], plan.quick)


def _needs(plan: Plan, name: str) -> float:
    seconds = _estimate(plan, name)
    return min(seconds, STARTS_WITH) if plan.parts[name].continues else seconds


def _until(plan: Plan) -> str:
    left = plan.deadline - time.time()
    return "" if left == float("inf") else f", {clock(max(left, 0.0))} until the deadline"


def _tell(plan: Plan, name: str) -> None:
    report = plan.record.part(name)
    reason, seconds = report.get("reason"), report.get("seconds")
    spent = "" if seconds is None else f" ({seconds:.1f} s)"
    say(f"{name}: {report['state']}{spent}" + (f": {str(reason).splitlines()[0]}" if reason else ""))


def _run(plan: Plan, name: str) -> None:
    """Run a part in a process; record why it died, if it did."""
    part, log, start = plan.parts[name], plan.work / f"{name}.log", time.time()
    factor, least = HANGS_AFTER
    hang = float("inf") if part.continues else start + max(factor * _estimate(plan, name), least)
    end = plan.deadline + (TO_STOP if part.continues else 0.0)
    command = [sys.executable, str(SCRIPT), *plan.options, "--inside", name, "--until", repr(plan.deadline)]
    with open(log, "w", encoding="utf-8") as messages:
        # Its standard input ends when this process does, for whatever reason; then it ends, too.
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=messages, start_new_session=True)
        assert process.stdin is not None
        with process.stdin:
            try:
                while (status := process.poll()) is None and time.time() < min(end, hang):
                    time.sleep(LOOKS_EVERY)
            finally:
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    plan.record.content = Record.load(plan.record.path).content
    _judge(plan, name, status, time.time() - start, log)


def _judge(plan: Plan, name: str, status: int | None, spent: float, log: Path) -> None:
    """Note how long a part took; if it did not end by itself (``status`` None) or died, record that."""
    record, report, estimate = plan.record, plan.record.part(name), _estimate(plan, name)
    if status is None and time.time() >= plan.deadline:
        record.note_seconds(name, max(estimate, LONGER * spent))
        record.put(name, UNFINISHED, report, f"{CUT} by the end of the call, after {spent:.0f} s")
    elif status is None:
        record.put(name, FAILED, report, f"it hangs: stopped after {spent:.0f} s instead of {estimate:.0f}")
    elif report.get("state") is None or report.get("reason") == CUT:
        end = log.read_text(encoding="utf-8", errors="replace")[-END_OF_OUTPUT:]
        cause = f"signal {signal.Signals(-status).name}" if status < 0 else f"status {status}"
        record.put(name, FAILED, {**report, "messages": end}, f"its process ended with {cause}")
    elif report["state"] in (PASSED, FAILED) and not plan.parts[name].continues:
        record.note_seconds(name, spent)
        record.write()


def end_with_parent() -> None:
    """End this process and those that it has started as soon as standard input ends."""

    def watch() -> None:
        os.read(0, 1)
        os.killpg(0, signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()
