"""Limits for gradients, applied at the ends of adjoint kernels.

Extreme but finite values have gradients that overflow. Such a gradient of a Gaussian or control point becomes 0, so
that sums over many Gaussians stay finite. A NaN from a loss stays visible: gradients of colours are not limited, and
a Gaussian whose incoming gradient is non-finite passes it on.
"""

import warp as wp

from .types import GRADIENT_MAX, POSITION_MAX

wp.set_module_options({"enable_backward": False})


@wp.func
def passed(gradient: float) -> float:
    """Return the gradient, or 0 where it is NaN or beyond GRADIENT_MAX."""
    return wp.where(wp.abs(gradient) <= GRADIENT_MAX, gradient, 0.0)


@wp.func
def passed(gradient: wp.vec2) -> wp.vec2:  # noqa: F811  (Warp overloads by type)
    return wp.vec2(passed(gradient[0]), passed(gradient[1]))


@wp.func
def passed(gradient: wp.vec3) -> wp.vec3:  # noqa: F811
    return wp.vec3(passed(gradient[0]), passed(gradient[1]), passed(gradient[2]))


@wp.func
def passed(gradient: wp.vec4) -> wp.vec4:  # noqa: F811
    return wp.vec4(passed(gradient[0]), passed(gradient[1]), passed(gradient[2]), passed(gradient[3]))


@wp.func
def beyond(gradient: float) -> int:
    """Return the number of components that are NaN or beyond GRADIENT_MAX."""
    return wp.where(wp.abs(gradient) <= GRADIENT_MAX, 0, 1)


@wp.func
def beyond(gradient: wp.vec3) -> int:  # noqa: F811
    return beyond(gradient[0]) + beyond(gradient[1]) + beyond(gradient[2])


@wp.func
def beyond(gradient: wp.vec4) -> int:  # noqa: F811
    return beyond(gradient[0]) + beyond(gradient[1]) + beyond(gradient[2]) + beyond(gradient[3])


@wp.func
def near(position: wp.vec3) -> bool:
    """Return whether a position is within POSITION_MAX, where gradients can be computed; false for NaN."""
    return (
        wp.abs(position[0]) <= POSITION_MAX
        and wp.abs(position[1]) <= POSITION_MAX
        and wp.abs(position[2]) <= POSITION_MAX
    )
