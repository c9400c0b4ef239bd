"""Judgement of an answer: right, in one line with the remedy, and nothing lost."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import NamedTuple

from newcomer.mistakes import REFUSED, Mistake


class Answer(NamedTuple):
    """What a command printed, and its exit status."""

    status: int
    out: str
    err: str


def fingerprints(place: Path) -> dict[str, str]:
    """Return the hash of every file below a folder, by its path relative to the folder."""
    files = (path for path in sorted(place.rglob("*")) if path.is_file())
    return {path.relative_to(place).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def judge(mistake: Mistake, answer: Answer, before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Return what is wrong with an answer; an empty list for a good one.

    Args:
        before, after: :func:`fingerprints` of the working folder.
    """
    faults = []
    if "Traceback" in answer.out + answer.err:
        faults.append("a traceback")
    if answer.status != mistake.status:
        faults.append(f"exit status {answer.status}, not {mistake.status}")
    refused = mistake.status == REFUSED and not mistake.trains
    lines = answer.err.strip().splitlines()
    if refused and len(lines) != 1:
        faults.append(f"{len(lines)} lines on stderr, not one")
    said = answer.err if refused else answer.out + answer.err
    said = " ".join(said.split())
    faults += [f"does not say {part!r}" for part in mistake.says if part not in said]
    for path, content in before.items():
        if after.get(path) != content and not any(path.startswith(f"{name}/") for name in mistake.may_change):
            faults.append(f"{path} was {'changed' if path in after else 'lost'}")
    if refused:
        left = sorted(set(after) - set(before))
        faults += [f"{left[0]} was left behind"] if left else []
    return faults
