"""Pose-dependent correctives: displacements that follow the rotation of their surface, with gradients."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..kernels import correctives as kernels
from ..kernels.cpu import correctives as cpu_kernels
from ..kernels.types import LANES
from ..runtime.launch import launch
from .forms import Form, chosen_form
from .shapes import check_shapes

COLUMNS = 27
"""Number of corrective parameters per Gaussian: a 3 x 9 matrix."""


class _Correct(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, correctives: Tensor, quats: Tensor, quats_t: Tensor, quats_own, form: Form):
        corrected, count = torch.empty_like(means), means.shape[0]
        if form == "cpu":
            turns = quats, quats_t, quats_own, int(quats_own is not None)
            launch(cpu_kernels.correct, -(-count // LANES), means, correctives, *turns, corrected, grain=32)
        else:
            turns = quats, quats_t, quats_t if quats_own is None else quats_own
            launch(kernels.correct, count, means, correctives, *turns, corrected)
        ctx.save_for_backward(correctives, quats, quats_t, quats_own)
        ctx.form = form
        return corrected

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_corrected: Tensor):  # type: ignore[override]
        correctives, quats, quats_t, quats_own = ctx.saved_tensors
        v_corrected, v_correctives = v_corrected.contiguous(), torch.empty_like(correctives)
        count = len(correctives)
        if ctx.form == "cpu":
            turns = quats, quats_t, quats_own, int(quats_own is not None)
            gradients = v_corrected, v_correctives
            launch(cpu_kernels.correct_adjoint, -(-count // LANES), correctives, *turns, *gradients, grain=32)
        else:
            turns = quats, quats_t, quats_t if quats_own is None else quats_own
            launch(kernels.correct_adjoint, count, correctives, *turns, v_corrected, v_correctives)
        return v_corrected, v_correctives, None, None, None, None


def correct(
    means: Tensor,
    correctives: Tensor,
    quats: Tensor,
    quats_t: Tensor,
    quats_own: Tensor | None = None,
    *,
    form: Form = "auto",
) -> Tensor:
    """Move skinned means by ``0.1 R C vec(R - I)``, where R turns ``quats`` to ``quats_t``.

    Args:
        means: [N, 3] skinned.
        correctives: [N, 27] the matrices C [3, 9], row by row, in the frame at rest.
        quats: [N, 4] wxyz at rest, any norm.
        quats_t: [N, 4] wxyz at the rendered instant, any norm.
        quats_own: [N, 4] wxyz that take the place of ``quats_t`` in R - I: those of the motion, where ``quats_t``
            includes an edit. None: ``quats_t``.
        form: kernels to run: ``plain`` on any device, ``cpu`` in SIMD; ``auto`` takes the fastest for the device.

    Returns:
        [N, 3] means. Gradients reach ``means`` and ``correctives``, but not the rotations, so that training does not
        turn surfaces to move them. A non-finite displacement is left out.

    Raises:
        ValueError: a shape or the form is wrong.
    """
    count = means.shape[0]
    expected = {
        "means": (means, (count, 3)),
        "correctives": (correctives, (count, COLUMNS)),
        "quats": (quats, (count, 4)),
        "quats_t": (quats_t, (count, 4)),
        "quats_own": (quats_own, (count, 4)),
    }
    check_shapes(expected)
    form = chosen_form(form, means.device)
    turns = (None if value is None else value.detach().contiguous() for value in (quats, quats_t, quats_own))
    return _Correct.apply(means.contiguous(), correctives.contiguous(), *turns, form)  # type: ignore[return-value]
