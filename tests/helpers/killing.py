"""Kill training without a warning and resume it: ``python tests/helpers/killing.py FOLDER [MOMENT ...] [--random N]``.

This process has imported everything and computed nothing; each run is a forked child, which begins at once. Prints one
JSON object: what each run was doing when it was killed, and whether it left the checkpoint of an undisturbed run after
being resumed.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import select
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # when run as a program

import scgs_warp  # noqa: F401  (sets the environment before torch is imported)

from helpers.tiny import tiny_config, tiny_dataset  # isort: skip

from scgs_warp.config.presets import TrainConfig
from scgs_warp.runtime import environment
from scgs_warp.storage import checkpoint, files
from scgs_warp.training import density_control, loop, stepping
from scgs_warp.training.state import TrainState

STEPS = 48
FRAMES = 6
density_control.STEPS_PER_VIEW = 1  # else so short a run samples no view


def settings() -> TrainConfig:
    """A third of it stage 1; a checkpoint after every step, so that many kills meet one."""
    stage1 = {"steps": 16, "densify_every": 3}
    return tiny_config(STEPS, checkpoint_seconds=0.0, pretrain=stage1, densify={"every": 5, "start": 5})


def die(*_: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def wrapped(owner: Any, name: str, before: Callable[..., None], after: Callable[..., None] | None = None) -> None:
    """Call ``before`` and ``after`` around ``owner.name``, with its arguments."""
    inner = getattr(owner, name)

    def outer(*args: Any, **fields: Any) -> Any:
        before(*args)
        result = inner(*args, **fields)
        if after is not None:
            after(*args)
        return result

    setattr(owner, name, outer)


def nth(count: int, when: Callable[..., bool], action: Callable[..., None] = die) -> Callable[..., None]:
    """Return a function that calls ``action`` the ``count``-th time that ``when`` is true."""
    seen = [0]

    def look(*args: Any) -> None:
        seen[0] += bool(when(*args))
        if seen[0] == count:
            action(*args)

    return look


def half_written(path: Path, content: bytes) -> None:
    path.write_bytes(content[: len(content) // 2])
    die()


def ends(name: str) -> Callable[..., bool]:
    return lambda source, target, *_: str(target).endswith(name)


def always(*_: Any) -> bool:
    return True


MOMENTS: dict[str, Callable[[], None]] = {
    "before the first checkpoint": lambda: wrapped(stepping, "training_step", nth(4, always)),
    "half a checkpoint": lambda: wrapped(
        files, "write_and_flush", nth(7, lambda path, _: "checkpoint" in path.name, half_written)
    ),
    "before the previous one is renamed": lambda: wrapped(os, "replace", nth(9, ends(checkpoint.PREVIOUS))),
    "between the two renames": lambda: wrapped(os, "replace", nth(11, ends(checkpoint.FILE))),
    "before the folder is flushed": lambda: wrapped(files, "sync_folder", nth(13, always)),
    "after the stage has changed": lambda: wrapped(TrainState, "begin_main", lambda *_: None, die),
    "while spheres are added": lambda: wrapped(density_control, "densify_spheres", lambda *_: None, nth(2, always)),
    "while Gaussians are added": lambda: wrapped(density_control, "grow_and_prune", lambda *_: None, nth(3, always)),
    "before the unseen are pruned": lambda: wrapped(density_control, "prune", nth(1, always)),
}
"""Moments of a kill by name, and how to reach each."""
LATE = ("before the first checkpoint",)
"""Moments of runs that save at the end only."""


def narrate(tell: Callable[[str], None]) -> None:
    """Report what the run is doing."""
    wrapped(stepping, "training_step", lambda state, _: tell(f"{state.stage} step"))
    wrapped(loop, "control_density", lambda state, *_: tell(f"{state.stage} densification, if due"))
    wrapped(TrainState, "begin_main", lambda *_: tell("stage change"))
    wrapped(density_control, "grow_and_prune", lambda *_: tell("main densification"))
    wrapped(density_control, "densify_spheres", lambda *_: tell("pretrain densification"))
    wrapped(checkpoint, "write", lambda *_: tell("checkpoint: gathering"))
    wrapped(files, "write_and_flush", lambda *_: tell("checkpoint: writing"))
    wrapped(os, "replace", lambda *_: tell("checkpoint: renaming"))


def run(folder: Path, threads: int, moment: str | None = None, after: float | None = None) -> tuple[int, str, float]:
    """Train or resume in a child process; kill it ``after`` so many seconds.

    Returns:
        its exit status (minus the signal), its last report, and its duration in seconds.
    """
    ear, mouth = os.pipe()
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            environment.configure(threads)
            data, resume = tiny_dataset(FRAMES), folder.exists()
            narrate(lambda text: (os.write(mouth, f"{text}\n".encode()), None)[1])
            if moment is not None:
                MOMENTS[moment]()
            config = settings() if moment not in LATE else replace(settings(), checkpoint_seconds=1e9)
            os.write(mouth, b"beginning\n")
            loop.fit(config, data, output=folder, resume=resume)
            status = 0
        finally:
            os._exit(status)
    os.close(mouth)
    said, began = _listen(ear, child, after)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return status, said, time.monotonic() - began


def _listen(ear: int, child: int, after: float | None) -> tuple[str, float]:
    """Return the child's last report and its start time; kill it when its time has come."""
    text, began, killed = b"", time.monotonic(), False
    while True:
        begun = bool(text)
        left = None if after is None or killed or not begun else max(0.0, began + after - time.monotonic())
        if not select.select([ear], [], [], left)[0]:
            os.kill(child, signal.SIGKILL)
            killed = True
            continue
        new = os.read(ear, 65536)
        if not new:
            break
        if not begun:
            began = time.monotonic()
        text += new
    os.close(ear)
    return text.decode().splitlines()[-1], began


def outcome(folder: Path, whole: bytes, status: int, doing: str) -> dict[str, Any]:
    """Resume with another number of threads and return the outcome."""
    found = folder / checkpoint.FILE
    step = int(checkpoint.read(folder)[1]["step"]) if found.is_file() else 0
    ended, _, _ = run(folder, threads=2)
    same = ended == 0 and found.read_bytes() == whole
    left = sorted(path.name for path in folder.rglob(".*") if path.name != ".lock")
    return {"killed": status == -signal.SIGKILL, "doing": doing, "step": step, "same": same, "left": left}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("moments", nargs="*")
    parser.add_argument("--random", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    folder: Path = options.folder
    status, _, _ = run(folder / "whole", threads=1)
    assert status == 0
    whole = (folder / "whole" / checkpoint.FILE).read_bytes()
    results = []
    for moment in options.moments:
        place = folder / moment.replace(" ", "-")
        status, doing, _ = run(place, threads=1, moment=moment)
        results.append({"moment": moment, **outcome(place, whole, status, doing)})
    draw = random.Random(options.seed)
    for index in range(options.random):
        place = folder / f"random-{index}"
        _, _, seconds = run(folder / f"timed-{index}", threads=1)  # anew, since others use the machine, too
        share = (index + draw.random()) / options.random  # in every twentieth of the run once
        for attempt in range(10):
            status, doing, _ = run(place / str(attempt), threads=1, after=share * seconds)
            if status != 0:  # it was not faster than its kill
                break
            share *= 0.9
        results.append({"share": round(share, 3), **outcome(place / str(attempt), whole, status, doing)})
        print(json.dumps(results[-1]), file=sys.stderr, flush=True)
    print(json.dumps({"runs": results}))


if __name__ == "__main__":
    main()
