"""Debug mode: checks the kernels' invariants at every call, at a multiple of the time.

``SCGS_DEBUG=1`` turns it on for a process, ``debug.enable()`` from the call on. The mode changes no result; it raises
``BrokenInvariant`` for a wrong one.
"""

from __future__ import annotations

import os

_enabled = os.environ.get("SCGS_DEBUG", "") not in ("", "0")


class BrokenInvariant(RuntimeError):
    """A defect of this project or of the machine, not of the input; the message names the violated invariant."""


def enable(on: bool = True) -> None:
    """Turn debug mode on or off."""
    global _enabled
    _enabled = on


def enabled() -> bool:
    """Return whether debug mode is on."""
    return _enabled
