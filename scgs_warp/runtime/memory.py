"""How much memory may still be taken: asked before it is, so that what does not fit is cut up or refused.

The limit is the user's (``set_limit``, ``--memory-gib``, ``SCGS_MEMORY_GIB``), or else what the machine, its control
group and the process' own limits leave. On a GPU it is of the GPU's memory.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import torch

from ..errors import UserError

VARIABLE = "SCGS_MEMORY_GIB"
GIB = 2**30
SHARE = 0.9
"""Of what is free: beside what is planned, threads, libraries and small tensors grow too."""
SECONDS = 1.0
"""How long a reading serves for what is small beside it."""
UNKNOWN = 2.0**60
"""Bytes, where the system says nothing (outside Linux)."""
SIBLINGS = "SCGS_SIBLINGS"
"""Variable: how many processes of one job share the machine; torchrun says it in one of its own."""
SMALL = 0.25
"""Part of a reading that may be taken without another one."""


class NotEnoughMemory(UserError, MemoryError):
    """What was asked for takes more than may be taken: the message gives both figures and the remedy. Nothing was
    allocated."""


_limit: int | None = None
_limit_known = False
_readings: dict[str, tuple[float, int]] = {}
_lock = threading.Lock()


def set_limit(gib: float | None) -> None:
    """Never plan for more memory than this: of the process on a CPU, of what torch allocates on a GPU.

    Args:
        gib: in GiB, more than 0. None: what the machine has.

    Raises:
        UserError: it is not a positive number.
    """
    global _limit, _limit_known
    if gib is not None and not 0.0 < gib < math.inf:
        raise UserError(f"memory limit of {gib} GiB: give a number greater than 0")
    _limit, _limit_known = None if gib is None else int(gib * GIB), True
    with _lock:
        _readings.clear()


def limit() -> int | None:
    """The user's limit in bytes: ``set_limit``'s, or else that of ``SCGS_MEMORY_GIB``; None: there is none.

    Raises:
        UserError: the variable is not a positive number.
    """
    if not _limit_known:
        text = os.environ.get(VARIABLE, "").strip()
        try:
            set_limit(float(text) if text else None)
        except (UserError, ValueError):
            raise UserError(f"{VARIABLE}={text}: give a number of GiB greater than 0, or leave it out") from None
    return _limit


def in_gib(size: float) -> str:
    """Bytes as people read them."""
    if size < GIB / 8:
        return f"{size / 2**20:,.1f} MiB"
    return f"{size / GIB:,.2f} GiB" if size < 100 * GIB else f"{size / GIB:,.0f} GiB"


def fits(need: int, device: torch.device | str = "cpu") -> bool:
    """Whether ``need`` bytes may be taken. Costs nothing where that is a small part of a recent reading."""
    name = str(device)
    taken, room = _readings.get(name, (-math.inf, 0))
    if need <= SMALL * room and time.monotonic() - taken < SECONDS:
        return True
    if need <= measure(name):
        return True
    hand_back(name)
    return need <= measure(name)


def room(device: torch.device | str = "cpu") -> int:
    """Bytes that may be taken now, memory that was freed but kept handed back first."""
    hand_back(str(device))
    return measure(str(device))


def measure(name: str) -> int:
    """Bytes that may be taken, as the system counts; remembered for ``fits``."""
    bounds = _free_on_gpu(name) if name.startswith("cuda") else _free_on_host()
    found = int(SHARE * max(0.0, min(*bounds, UNKNOWN)))
    with _lock:
        _readings[name] = time.monotonic(), found
    return found


def require(need: int, device: torch.device | str, what: str, remedy: str) -> None:
    """Refuse what does not fit.

    Args:
        need: bytes.
        what: begins the message: "``what`` needs".
        remedy: ends it.

    Raises:
        NotEnoughMemory: with both figures.
    """
    if not fits(need, device):
        raise refusal(need, device, what, remedy)


def refusal(need: int, device: torch.device | str, what: str, remedy: str, room: int | None = None) -> NotEnoughMemory:
    """What ``require`` raises. ``room``: bytes that may be taken, where they are known."""
    own = limit()
    of = "" if own is None else f" of the {in_gib(own)} allowed"
    allowed = f"{in_gib(measure(str(device)) if room is None else room)}{of} may be taken"
    return NotEnoughMemory(f"{what} needs {in_gib(need)} of memory, {allowed}; {remedy}, or allow more (--memory-gib)")


def hand_back(name: str = "cpu") -> None:
    """Freed memory goes back to the system (glibc keeps it otherwise), so that what is resident is what is used."""
    if name.startswith("cuda"):
        return  # what torch keeps is counted as free
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def status(key: str) -> int | None:
    """A line of /proc/self/status in bytes; None where there is none (outside Linux)."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith(f"{key}:"):
                return 1024 * int(line.split()[1])
    return None


def siblings() -> int:
    """Processes of this job on this machine, itself included."""
    found = [os.environ.get(name, "") for name in (SIBLINGS, "LOCAL_WORLD_SIZE")]
    return max([1, *(int(text) for text in found if text.isascii() and text.isdigit() and len(text) < 6)])


def _free_on_gpu(name: str) -> Iterator[float]:
    device = torch.device(name)
    allocated = torch.cuda.memory_allocated(device)
    yield torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device) - allocated
    own = limit()
    if own is not None:
        yield own - allocated


def _free_on_host() -> Iterator[float]:
    """Every bound there is; infinite where nothing is said. What is the machine's is shared with processes of the same
    job, which plan at the same moment."""
    yield math.inf
    own = limit()
    if own is not None:
        yield own - (status("VmRSS") or 0)
    shares = siblings()
    with contextlib.suppress(OSError, ValueError, IndexError):
        text = Path("/proc/meminfo").read_text(encoding="ascii")
        yield 1024 * int(text.split("MemAvailable:")[1].split(maxsplit=1)[0]) / shares
    yield from (free / shares for free in _free_in_groups())
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        for kind, used in ((resource.RLIMIT_AS, "VmSize"), (resource.RLIMIT_DATA, "VmData")):
            most = resource.getrlimit(kind)[0]
            if most != resource.RLIM_INFINITY:
                yield most - (status(used) or 0)


def _free_in_groups(root: str = "/sys/fs/cgroup", own: str = "/proc/self/cgroup") -> Iterator[float]:
    """What the process' control group and those above it leave (Linux), pages that the kernel may drop included."""
    try:
        lines = Path(own).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return
    for line in lines:
        number, controllers, path = [*line.split(":", 2), "", ""][:3]
        if number == "0":
            base, names = Path(root), ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            base = Path(root, "memory")
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        folder = base / path.strip("/")
        for group in (folder, *folder.parents):
            yield from _free_in_group(group, *names)
            if group == base:
                break


def _free_in_group(folder: Path, most: str, used: str, droppable: str) -> Iterator[float]:
    with contextlib.suppress(OSError, ValueError):
        bound, taken = int((folder / most).read_text()), int((folder / used).read_text())
        words = (folder / "memory.stat").read_text().split()
        dropped = int(words[words.index(droppable) + 1]) if droppable in words else 0
        yield bound - taken + dropped
