"""Disturb the programs at random, and check after every fault that nothing is lost.

    python benchmarks/chaos.py --minutes 120                  # half an hour of each kind of work
    python benchmarks/chaos.py --minutes 3 --part training export --fault memory
    python benchmarks/chaos.py --minutes 120 --json chaos.json

Training, training while a page shows the scene, exports and the editor run in turn, each in a process of its own. A
random fault meets each: ``kill -9``, SIGTERM, SIGHUP, a full disk (a small file system; where none can be mounted, a
limit on the size of files), a slow disk, a clock that jumps, a limit on memory, or a second process that does the same
work in the same folder. Then the invariants of the work are checked (``chaos_work.py``), and the work goes on from
what is there. The exit status is 1 if an invariant is broken, or if a process ends with a traceback or a crash.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from chaos_work import SUFFIXES, Editing, Exporting, LiveTraining, Training, Work, digest, export_to
from soak import small

from scgs_warp.apps.cli import run as run_app
from scgs_warp.data import load
from scgs_warp.data.synthetic.builtin import make_synthetic
from scgs_warp.runtime import environment
from scgs_warp.runtime.provenance import command_line, provenance
from scgs_warp.storage import checkpoint
from scgs_warp.training.loop import fit

DISK_MIB = 96
PATIENCE = 60.0
"""Seconds after which a process hangs if it used less than ``LEAST_WORK`` in them: an unfinished process that other
programs leave little of the processor is slow and does not hang."""
LEAST_WORK = 0.05
"""Seconds of processor time that an idle server does not reach within ``PATIENCE``."""
MOST_WORK = 300.0
"""Seconds of processor time after which a process hangs in a loop."""
FAULTS = ("none", "kill", "terminate", "hang up", "full disk", "slow disk", "clock", "memory", "rival")
SIGNALS = {"kill": signal.SIGKILL, "terminate": signal.SIGTERM, "hang up": signal.SIGHUP}
PARTS = ("training", "live", "export", "editor")


def begin(work: Callable[[], None], log: Path, before: Callable[[], None] = lambda: None) -> int:
    """Start a forked child that works as an app does, with its output in ``log``; return its number."""
    child = os.fork()
    if child:
        return child
    status = 70
    try:
        os.setsid()
        for struck in (signal.SIGTERM, signal.SIGHUP):  # forked from a process with handlers of its own
            signal.signal(struck, signal.SIG_DFL)
        number = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        for stream in (1, 2):
            os.dup2(number, stream)
        sys.stdout, sys.stderr = (open(stream, "w", closefd=False) for stream in (1, 2))
        before()

        def main(_: object) -> None:
            environment.configure(1)
            work()

        status = run_app(main)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        os._exit(status)


def processor_time(child: int) -> float:
    """Return the seconds of processor time that a process has used, with all its threads."""
    words = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def end(child: int, seconds: float = PATIENCE) -> int | None:
    """Wait for a child; return its status, minus the signal that ended it, or None if it hung and was killed.

    Args:
        seconds: time within which a child that does not hang has used ``LEAST_WORK``.
    """
    since, used = time.monotonic(), 0.0
    while True:
        done, how = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(how)
        now = processor_time(child)
        if now - used >= LEAST_WORK:
            since, used = time.monotonic(), now
        if time.monotonic() - since > seconds or now > MOST_WORK:
            break
        time.sleep(0.02)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def finish(work: Callable[[], None], log: Path) -> None:
    """Do undisturbed work in a child.

    Raises:
        RuntimeError: it failed.
    """
    status = end(begin(work, log))
    if status != 0:
        raise RuntimeError(f"undisturbed work ended with {status}: {log.read_text(errors='replace')[-2000:]}")


@contextlib.contextmanager
def disk(folder: Path) -> Iterator[bool]:
    """Mount a small file system at ``folder`` where that is allowed; yield whether it is."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MIB}m", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(command, capture_output=True).returncode == 0
    except OSError:
        mounted = False
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(ballast: Path) -> None:
    """Take every byte of a file system."""
    with open(ballast, "wb", buffering=0) as file:
        for size in (1 << 20, 1 << 12, 1):
            with contextlib.suppress(OSError):
                while True:
                    file.write(bytes(size))


class Fault:
    """One fault: what the child does to itself before it works, and what happens to it from outside."""

    def __init__(self, kind: str, draw: random.Random, folder: Path, mounted: bool) -> None:
        self.kind, self._draw = kind, draw
        self._ballast = folder / "ballast" if mounted else None
        self._seed = draw.random()

    def inside(self) -> None:
        """Change the child's surroundings."""
        draw = random.Random(self._seed)
        if self.kind == "slow disk":
            sync = os.fsync
            os.fsync = lambda number: (time.sleep(draw.uniform(0.0, 0.3)), sync(number))[1]
        elif self.kind == "clock":
            clock, offset = time.time, [0.0]

            def jumping() -> float:
                if draw.random() < 0.2:
                    offset[0] = draw.uniform(-3e8, 3e8)
                return clock() + offset[0]

            time.time = jumping
        elif self.kind == "memory":
            used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
            most = used + draw.randrange(16, 512) * 2**20
            resource.setrlimit(resource.RLIMIT_AS, (most, most))
        elif self.kind == "full disk" and self._ballast is None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # then a write raises an error instead
            most = draw.randrange(1, 200_000)
            resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))

    def outside(self, child: int, usual: float) -> None:
        """Let the fault meet the child at some moment of its work."""
        if self.kind in SIGNALS:
            if wait_for(child, self._draw.uniform(0.0, usual)):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(child, SIGNALS[self.kind])
        elif self.kind == "full disk" and self._ballast is not None:
            wait_for(child, self._draw.uniform(0.0, usual))
            fill(self._ballast)

    def over(self) -> None:
        if self._ballast is not None:
            self._ballast.unlink(missing_ok=True)

    def allows(self, status: int | None) -> bool:
        """Return whether a process may end so: complete, refused in one line, or stopped as it was asked to."""
        allowed = {0}
        if self.kind in SIGNALS:
            allowed |= {130, -int(SIGNALS[self.kind])}
        if self.kind in ("full disk", "memory", "rival"):
            allowed.add(2)
        return status in allowed


def wait_for(child: int, seconds: float) -> bool:
    """Let time pass; return False if the child has ended by then (it remains to be waited for)."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None:
            return False
        time.sleep(0.01)
    return True


class Arena:
    """Data, references and works in one folder."""

    def __init__(self, folder: Path, parts: list[str], faults: list[str], seed: int) -> None:
        self._folder, self._disk, self._draw = folder, folder / "disk", random.Random(seed)
        self._faults = faults
        self._log = folder / "log"
        data, whole, exports = folder / "data", folder / "whole", folder / "references"
        finish(lambda: (make_synthetic(data, size=64, train=12, test=2), None)[1], self._log)
        finish(lambda: (fit(small("control-points"), load(data, "train"), output=whole), None)[1], self._log)
        references: dict[str, str] = {}
        if "export" in parts:
            exports.mkdir()
            finish(lambda: [export_to(exports, whole, suffix) for suffix in SUFFIXES].clear(), self._log)
            references = {suffix: digest(exports / f"scene{suffix}") for suffix in SUFFIXES}
        result = whole / checkpoint.FILE
        every: dict[str, Work] = {
            "training": Training(self._disk / "training", data, result),
            "live": LiveTraining(self._disk / "live", data, result),
            "export": Exporting(self._disk / "export", whole, references),
            "editor": Editing(self._disk / "editor", whole),
        }
        self.works = [every[part] for part in parts]
        self._usual: dict[str, float] = {}

    def round(self, work: Work, mounted: bool) -> dict[str, Any]:
        """Do one piece of work under one fault and return what happened."""
        first = work.name not in self._usual
        fault = Fault("none" if first else self._draw.choice(self._faults), self._draw, self._disk, mounted)
        seed, began = self._draw.randrange(2**31), time.monotonic()
        (self._disk / work.name).mkdir(exist_ok=True)
        child = begin(lambda: work.work(seed), self._log, fault.inside)
        rival = begin(lambda: work.work(seed + 1), self._folder / "rival") if fault.kind == "rival" else None
        fault.outside(child, self._usual.get(work.name, 0.0))
        ended = [end(child)] + ([end(rival)] if rival is not None else [])
        fault.over()
        if first:
            self._usual[work.name] = time.monotonic() - began
        broken = []
        for status, log in zip(ended, (self._log, self._folder / "rival")):
            if not fault.allows(status):
                how = "hung" if status is None else f"ended with {status}"
                broken.append(f"{how}: {log.read_text(errors='replace')[-600:]}")
        done = 0 if 0 in ended else ended[0] or 1
        broken += self._check(work, done)
        if work.next(done) or broken:
            shutil.rmtree(self._disk / work.name)
        return {"part": work.name, "fault": fault.kind, "status": ended, "broken": broken}

    def _check(self, work: Work, status: int) -> list[str]:
        """Check the invariants in a child: this process must not compute, since it forks."""
        answer = self._folder / "answer.json"
        answer.unlink(missing_ok=True)
        memory = getattr(work, "_step", None)

        def check() -> None:
            found = work.check(status)
            answer.write_text(json.dumps([found, getattr(work, "_step", memory)]), encoding="utf-8")

        ended = end(begin(check, self._folder / "check"))
        if ended != 0 or not answer.is_file():
            return [f"the check ended with {ended}: {(self._folder / 'check').read_text(errors='replace')[-600:]}"]
        broken, step = json.loads(answer.read_text(encoding="utf-8"))
        if step is not None:
            setattr(work, "_step", step)  # noqa: B010
        return broken

    def run(self, seconds: float, say: Callable[[str], None]) -> list[dict[str, Any]]:
        rounds: list[dict[str, Any]] = []
        began = time.monotonic()
        with disk(self._disk) as mounted:
            while time.monotonic() - began < seconds:
                found = self.round(self.works[len(rounds) % len(self.works)], mounted)
                rounds.append({**found, "disk": "small" if mounted else "limited files"})
                say(f"{len(rounds)} {found['part']}, {found['fault']}: {found['status']} {found['broken'] or ''}")
        return rounds


def summary(rounds: list[dict[str, Any]]) -> dict[str, Any]:
    """Count rounds by part and fault, and list what was broken."""
    parts = {part: Counter(row["fault"] for row in rounds if row["part"] == part) for part in PARTS}
    broken = [f"{row['part']}, {row['fault']}: {line}" for row in rounds for line in row["broken"]]
    return {"rounds": len(rounds), "faults": {part: dict(count) for part, count in parts.items()}, "broken": broken}


def main(args: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=120.0, help="for all parts together")
    parser.add_argument("--part", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--fault", nargs="+", choices=FAULTS, default=list(FAULTS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(args)
    if not hasattr(os, "fork") or not Path("/proc/self/statm").exists():
        print("error: this needs fork and /proc (Linux)", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory(prefix="scgs-chaos-") as folder:
        arena = Arena(Path(folder), options.part, options.fault, options.seed)
        rounds = arena.run(60 * options.minutes, lambda text: print(text, flush=True))
    report = {"command": command_line("benchmarks/chaos.py", sys.argv[1:]), **summary(rounds)}
    if options.json is not None:
        options.json.write_text(json.dumps({**provenance("cpu"), **report}, indent=1) + "\n", encoding="utf-8")
    print("\n".join(report["broken"]) or f"{len(rounds)} rounds, no invariant is broken")
    return 1 if report["broken"] else 0


if __name__ == "__main__":
    sys.exit(main())
