"""The process group: several processes that train one scene together.

``torchrun`` starts the processes (``runtime/torchrun.py``). Every process holds the whole scene and takes its share of
a step's views (``training/multi_view.py``). Sums over processes are computed here, element by element in rank order;
the collectives of the network library only move data, so the network does not affect the result.
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
"""Duration of silence after which a process counts as lost. The end of a process is noticed at once; this limit is for
processes that hang. It leaves time for compiling kernels and for work that only the first process does."""
PIECE = 1 << 22
"""Number of elements moved at once (16 MiB). Buffers of this size are reused, by gloo as well as here. Larger ones are
allocated by the system page by page each time, which takes longer than moving the data."""

T = TypeVar("T")


class ProcessLost(UserError):
    """Error that another process has ended or hangs."""


@contextlib.contextmanager
def join_processes(where: ProcessRank | None, device: str) -> Iterator[ProcessGroup | None]:
    """Join the processes that ``torchrun`` started, for the duration of the context; yield None without ``torchrun``.

    In that context, processes other than the first print nothing to standard output.

    Args:
        where: result of ``process_rank()``; None for a single process.
        device: ``cpu`` or ``cuda``; on CUDA each process takes the GPU of its local rank.

    Raises:
        UserError: there are not enough GPUs, or the other processes cannot be reached.
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
                nowhere = stack.enter_context(open(os.devnull, "w", encoding="utf-8"))
                stack.enter_context(contextlib.redirect_stdout(nowhere))
            yield ProcessGroup(where)
    finally:
        with contextlib.suppress(RuntimeError):
            dist.destroy_process_group()


def _choose_network(where: ProcessRank) -> None:
    """Choose the loopback interface if all processes are on one machine: then no port is open to a network, and the
    machine's name need not resolve. A choice made by the user takes precedence."""
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


class ProcessGroup:
    """Collective operations of the processes of a job. Every process must call the same methods in the same order.

    Attributes: ``waited``, seconds spent waiting for other processes at the end of views; ``moved``, seconds spent on
    moving data for sums; ``bytes``, number of bytes received for sums.

    Raises:
        ProcessLost: (all methods) another process ended, or was silent for ``PATIENCE``.
    """

    def __init__(self, where: ProcessRank) -> None:
        self.rank, self.size = where.rank, where.size
        self.waited = self.moved = 0.0
        self.bytes = 0

    @property
    def first(self) -> bool:
        """True for the process that writes and prints."""
        return self.rank == 0

    def gather_rows(self, row: list[float]) -> list[list[float]]:
        """Collect one row of numbers per process, in rank order; all rows have the same length."""
        mine = torch.tensor(row, dtype=torch.float64)
        everyone = torch.empty(self.size * len(row), dtype=torch.float64)
        began = time.perf_counter()
        self._gather(everyone, mine)
        self.waited += time.perf_counter() - began
        return everyone.view(self.size, -1).tolist()

    def any(self, flag: bool) -> bool:
        """Return True if any process passes True."""
        return any(row[0] for row in self.gather_rows([float(flag)]))

    def minimum(self, number: int) -> int:
        """Return the smallest of the numbers passed by all processes; numbers have at most 53 bits."""
        return int(min(row[0] for row in self.gather_rows([float(number)])))

    def barrier(self) -> None:
        """Wait until all processes have arrived."""
        self.gather_rows([0.0])

    def agree(self, number: int) -> bool:
        """Return True if all processes pass the same number; numbers have at most 53 bits."""
        return len({row[0] for row in self.gather_rows([float(number)])}) == 1

    def in_turn(self, work: Callable[[], T]) -> T:
        """Run ``work`` in one process after another, so that each can use the results of the previous ones."""
        done: list[T] = []
        for rank in range(self.size):
            if rank == self.rank:
                done.append(work())
            self.barrier()
        return done[0]

    def summary(self) -> str:
        """Describe the cost of communication in one line, for the terminal."""
        return (
            f"{self.size} processes: this one waited {self.waited:.1f} s for the others, "
            f"and moved {self.bytes / 1e9:.2f} GB for sums in {self.moved:.1f} s"
        )

    def all_to_all(self, values: Tensor) -> Tensor:
        """Return this process's part of every process's ``values`` [n], in rank order: [size, n / size]. ``n`` must be
        a multiple of ``size``."""
        import torch.distributed as dist

        parts = torch.empty_like(values)
        self._timed(lambda: dist.all_to_all_single(parts, values), values)
        return parts.view(self.size, -1)

    def all_gather(self, part: Tensor) -> Tensor:
        """Concatenate the parts [m] of all processes in rank order: [size * m]."""
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

        # Torch 2.13 renamed the collective.
        gather = getattr(dist, "all_gather_single", None) or dist.all_gather_into_tensor
        _or_lost(lambda: gather(out, values))


def _or_lost(call: Callable[[], Any]) -> None:
    try:
        call()
    except RuntimeError as error:  # gloo's messages differ between systems and contain only addresses
        raise ProcessLost(
            "another process of this job has ended (its own message, if any, says why) or was silent for "
            f"{PATIENCE.total_seconds():.0f} seconds"
        ) from error


def pieces(vectors: Sequence[Tensor]) -> Iterator[list[Tensor]]:
    """Cut the contiguous ``vectors``, of any shape, into flat views, and yield lists of these. The views of each list
    have ``PIECE`` elements together; the last list may have fewer."""
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


class OrderedReduction:
    """Sum or maximum over processes and over calls of :meth:`add`, in a fixed order.

    Each process reduces one part of the vectors, and the parts are gathered at the end. Every element is thus reduced
    by one process in a fixed order, and the number of bytes that a process receives does not grow with the number of
    processes.
    """

    def __init__(self, group: ProcessGroup, combine: Callable[..., Tensor] = torch.add) -> None:
        """Make an empty reduction; ``combine`` is ``torch.add`` or ``torch.maximum``."""
        self.group, self.combine = group, combine
        self._parts: list[Tensor] = []

    def add(self, vectors: Sequence[Tensor]) -> None:
        """Reduce the vectors of all processes in rank order. The vectors are contiguous tensors whose shapes are the
        same in all processes and at every call."""
        for index, piece in enumerate(pieces(vectors)):
            rest = -sum(map(len, piece)) % self.group.size
            theirs = self.group.all_to_all(torch.cat([*piece, piece[0].new_zeros(rest)]))
            if index == len(self._parts):
                self._parts.append(theirs[0].clone())
                theirs = theirs[1:]
            for part in theirs:
                self.combine(self._parts[index], part, out=self._parts[index])

    def write(self, vectors: Sequence[Tensor]) -> None:
        """Overwrite tensors of the same shapes with the result, which is bit-identical in all processes."""
        for part, piece in zip(self._parts, pieces(vectors)):
            whole = self.group.all_gather(part)
            for target in piece:
                target.copy_(whole[: len(target)])
                whole = whole[len(target) :]
