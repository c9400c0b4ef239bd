"""What follows skinning, in plain torch, differentiable."""

from __future__ import annotations

from torch import Tensor

from reference.correctives import correct
from reference.shading import shade, tint


def finish(
    means: Tensor,
    quats_t: Tensor,
    rest: tuple[Tensor, ...],
    log_scales: Tensor | None = None,
    tints: Tensor | None = None,
    own: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Means, scales, opacities and ``sh_dc``; the arguments are those of ``scgs_warp.ops.finishing.finish``."""
    _, quats, rest_scales, logits, sh_dc, correctives, shading = rest
    if correctives.shape[1]:
        means = correct(means, correctives, quats, quats_t, own)
    if log_scales is not None:
        rest_scales = rest_scales + log_scales
    if tints is not None:
        sh_dc = tint(sh_dc, tints)
    if shading.shape[1]:
        sh_dc = shade(sh_dc, shading, quats, quats_t if own is None else own)
    return means, rest_scales.exp(), logits.sigmoid(), sh_dc
