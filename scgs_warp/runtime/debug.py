"""Debug mode: checks of the kernels' invariants at every call, which multiply the running time.

``SCGS_DEBUG=1`` turns debug mode on for a process; ``debug.enable()`` turns it on from that call onwards. Debug mode
does not change results, but raises ``BrokenInvariant`` if an invariant is violated.
"""

from __future__ import annotations

import os

_enabled = os.environ.get("SCGS_DEBUG", "") not in ("", "0")


class BrokenInvariant(RuntimeError):
    """Error caused by a defect of this project or the machine, not by the input; the message names the invariant."""


def enable(on: bool = True) -> None:
    """Turn debug mode on or off."""
    global _enabled
    _enabled = on


def enabled() -> bool:
    """Return whether debug mode is on."""
    return _enabled
