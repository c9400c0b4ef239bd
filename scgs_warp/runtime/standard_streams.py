"""Standard input, output and error that are always there, and that print any character."""

from __future__ import annotations

import os
import sys
from contextlib import suppress


def prepare_standard_streams() -> None:
    """Connect closed standard streams to the null device, and let the others escape characters that they cannot encode.

    A daemon or a cron job may start with closed streams. The next files that the process opens would take their places,
    and messages of C libraries would then be written into these files. Call it before files are opened.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # takes the lowest free number: this one
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # Python's word for a stream that was closed at the start
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
        elif hasattr(stream, "reconfigure"):
            with suppress(OSError, ValueError):
                stream.reconfigure(errors="backslashreplace")
