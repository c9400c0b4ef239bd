"""Which of several processes this one is. ``torchrun`` starts them and says so in the environment; torch is not needed
to read it."""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass

from ..errors import UserError
from .environment import available_threads


@dataclass(frozen=True)
class Place:
    """This process among those of a job."""

    rank: int
    size: int
    local_rank: int = 0
    """Among those on this machine."""
    local_size: int = 1

    @property
    def threads(self) -> int:
        """Its share of the machine's cores."""
        return max(1, available_threads() // self.local_size)


def place() -> Place | None:
    """What ``torchrun`` says; None for a process on its own.

    Raises:
        UserError: the environment is not what ``torchrun`` makes.
    """
    names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
    if "RANK" not in os.environ or "MASTER_ADDR" not in os.environ or os.environ.get("WORLD_SIZE", "1") == "1":
        return None
    try:
        found = Place(*(int(os.environ[name]) for name in names))
    except (KeyError, ValueError) as error:
        raise UserError(f"environment: {', '.join(names)} must be whole numbers ({error}); use torchrun") from error
    if not (0 <= found.rank < found.size and 0 <= found.local_rank < found.local_size <= found.size):
        raise UserError(f"environment: {found} cannot be; start the job with torchrun")
    return found


def label() -> str:
    """``" (process 1 of 2)"`` for messages of a process that is not the first; else nothing."""
    with contextlib.suppress(UserError):
        where = place()
        if where is not None and where.rank > 0:
            return f" (process {where.rank} of {where.size})"
    return ""
