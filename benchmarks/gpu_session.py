"""The record of ``gpu_check``: the state and the figures of every part, in a JSON file that calls continue."""

from __future__ import annotations

import hashlib
import json
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from scgs_warp.errors import UserError
from scgs_warp.runtime.provenance import provenance
from scgs_warp.storage.files import write_atomically
from scgs_warp.storage.json_files import as_number, read_json

ROOT = Path(__file__).resolve().parent.parent
CODE = ("kernels", "scgs_warp", "apps", "benchmarks", "tests")
PASSED, FAILED, NOT_RUN, UNFINISHED = "passed", "failed", "not run", "unfinished"
STATES = (PASSED, FAILED, NOT_RUN, UNFINISHED)
CUT = "it was cut off"
"""Reason of a part that has begun and not ended."""
IDENTITY = ("commit", "code", "gpu", "device", "quick")

Report = dict[str, Any]


class NotRun(Exception):
    """The part cannot run here, or not now; the message says why."""


class Unfinished(Exception):
    """The part has saved its progress, and a later call continues it; the message says how far it is."""


class Setting(NamedTuple):
    device: str
    quick: bool
    judged: bool
    """Whether missing a target of speed is a failure: on a real GPU at full size."""
    scenes: dict[str, tuple[int, tuple[int, int]]]
    """Number of Gaussians and image size, by name; the first entry is that of the moving scene."""
    nodes: int
    repeats: int
    seconds: float
    """Seconds to spend on every row of the step's timings."""


def setting(device: str, quick: bool, judged: bool = False) -> Setting:
    if quick:
        return Setting(device, True, False, {"tiny": (400, (64, 48)), "small": (900, (80, 70))}, 40, 2, 0.02)
    scenes = {"49k": (49_000, (800, 800)), "1M": (1_000_000, (1920, 1080))}
    return Setting(device, False, judged, scenes, 512, 30, 1.0)


@dataclass
class Call:
    """What a part is given."""

    setting: Setting
    deadline: float
    """When this call must have ended, in seconds of ``time.time``."""
    work: Path
    """Folder for files that a later call continues with."""
    data: Path | None
    """A data set for training; None: the built-in scene."""
    earlier: Report
    """What an earlier call has saved of this part."""
    save: Callable[[Report], None]
    """Saves progress, which replaces the progress saved before."""

    def left(self) -> float:
        """Return the number of seconds until the deadline."""
        return self.deadline - time.time()


class Part(NamedTuple):
    run: Callable[[Call], Report]
    """Returns figures, with ``passed``."""
    seconds: float
    """Estimated duration on a GPU."""
    continues: bool = False
    """Whether it can stop at any time and continue in a later call."""
    timed: bool = False
    """Whether other work on the machine spoils its figures."""


def identity(commit: str | None, gpu: str | None, device: str, quick: bool) -> Report:
    """Describe what a record is about. Code that no commit describes is described by its hash."""
    known = commit is not None and not commit.endswith("-dirty")
    return {"commit": commit, "code": None if known else code_hash(), "gpu": gpu, "device": device, "quick": quick}


def code_hash() -> str:
    total = hashlib.sha256()
    for path in sorted(path for folder in CODE for path in (ROOT / folder).rglob("*.*")):
        if path.suffix in (".py", ".h", ".cpp"):
            total.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes())
    return total.hexdigest()[:16]


class Record:
    """The content of the file; every change is written at once, and as a whole."""

    def __init__(self, path: Path, content: Report) -> None:
        self.path, self.content = path, content

    @staticmethod
    def load(path: Path) -> Record:
        """Read a record.

        Raises:
            UserError: the file is damaged, or something else.
        """
        content = read_json(path)
        parts = content.get("parts")
        sound = isinstance(parts, dict) and all(
            isinstance(part, dict) and part.get("state") in STATES for part in parts.values()
        )
        if not sound or not isinstance(content.get("estimates"), dict):
            raise UserError(f"{path}: not a record of gpu_check; restore it, move it away, or give another --output")
        return Record(path, content)

    @staticmethod
    def open(path: Path, about: Report, tell: Callable[[str], None]) -> Record:
        """Continue the record in ``path`` if it is ``about`` the same code and GPU; otherwise begin a new one, and keep
        the file under another name.

        Raises:
            UserError: the file is damaged; it is left as it is.
        """
        estimates: Report = {}
        if path.exists():
            record = Record.load(path)
            changed = [key for key in IDENTITY if record.content.get(key) != about[key]]
            if not changed:
                return record
            aside = record.move_aside()
            tell(f"{path}: another {' and '.join(changed)}; begun anew, the file before is {aside.name}")
            if not {"gpu", "device", "quick"} & set(changed):
                estimates = record.content["estimates"]
        origin = {**provenance(about["device"]), **about}
        record = Record(path, {**origin, "state": UNFINISHED, "goals": {}, "parts": {}, "estimates": estimates})
        record.write()
        return record

    def move_aside(self) -> Path:
        name = (self.content.get("commit") or "unknown")[:7]
        for number in range(1, 1000):
            aside = self.path.with_name(f"{self.path.stem}-{name}-{number}.json")
            if not aside.exists():
                return self.path.rename(aside)
        raise UserError(f"{self.path.parent}: too many records; remove some")

    def write(self) -> None:
        write_atomically(self.path, (json.dumps(self.content, indent=2) + "\n").encode())

    def part(self, name: str) -> Report:
        """Return the report of a part; empty if it has never begun."""
        return self.content["parts"].get(name, {})

    def state(self, name: str) -> str | None:
        return self.part(name).get("state")

    def put(self, name: str, state: str, report: Report, reason: str | None = None) -> None:
        """Replace the report of a part."""
        head = {"state": state, **({"reason": reason} if reason else {})}
        rest = {key: value for key, value in report.items() if key not in ("state", "reason", "passed")}
        self.content["parts"][name] = {**head, **rest}
        self.content["goals"] = {
            f"{key}: {goal}": value
            for key, part in self.content["parts"].items()
            for goal, value in part.get("goals", {}).items()
        }
        self.write()

    def estimate(self, name: str, part: Part, quick: bool) -> float:
        """Return the seconds that a part is expected to take: those it took before, or those of the table."""
        known = as_number(self.content["estimates"].get(name))
        return known if known is not None else min(part.seconds, 15.0) if quick else part.seconds

    def note_seconds(self, name: str, seconds: float) -> None:
        self.content["estimates"][name] = round(seconds, 1)

    def conclude(self, names: list[str]) -> int:
        """Write the state of the whole; return the exit status: 0 passed, 1 failed, 3 unfinished."""
        states = [self.state(name) for name in names]
        failed, passed = FAILED in states, all(state == PASSED for state in states)
        self.content["state"] = FAILED if failed else PASSED if passed else UNFINISHED
        self.write()
        return 1 if failed else 0 if passed else 3


def run_part(name: str, part: Part, record: Record, call: Call) -> None:
    """Run one part, and record its outcome, whatever it is."""
    earlier = record.part(name)
    before, start = as_number(earlier.get("seconds")) or 0.0, time.perf_counter()
    saved = {key: value for key, value in earlier.items() if key not in ("state", "reason")}

    def with_seconds(report: Report) -> Report:
        return {**report, "seconds": round(before + time.perf_counter() - start, 1)}

    def save(report: Report) -> None:
        nonlocal saved
        saved = report
        record.put(name, UNFINISHED, with_seconds(report), CUT)

    call.earlier, call.save = saved, save
    save(saved)
    state, reason = FAILED, None
    try:
        report = part.run(call)
        state = PASSED if report["passed"] else FAILED
        reason = report.get("reason")
    except NotRun as error:
        state, report, reason = NOT_RUN, saved, str(error)
    except Unfinished as error:
        state, report, reason = UNFINISHED, saved, str(error)
    except Exception as error:
        report = {**saved, "trace": traceback.format_exc()}
        reason = f"{type(error).__name__}: {error}"
    record.put(name, state, with_seconds(report), reason)
