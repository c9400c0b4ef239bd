"""Rank of this process among those that ``torchrun`` started, read from the environment without importing torch."""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass

from ..errors import UserError
from .environment import available_threads


@dataclass(frozen=True)
class ProcessRank:
    """Rank of this process, and number of processes in its job."""

    rank: int
    size: int
    local_rank: int = 0
    """Rank among the processes on this machine."""
    local_size: int = 1

    @property
    def threads(self) -> int:
        """Number of cores for this process: its share of the machine's."""
        return max(1, available_threads() // self.local_size)


def process_rank() -> ProcessRank | None:
    """Read the rank that ``torchrun`` gave this process; return None if ``torchrun`` did not start it.

    Raises:
        UserError: the environment is not one that ``torchrun`` sets up.
    """
    names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
    if "RANK" not in os.environ or "MASTER_ADDR" not in os.environ or os.environ.get("WORLD_SIZE", "1") == "1":
        return None
    try:
        own = ProcessRank(*(int(os.environ[name]) for name in names))
    except (KeyError, ValueError) as error:
        raise UserError(f"environment: {', '.join(names)} must be whole numbers ({error}); use torchrun") from error
    if not (0 <= own.rank < own.size and 0 <= own.local_rank < own.local_size <= own.size):
        raise UserError(f"environment: {own} cannot be; start the job with torchrun")
    return own


def process_label() -> str:
    """Return a suffix for messages, like ``" (process 1 of 2)"``; it is empty for the first process."""
    with contextlib.suppress(UserError):
        own = process_rank()
        if own is not None and own.rank > 0:
            return f" (process {own.rank} of {own.size})"
    return ""
