"""Steps of several views, processed in sequence or shared by several processes, with bit-identical results.

Gradients and statistics are added view by view in order. Process ``r`` of ``W`` takes the views ``r``, ``r + W`` and so
on, so each round completes the next ``W`` views.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable

import torch
from torch import Tensor

from ..config.presets import TrainConfig
from ..errors import UserError
from ..types import Stats
from .frames import Frames
from .process_group import OrderedReduction, ProcessGroup
from .state import StepResult, TrainState

TERMS = ("image loss", "regulariser")
"""Terms of the loss. A non-finite term ends the step before the view has gradients."""
DIFFER = "the processes no longer hold the same scene; are the data, the packages and the kind of processor the same?"


class StepInterrupted(Exception):
    """The user wants to stop, and not wait for the other views of the step."""


def all_views(
    state: TrainState, frames: Frames, one_view: Callable[[TrainState, Frames, int, Stats], StepResult]
) -> StepResult:
    """Render and compare all views of a step, sharing them with the other processes if there are any.

    Args:
        one_view: runs the forward and backward pass of one view; adds to the parameters' gradients and to the given
            statistics.

    Returns:
        The result of this process's first view, but with the mean losses over all views, the size of the step's first
        view, and the first failure in any view. Without a failure, the parameters hold the mean gradient and
        ``state.stats`` includes the step.

    Raises:
        UserError: the processes are not at the same step.
        ProcessLost: another process has ended or hangs.
        StepInterrupted: ``frames.interrupted`` was True between two views of a single process; nothing has changed.
    """
    group, batch = state.group, state.config.batch
    size, rank = (1, 0) if group is None else (group.size, group.rank)
    rows: list[list[float]] = []
    shown: StepResult | None = None
    totals = None if group is None else (OrderedReduction(group), OrderedReduction(group, torch.maximum))
    stats = _empty(state)
    for first in range(0, batch, size):
        if group is not None:  # each round reduces the gradients of one view per process
            _drop_gradients(state)
            stats = _empty(state)
        elif first and frames.interrupted():
            _drop_gradients(state)
            raise StepInterrupted
        result = one_view(state, frames, first + rank, stats)
        shown = shown or result
        added = [] if result.failed else [*_gradients(state), stats.grad_norm, stats.count]
        row = _row(result, sum(vector.numel() for vector in added))
        rows += [row] if group is None else group.gather_rows(row)
        failed = next((TERMS[int(row[0])] for row in rows if row[0] >= 0), None)
        if failed is not None:
            return _result(shown, rows, failed)
        if totals is not None:
            if len({row[-1] for row in rows}) > 1:
                raise UserError(f"step {state.step}: {DIFFER}")
            totals[0].add(added)
            totals[1].add([stats.max_radii])
    if totals is not None:
        totals[0].write([*_gradients(state), stats.grad_norm, stats.count])
        totals[1].write([stats.max_radii])
    for gradient in _gradients(state):
        gradient *= 1.0 / batch
    state.stats.grad_norm += stats.grad_norm
    state.stats.count += stats.count
    torch.maximum(state.stats.max_radii, stats.max_radii, out=state.stats.max_radii)
    assert shown is not None
    return _result(shown, rows, None)


def _empty(state: TrainState) -> Stats:
    return Stats.zeros(len(state.gaussians), state.device, state.stats.absolute)


def _gradients(state: TrainState) -> list[Tensor]:
    return [gradient for optimizer in state.optimizers() for _, gradient in optimizer.gradients()]


def _drop_gradients(state: TrainState) -> None:
    for optimizer in state.optimizers():
        optimizer.zero_grad()


def _row(result: StepResult, length: int) -> list[float]:
    """Encode a view's result in numbers: index of the failed term (-1: success), losses, image size, and the number of
    elements to reduce."""
    code = -1 if result.failed is None else TERMS.index(result.failed)
    losses = float(result.loss), float(result.l1), float(result.ssim), result.regulariser
    return [code, *losses, *result.size, length]


def _result(shown: StepResult, rows: list[list[float]], failed: str | None) -> StepResult:
    loss, l1, ssim, regulariser = (sum(values) / len(rows) for values in list(zip(*rows))[1:5])
    loss, l1, ssim = (torch.tensor(value) for value in (loss, l1, ssim))
    size = int(rows[0][5]), int(rows[0][6])
    return shown._replace(loss=loss, l1=l1, ssim=ssim, regulariser=regulariser, size=size, failed=failed)


def check_share(config: TrainConfig, group: ProcessGroup | None) -> None:
    """Refuse a batch that the processes cannot share evenly, and a motion whose views train different networks: the
    gradients of all processes must be of the same parameters.

    Raises:
        UserError: the number of views is not a multiple of the number of processes, and names both; or
            ``motion.chunks`` is above 1.
    """
    if group is not None and group.size > 1 and config.motion.chunks > 1:
        raise UserError(
            f"motion.chunks is {config.motion.chunks}, which {group.size} processes cannot share; "
            "train without torchrun"
        )
    if group is not None and config.batch % group.size:
        raise UserError(
            f"batch is {config.batch}, which {group.size} processes cannot share evenly; give --batch a multiple of "
            f"{group.size}, or --nproc-per-node a divisor of {config.batch}"
        )


def check_replicas(state: TrainState) -> None:
    """Compare the parameters of all processes, which are equal by construction unless the processors round differently.

    Raises:
        UserError: they differ.
    """
    if state.group is None:
        return
    digest = zlib.crc32(str(state.step).encode())
    for module in (state.gaussians, state.motion, state.cameras, state.exposure):
        for parameter in module.parameters():
            digest = zlib.crc32(parameter.detach().cpu().contiguous().numpy().tobytes(), digest)
    if not state.group.agree(digest):
        raise UserError(f"step {state.step}: {DIFFER}")
