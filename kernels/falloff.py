"""Falloff of a splat's alpha: ``exp(-u - s u^2)`` with ``u = q / 2``, where q is the squared distance from the mean in
units of the covariance.

With the sharpness s = 0 this is a Gaussian. A larger s cuts off the tails, so that the outline of an opaque surface is
as sharp as in the images. Kernels whose shape the training can choose are known from GES (Hamdi et al. 2024); this one
costs a multiplication and has the Gaussian as its first-order limit at the mean.
"""

from __future__ import annotations

import warp as wp

from .types import ALPHA_MIN

wp.set_module_options({"enable_backward": False})


FURTHEST = wp.constant(1.0e18)
"""Largest u. Without sharpness, an infinite one gives ``inf * 0``, and the limit of alpha then takes NaN for opaque."""


@wp.func
def falloff(q: float, sharpness: float) -> float:
    u = wp.min(0.5 * q, FURTHEST)
    return wp.exp(-u * (1.0 + sharpness * u))


@wp.func
def sharp_reach(reach: float, sharpness: float) -> float:
    """Return the u at which ``u + s u^2`` is ``reach``; bit-identical to ``reach`` with s = 0."""
    return 2.0 * reach / (1.0 + wp.sqrt(1.0 + 4.0 * sharpness * reach))


@wp.kernel
def reaching_opacities(
    first: int,
    # In:
    opacities_in: wp.array[float],  # [N]
    sharpness: float,
    # Out:
    reaching_out: wp.array[float],  # [N]
):
    """Compute the opacities at which Gaussians reach as far as these splats: binning then lists the same tiles."""
    i = first + wp.tid()
    opacity = opacities_in[i]
    if opacity > ALPHA_MIN:
        opacity = ALPHA_MIN * wp.exp(sharp_reach(wp.log(opacity / ALPHA_MIN), sharpness))
    reaching_out[i] = opacity
