"""What follows skinning: correctives, tints, shading and activations; on a CPU a launch each way, with gradients."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ..kernels.cpu import finishing as cpu_kernels
from ..kernels.posing import LOG_SCALES, TINTS
from ..kernels.types import LANES
from ..runtime.launch import launch
from .activations import exponential, sigmoid
from .correctives import COLUMNS as CORRECTIVE_COLUMNS
from .correctives import correct
from .forms import Form, chosen_form
from .shading import COLUMNS as SHADING_COLUMNS
from .shading import shade, tint
from .shapes import check_shapes

Finished = tuple[Tensor, Tensor, Tensor, Tensor]


def finish(
    means: Tensor,
    quats_t: Tensor,
    rest: tuple[Tensor, ...],
    log_scales: Tensor | None = None,
    tints: Tensor | None = None,
    quats_own: Tensor | None = None,
    *,
    form: Form = "auto",
) -> Finished:
    """Apply correctives, tints and shading to skinned Gaussians, and activate them.

    Args:
        means: [N, 3] skinned.
        quats_t: [N, 4] wxyz, skinned, any norm.
        rest: as for :func:`..posing.pose_gaussians`; of the means at rest, only the number is read.
        log_scales: [N, 3] to be added to those at rest.
        tints: [N, 3] changes of the logarithms of the colours; not both.
        quats_own: [N, 4] wxyz, any norm: rotations that correctives and shading follow instead of ``quats_t``.
        form: ``plain`` runs a function for each part, on any device; ``cpu`` runs one kernel in SIMD, with the same
            bits as the parts on a CPU; ``auto`` takes the fastest for the device.

    Returns:
        Means, scales, opacities and ``sh_dc``. Means without correctives, and ``sh_dc`` with neither tints nor shading,
        are the given ones. Gradients are those of ``correct``, ``tint``, ``shade`` and the activations, so rotations
        get none.

    Raises:
        ValueError: a shape or the form is wrong, or there are both log scales and tints.
    """
    _check(means, quats_t, rest, log_scales, tints, quats_own)
    if chosen_form(form, means.device) == "plain":
        return _in_parts(means, quats_t, rest, log_scales, tints, quats_own)
    _, quats, rest_scales, logits, sh_dc, correctives, shading = rest
    extras, kind = (log_scales, LOG_SCALES) if tints is None else (tints, TINTS)
    turns = quats.detach(), quats_t.detach(), None if quats_own is None else quats_own.detach()
    learnt = rest_scales, logits, sh_dc, correctives, shading, extras
    kind = 0 if extras is None else int(kind)
    found: Any = _Finish.apply(means if correctives.shape[1] else None, *learnt, *turns, kind)
    displaced, scales, opacities, colored = found
    return means if displaced is None else displaced, scales, opacities, sh_dc if colored is None else colored


def _in_parts(means: Tensor, quats_t: Tensor, rest: tuple[Tensor, ...], log_scales, tints, quats_own) -> Finished:
    _, quats, rest_scales, logits, sh_dc, correctives, shading = rest
    if correctives.shape[1]:
        means = correct(means, correctives, quats, quats_t, quats_own)
    scales = exponential(rest_scales if log_scales is None else rest_scales + log_scales)
    if tints is not None:
        sh_dc = tint(sh_dc, tints)
    if shading.shape[1]:
        sh_dc = shade(sh_dc, shading, quats, quats_t if quats_own is None else quats_own)
    return means, scales, sigmoid(logits), sh_dc


class _Finish(torch.autograd.Function):
    """Both passes, each in one launch. What a Gaussian does not have is not computed: None stands for it."""

    @staticmethod
    def forward(
        ctx: Any, means, log_scales, logits, sh_dc, correctives, shading, extras, quats, quats_t, quats_own, kind: int
    ):
        log_scales, logits, sh_dc = (value.contiguous() for value in (log_scales, logits, sh_dc))
        correctives, shading, quats, quats_t = (x.contiguous() for x in (correctives, shading, quats, quats_t))
        means, extras, quats_own = (
            None if value is None else value.contiguous() for value in (means, extras, quats_own)
        )
        displaced = None if means is None else torch.empty_like(means)
        colored = torch.empty_like(sh_dc) if kind == TINTS or shading.shape[1] else None
        scales, opacities = torch.empty_like(log_scales), torch.empty_like(logits)
        inputs = means, log_scales, logits, sh_dc, correctives, shading, extras, kind
        turns = quats, quats_t, quats_own, int(quats_own is not None)
        outputs = displaced, scales, opacities, colored
        launch(cpu_kernels.finish, -(-len(scales) // LANES), *inputs, *turns, *outputs, grain=32)
        tints = extras if kind == TINTS else None
        ctx.save_for_backward(scales, opacities, sh_dc, correctives, shading, tints, quats, quats_t, quats_own)
        ctx.kind = kind
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients):  # type: ignore[override]
        scales, opacities, sh_dc, correctives, shading, tints, quats, quats_t, quats_own = ctx.saved_tensors
        v_means, v_scales, v_opacities, v_colors = (None if v is None else v.contiguous() for v in gradients)
        # What has no gradient passes none on.
        v_log_scales = None if v_scales is None else torch.empty_like(scales)
        v_logits = None if v_opacities is None else torch.empty_like(opacities)
        v_correctives = None if v_means is None else torch.empty_like(correctives)
        v_shading = torch.empty_like(shading) if v_colors is not None and shading.shape[1] else None
        v_tints = None if v_colors is None or tints is None else torch.empty_like(tints)
        v_sh_dc = None if v_colors is None else torch.empty_like(sh_dc)
        inputs = scales, opacities, sh_dc, correctives, shading, tints, ctx.kind
        turns = quats, quats_t, quats_own, int(quats_own is not None)
        v_finished = v_means, v_scales, v_opacities, v_colors
        v_rest = v_log_scales, v_logits, v_sh_dc, v_correctives, v_shading
        launch(
            cpu_kernels.finish_adjoint,
            -(-len(scales) // LANES),
            *(*inputs, *turns, *v_finished, *v_rest, v_tints),
            grain=32,
        )
        v_extras = v_log_scales if ctx.kind == LOG_SCALES else v_tints
        return v_means, *v_rest, v_extras, None, None, None, None


def check_rest(rest: tuple[Tensor, ...], quats_own: Tensor | None) -> None:
    """Check the shapes of the raw parameters after the first two, and of ``quats_own``, as for :func:`finish`.

    Raises:
        ValueError: a shape is wrong.
    """
    count, names = len(rest[0]), ("log_scales", "opacity_logits", "sh_dc", "correctives", "shading", "quats_own")
    correctives, shading = ([(count, width), (count, 0)] for width in (CORRECTIVE_COLUMNS, SHADING_COLUMNS))
    shapes = [(count, 3)], [(count,)], [(count, 3)], correctives, shading, [(count, 4)]
    for name, value, allowed in zip(names, (*rest[2:], quats_own), shapes, strict=True):
        if value is not None and tuple(value.shape) not in allowed:
            raise ValueError(f"{name} must be {' or '.join(str([*x]) for x in allowed)}, got {tuple(value.shape)}")


def _check(means: Tensor, quats_t: Tensor, rest: tuple[Tensor, ...], log_scales, tints, quats_own) -> None:
    count = len(rest[0])
    expected = {
        "means": (means, (count, 3)),
        "quats_t": (quats_t, (count, 4)),
        "quats": (rest[1], (count, 4)),
        "added log_scales": (log_scales, (count, 3)),
        "tints": (tints, (count, 3)),
    }
    check_shapes(expected)
    if log_scales is not None and tints is not None:
        raise ValueError("there are log_scales or tints, not both")
    check_rest(rest, quats_own)
