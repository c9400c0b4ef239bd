"""Several processes that train one scene together: who this one is among them, and what they tell each other.

``torchrun`` starts the processes (``runtime/torchrun.py``). Every process holds the whole scene and takes its share of
a step's views (``training/multi_view.py``). Sums over processes are taken
element by element in the processes' order, whatever the network does: only collectives that move data are used.
"""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import timedelta
from typing import Any, TypeVar

import torch
from torch import Tensor

from ..errors import UserError
from ..runtime.torchrun import ProcessRank

PATIENCE = timedelta(minutes=10)
"""A process that is silent for so long counts as lost. Ended ones are noticed at once; this is for those that hang, and
leaves time for compiling kernels and for what the first process alone has to do."""

PIECE = 1 << 22
"""Elements that are moved at once, 16 MiB: such buffers are used again, in gloo as here; the system hands out larger
ones page by page each time, which took longer than to move them."""

T = TypeVar("T")


class Lost(UserError):
    """Another process has ended, or hangs."""


@contextlib.contextmanager
def team_of(where: ProcessRank | None, device: str) -> Iterator[Team | None]:
    """Join the processes that ``torchrun`` started, for the time of the context; None without it.

    Processes other than the first print nothing to standard output meanwhile.

    Args:
        where: of ``process_rank()``.
        device: ``cpu`` or ``cuda``; of the latter each process takes the GPU of its place on the machine.

    Raises:
        UserError: not enough GPUs, or the others cannot be reached.
    """
    if where is None:
        yield None
        return
    import torch.distributed as dist

    _choose_network(where)
    backend = "gloo"
    if device == "cuda":
        _choose_gpu(where)
        backend = "cpu:gloo,cuda:nccl"
    try:
        dist.init_process_group(backend, timeout=PATIENCE)
    except (RuntimeError, ValueError) as error:
        raise UserError(
            f"{os.environ['MASTER_ADDR']}: the processes of the job cannot reach each other ({error}); name the "
            "network's interface in GLOO_SOCKET_IFNAME (and NCCL_SOCKET_IFNAME), the same network on all machines"
        ) from error
    try:
        with contextlib.ExitStack() as stack:
            if where.rank > 0:
                nowhere = stack.enter_context(open(os.devnull, "w"))
                stack.enter_context(contextlib.redirect_stdout(nowhere))
            yield Team(where)
    finally:
        with contextlib.suppress(RuntimeError):
            dist.destroy_process_group()


def _choose_network(where: ProcessRank) -> None:
    """Processes on one machine talk through its loopback interface: nothing listens on a network, and the machine's
    name need not be known to anybody. The user's choice wins."""
    if where.local_size == where.size and hasattr(socket, "if_nameindex"):
        loopback = [name for _, name in socket.if_nameindex() if name.startswith("lo")]
        if loopback:
            os.environ.setdefault("GLOO_SOCKET_IFNAME", loopback[0])


def _choose_gpu(where: ProcessRank) -> None:
    import torch.distributed as dist

    present = torch.cuda.device_count()
    if where.local_rank >= present:
        raise UserError(
            f"--nproc-per-node {where.local_size}: this machine has {present} GPUs, and each process wants its own; "
            f"start at most {present}, or use --device cpu"
        )
    if not dist.is_nccl_available():
        raise UserError("--device cuda: this torch has no NCCL, by which GPUs talk to each other; use --device cpu")
    torch.cuda.set_device(where.local_rank)
    os.environ.setdefault("TORCH_NCCL_BLOCKING_WAIT", "1")  # a lost process becomes an error that can be reported


class Team:
    """What the processes of a job do together. Every method is called by all of them, in the same order.

    Attributes: ``waited`` and ``moved``, the seconds that this process waited for the others at a step's views, and
    those that sums took; ``bytes``, what it received for sums.

    Raises:
        Lost: (all methods) another process ended, or was silent for ``PATIENCE``.
    """

    def __init__(self, where: ProcessRank) -> None:
        self.rank, self.size = where.rank, where.size
        self.waited = self.moved = 0.0
        self.bytes = 0

    @property
    def first(self) -> bool:
        """Whether this is the process that writes and prints."""
        return self.rank == 0

    def rows(self, row: list[float]) -> list[list[float]]:
        """What each process has to say, in their order: as many numbers from each."""
        mine = torch.tensor(row, dtype=torch.float64)
        everyone = torch.empty(self.size * len(row), dtype=torch.float64)
        began = time.perf_counter()
        self._gather(everyone, mine)
        self.waited += time.perf_counter() - began
        return everyone.view(self.size, -1).tolist()

    def any(self, flag: bool) -> bool:
        """Whether one of them says so."""
        return any(row[0] for row in self.rows([float(flag)]))

    def least(self, number: int) -> int:
        """The least of what they say, of 53 bits at most."""
        return int(min(row[0] for row in self.rows([float(number)])))

    def meet(self) -> None:
        """Go on when all are here."""
        self.rows([0.0])

    def agree(self, number: int) -> bool:
        """Whether all have the same number, of 53 bits at most."""
        return len({row[0] for row in self.rows([float(number)])}) == 1

    def in_turn(self, work: Callable[[], T]) -> T:
        """What ``work`` returns, done by one process after the other: what one makes, the next finds."""
        done: list[T] = []
        for rank in range(self.size):
            if rank == self.rank:
                done.append(work())
            self.meet()
        return done[0]

    def summary(self) -> str:
        """What sharing took, for the terminal."""
        return (
            f"{self.size} processes: this one waited {self.waited:.1f} s for the others, "
            f"and moved {self.bytes / 1e9:.2f} GB for sums in {self.moved:.1f} s"
        )

    def exchange(self, values: Tensor) -> Tensor:
        """[size, n / size] this process's part of the ``values`` [n] of each of them, in their order; ``size`` divides
        n."""
        import torch.distributed as dist

        parts = torch.empty_like(values)
        self._timed(lambda: dist.all_to_all_single(parts, values), values)
        return parts.view(self.size, -1)

    def join(self, part: Tensor) -> Tensor:
        """[size m] the parts [m] of all of them, in their order."""
        whole = part.new_empty(self.size * len(part))
        self._timed(lambda: self._gather(whole, part), whole)
        return whole

    def _timed(self, move: Callable[[], Any], values: Tensor) -> None:
        began = time.perf_counter()
        _or_lost(move)
        self.moved += time.perf_counter() - began
        self.bytes += values.numel() * values.element_size() * (self.size - 1) // self.size

    def _gather(self, out: Tensor, values: Tensor) -> None:
        import torch.distributed as dist

        # Torch 2.13 has renamed it.
        gather = getattr(dist, "all_gather_single", None) or dist.all_gather_into_tensor
        _or_lost(lambda: gather(out, values))


def _or_lost(call: Callable[[], Any]) -> None:
    try:
        call()
    except RuntimeError as error:  # what gloo says differs with the system, and names addresses alone
        raise Lost(
            "another process of this job has ended (its own message, if any, says why) or was silent for "
            f"{PATIENCE.total_seconds():.0f} seconds"
        ) from error


def pieces(vectors: Sequence[Tensor]) -> Iterator[list[Tensor]]:
    """The contiguous ``vectors`` of any shape as flat views, dealt out to lists of ``PIECE`` elements in all; the last
    may have fewer."""
    piece: list[Tensor] = []
    room = PIECE
    for vector in vectors:
        flat = vector.view(-1)
        while len(flat):
            piece.append(flat[:room])
            flat, room = flat[room:], room - len(piece[-1])
            if room == 0:
                yield piece
                piece, room = [], PIECE
    if piece:
        yield piece


class Total:
    """A sum over processes and over calls of :meth:`add`, in a fixed order; or the largest.

    Each process adds up one part of the vectors, and the parts are joined at the end: every element is added in the
    same order in one place, and the bytes that a process receives do not grow with the number of processes.
    """

    def __init__(self, team: Team, combine: Callable[..., Tensor] = torch.add) -> None:
        """``combine``: ``torch.add`` or ``torch.maximum``."""
        self.team, self.combine = team, combine
        self._parts: list[Tensor] = []

    def add(self, vectors: Sequence[Tensor]) -> None:
        """What each process has, first that of the first: contiguous tensors, of the same shapes in all of them and at
        every call."""
        for index, piece in enumerate(pieces(vectors)):
            rest = -sum(map(len, piece)) % self.team.size
            theirs = self.team.exchange(torch.cat([*piece, piece[0].new_zeros(rest)]))
            if index == len(self._parts):
                self._parts.append(theirs[0].clone())
                theirs = theirs[1:]
            for part in theirs:
                self.combine(self._parts[index], part, out=self._parts[index])

    def write(self, vectors: Sequence[Tensor]) -> None:
        """Overwrite the tensors, of the same shapes again, with the total: the same bits in all processes."""
        for part, piece in zip(self._parts, pieces(vectors)):
            whole = self.team.join(part)
            for target in piece:
                target.copy_(whole[: len(target)])
                whole = whole[len(target) :]
