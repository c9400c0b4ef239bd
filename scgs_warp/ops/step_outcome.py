"""Outcome and update of a recorded training step, without the host. No gradients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernels import adam as adam_kernels
from ..kernels import step_outcome as kernels
from ..kernels.types import ADAM_CHUNK
from ..runtime.launch import launch
from .adam import element_chunks, table

REPORT_SIZE = 7


class Moments(NamedTuple):
    """A parameter with its gradient and moments: contiguous float32 of one shape, on one device, at fixed addresses."""

    value: Tensor
    gradient: Tensor
    exp_avg: Tensor
    exp_avg_sq: Tensor


class StepOutcome:
    """Outcome of the present step and whether steps are halted, both on the device."""

    def __init__(self, device: torch.device) -> None:
        self.halted = torch.zeros(1, dtype=torch.int32, device=device)
        """[1] 1 after a step whose lists of pairs had too little room: it and all later steps are not committed."""
        self.value = torch.zeros(1, dtype=torch.int32, device=device)
        """[1] ``STEP_FINE`` or what failed."""

    def judge_loss(self, pairs: Tensor, room: int, loss: Tensor, regulariser: Tensor | None) -> None:
        """Begin the outcome.

        Args:
            pairs: [1] int64 pairs of splat and tile.
            room: number of pairs that the lists hold.
            loss, regulariser: float32 scalars.
        """
        terms = loss.detach().view(1), _flat(regulariser), int(regulariser is not None)
        launch(kernels.judge_loss, 1, pairs, room, *terms, self.halted, self.value)

    def report(
        self, pairs: Tensor, loss: Tensor, l1: Tensor, ssim: Tensor, regulariser: Tensor | None, shown: Tensor
    ) -> Tensor:
        """Return outcome, pairs and the five scalars, [7] float64."""
        found = torch.empty(REPORT_SIZE, dtype=torch.float64, device=pairs.device)
        terms = (*(_flat(term) for term in (loss, l1, ssim, regulariser)), int(regulariser is not None))
        launch(kernels.report, 1, self.value, pairs, *terms, _flat(shown), found)
        return found


class UpdateTable:
    """Addresses of the tensors that every step of one kind checks and updates."""

    def __init__(self, checked: Sequence[Tensor], updates: Sequence[tuple[int, Moments]], device: torch.device) -> None:
        """
        Args:
            checked: gradients that must be finite.
            updates: tensors to update, each with the index of its parameter in ``rates`` and ``counts``.
        """
        self._kept = list(checked), list(updates)
        self._checked = _addresses([(gradient,) for gradient in checked], device).view(-1)
        self._checked_layout = element_chunks(tuple([gradient.numel() for gradient in checked]), device)
        self._updates = _addresses([moments for _, moments in updates], device)
        self._update_layout = element_chunks(tuple([moments.value.numel() for _, moments in updates]), device)
        self._rows = table([row for row, _ in updates], "int32", device)

    def judge_gradients(self, outcome: StepOutcome) -> None:
        """Add the first non-finite gradient, if there is one, to the outcome."""
        sizes, chunks = self._checked_layout
        launch(kernels.judge_gradients, len(chunks) * ADAM_CHUNK, self._checked, sizes, chunks, outcome.value)

    def adam_step(
        self, outcome: StepOutcome, rates: Tensor, counts: Tensor, betas: tuple[float, float], eps: float
    ) -> None:
        """Take the step of ``ops.adam.adam_step``, and count it, if the outcome is fine.

        Args:
            rates: [G] float64 learning rates.
            counts: [G] int32 steps taken so far.
        """
        factors = torch.empty(len(self._rows), 2, device=rates.device)
        launch(kernels.adam_factors, len(factors), rates, self._rows, outcome.value, *betas, counts, factors)
        sizes, chunks = self._update_layout
        numbers = 1.0 - betas[0], betas[1], 1.0 - betas[1], eps
        grid, tables = len(chunks) * ADAM_CHUNK, (self._updates, factors, sizes, chunks)
        launch(adam_kernels.adam_step, grid, *tables, *numbers, outcome.value, 1)


def _addresses(rows: Sequence[Sequence[Tensor]], device: torch.device) -> Tensor:
    return table([tuple(tensor.data_ptr() for tensor in row) for row in rows], "int64", device)


def _flat(term: Tensor | None) -> Tensor | None:
    return None if term is None else term.detach().view(1)
