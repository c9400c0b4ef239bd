"""Counts of what the host does with the pretended device: operations, launches, and contacts with their lines."""

from __future__ import annotations

import contextlib
import ctypes
import traceback
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

REPO = Path(__file__).resolve().parents[2]
SHIPPED = ("scgs_warp", "kernels", "apps", "benchmarks")
OPERATION, CONTACT = 0, 1
VIEWS = frozenset(
    "_reshape_alias _unsafe_view alias as_strided detach diagonal expand permute select slice split split_with_sizes "
    "squeeze t transpose unbind unfold unsqueeze view".split()
)
"""Operations that launch nothing."""


@dataclass
class Ledger:
    """What happened while it was open."""

    operations: Counter[str] = field(default_factory=Counter)
    """Operations of torch that launch a kernel or copy, by name."""
    launches: Counter[str] = field(default_factory=Counter)
    """Launches of Warp's kernels and of native bodies, and radix sorts, by name."""
    contacts: Counter[tuple[str, str]] = field(default_factory=Counter)
    """Contacts of the host with the device (copies, waits), by kind and line."""

    def lines(self) -> list[str]:
        return [f"{count} x {kind} at {line}" for (kind, line), count in self.contacts.items()]


_open: list[Ledger] = []
_library: ctypes.CDLL | None = None
_REPORT = ctypes.CFUNCTYPE(None, ctypes.c_int, ctypes.c_char_p)


def attach(library: ctypes.CDLL) -> None:
    global _library
    _library = library
    library.pretended_contact.argtypes = [ctypes.c_char_p]


@contextlib.contextmanager
def counted() -> Iterator[Ledger]:
    """Count until the end of the block."""
    assert _library is not None
    ledger = Ledger()
    _open.append(ledger)
    _library.pretended_set_reports(_report)
    try:
        yield ledger
    finally:
        _open.remove(ledger)
        if not _open:
            _library.pretended_set_reports(None)


def count_launch(name: str) -> None:
    for ledger in _open:
        ledger.launches[name] += 1


def contact(kind: str) -> None:
    """Report a contact that torch's operations do not show (a wait for a stream or an event).

    Raises:
        RuntimeError: a capture is in progress.
    """
    assert _library is not None
    if _library.pretended_capturing():
        raise RuntimeError(f"CUDA error: operation not permitted when stream is capturing ({kind})")
    _note(CONTACT, kind)


def _note(kind: int, name: str) -> None:
    for ledger in _open:
        if kind == CONTACT:
            ledger.contacts[name, calling_line()] += 1
        elif name not in VIEWS and name != "empty":
            ledger.operations[name] += 1


@_REPORT
def _report(kind: int, name: bytes) -> None:
    _note(kind, name.decode())


def calling_line() -> str:
    """Return file and line of the innermost function of the project on the stack."""
    for frame in reversed(traceback.extract_stack()):
        path = Path(frame.filename)
        if path.is_relative_to(REPO) and path.relative_to(REPO).parts[0] in SHIPPED:
            return f"{path.relative_to(REPO)}:{frame.lineno}"
    return "elsewhere"
