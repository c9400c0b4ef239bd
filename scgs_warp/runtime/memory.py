"""Available memory, queried before large allocations so that work which does not fit is split or refused.

The limit is the user's (``set_limit``, ``--memory-gib``, ``SCGS_MEMORY_GIB``), or else the memory that the machine, its
control group and the process's own limits leave. For tensors on a GPU, the GPU's memory counts.
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

LIMIT_VARIABLE = "SCGS_MEMORY_GIB"
"""Environment variable that holds the user's limit in GiB."""
SIBLINGS_VARIABLE = "SCGS_SIBLINGS"
"""Environment variable that holds the number of processes of one job on this machine. ``torchrun`` uses a variable of
its own for it."""
GIB = 2**30
USABLE_SHARE = 0.9
"""Share of the free memory that requests may take; the rest is for threads, libraries and small tensors."""
READING_SECONDS = 1.0
"""Number of seconds for which a reading of the free memory is reused for requests that are small in comparison."""
SMALL_PART = 0.25
"""Largest request that counts as small, as a fraction of the reading."""
UNKNOWN_FREE = 2.0**60
"""Number of bytes assumed free where the system does not tell (outside Linux)."""


class NotEnoughMemory(UserError, MemoryError):
    """Error that a request exceeds the available memory. The message gives both figures and the remedy; nothing was
    allocated."""


_limit: int | None = None
_limit_known = False
_readings: dict[str, tuple[float, int]] = {}
_lock = threading.Lock()


def set_limit(gib: float | None) -> None:
    """Limit the memory of the process on a CPU, and what torch allocates on a GPU.

    Args:
        gib: GiB, more than 0. None: no limit except the machine's.

    Raises:
        UserError: ``gib`` is not a positive number.
    """
    global _limit, _limit_known
    if gib is not None and not 0.0 < gib < math.inf:
        raise UserError(f"memory limit of {gib} GiB: give a number greater than 0")
    _limit, _limit_known = None if gib is None else int(gib * GIB), True
    forget_readings()


def set_limit_from_environment() -> None:
    """Set the limit given by ``SCGS_MEMORY_GIB``; without the variable there is no limit.

    Raises:
        UserError: the variable is not a positive number.
    """
    text = os.environ.get(LIMIT_VARIABLE, "").strip()
    try:
        set_limit(float(text) if text else None)
    except (UserError, ValueError):
        raise UserError(f"{LIMIT_VARIABLE}={text}: give a number of GiB greater than 0, or leave it out") from None


def limit() -> int | None:
    """Return the user's limit in bytes, from ``set_limit`` or else from ``SCGS_MEMORY_GIB``; None without either.

    Raises:
        UserError: the variable is not a positive number.
    """
    if not _limit_known:
        set_limit_from_environment()
    return _limit


def forget_readings() -> None:
    """Forget earlier readings, so that the next request asks the system again."""
    with _lock:
        _readings.clear()


def in_gib(size: float) -> str:
    """Format bytes as MiB or GiB."""
    if size < GIB / 8:
        return f"{size / 2**20:,.1f} MiB"
    return f"{size / GIB:,.2f} GiB" if size < 100 * GIB else f"{size / GIB:,.0f} GiB"


def fits(need: int, device: torch.device | str = "cpu") -> bool:
    """Return whether ``need`` bytes are available. If a recent reading is far larger, the system is not asked again."""
    name = str(device)
    taken, room = _readings.get(name, (-math.inf, 0))
    if need <= SMALL_PART * room and time.monotonic() - taken < READING_SECONDS:
        return True
    if need <= measure(name):
        return True
    hand_back(name)
    return need <= measure(name)


def room(device: torch.device | str = "cpu") -> int:
    """Return the number of bytes available now, after handing freed memory back to the system."""
    hand_back(str(device))
    return measure(str(device))


def measure(name: str) -> int:
    """Return the number of bytes available according to the system, and remember it for ``fits``."""
    bounds = _free_on_gpu(name) if name.startswith("cuda") else free_on_host()
    free = int(USABLE_SHARE * max(0.0, min(*bounds, UNKNOWN_FREE)))
    with _lock:
        _readings[name] = time.monotonic(), free
    return free


def require(need: int, device: torch.device | str, what: str, remedy: str) -> None:
    """Refuse a request that does not fit.

    Args:
        need: bytes.
        what: begins the message: "``what`` needs".
        remedy: ends the message.

    Raises:
        NotEnoughMemory: with both figures.
    """
    if not fits(need, device):
        raise refusal(need, device, what, remedy)


def refusal(need: int, device: torch.device | str, what: str, remedy: str, room: int | None = None) -> NotEnoughMemory:
    """Make the error that ``require`` raises. ``room``: number of bytes available, if already known."""
    own = limit()
    of = "" if own is None else f" of the {in_gib(own)} allowed"
    allowed = f"{in_gib(measure(str(device)) if room is None else room)}{of} may be taken"
    return NotEnoughMemory(f"{what} needs {in_gib(need)} of memory, {allowed}; {remedy}, or allow more (--memory-gib)")


def hand_back(name: str = "cpu") -> None:
    """Return freed memory to the system, since glibc would keep it, so that resident memory is the memory in use."""
    if name.startswith("cuda"):
        return  # torch's cache is counted as free
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def status(key: str) -> int | None:
    """Read a line of /proc/self/status, in bytes; None if it is missing (outside Linux)."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith(f"{key}:"):
                return 1024 * int(line.split()[1])
    return None


def siblings() -> int:
    """Count the processes of this job on this machine, itself included."""
    counts = [os.environ.get(name, "") for name in (SIBLINGS_VARIABLE, "LOCAL_WORLD_SIZE")]
    return max([1, *(int(text) for text in counts if text.isascii() and text.isdigit() and len(text) < 6)])


def _free_on_gpu(name: str) -> Iterator[float]:
    device = torch.device(name)
    allocated = torch.cuda.memory_allocated(device)
    yield torch.cuda.mem_get_info(device)[0] + torch.cuda.memory_reserved(device) - allocated
    own = limit()
    if own is not None:
        yield own - allocated


def free_on_host() -> Iterator[float]:
    """Yield every bound that applies, and infinity.

    Processes of one job request memory at the same moment, so each counts on an equal share of the machine's memory."""
    yield math.inf
    own = limit()
    if own is not None:
        yield own - (status("VmRSS") or 0)
    shares = siblings()
    with contextlib.suppress(OSError, ValueError, IndexError):
        text = Path("/proc/meminfo").read_text(encoding="ascii")
        yield 1024 * int(text.split("MemAvailable:")[1].split(maxsplit=1)[0]) / shares
    yield from (free / shares for free in free_in_groups())
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        for kind, used in ((resource.RLIMIT_AS, "VmSize"), (resource.RLIMIT_DATA, "VmData")):
            most = resource.getrlimit(kind)[0]
            if most != resource.RLIM_INFINITY:
                yield most - (status(used) or 0)


def free_in_groups(root: str = "/sys/fs/cgroup", own: str = "/proc/self/cgroup") -> Iterator[float]:
    """Yield the memory that the process's control group and its parents leave (Linux), including droppable pages."""
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
        bound, taken = (int((folder / name).read_text(encoding="ascii")) for name in (most, used))
        words = (folder / "memory.stat").read_text(encoding="ascii").split()
        dropped = int(words[words.index(droppable) + 1]) if droppable in words else 0
        yield bound - taken + dropped
