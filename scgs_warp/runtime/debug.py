"""Debug mode: what the kernels promise each other is checked at every call, at a multiple of the time.

``SCGS_DEBUG=1`` turns it on for a process, ``debug.enable()`` from here on. The mode changes no result; it raises
``BrokenInvariant`` where one is wrong.
"""

from __future__ import annotations

import os

_enabled = os.environ.get("SCGS_DEBUG", "") not in ("", "0")


class BrokenInvariant(RuntimeError):
    """A defect of this project (or of the machine), not of its input: the message says what is violated."""


def enable(on: bool = True) -> None:
    """Check from now on, or no more."""
    global _enabled
    _enabled = on


def enabled() -> bool:
    """Whether to check."""
    return _enabled
