"""What becomes of gradients that are beyond use: functions for the ends of adjoint kernels.

Extreme values, though finite, have gradients that overflow. Where that happens a Gaussian (or a control point) passes
none, and what it shares sums with stays finite. A NaN that comes in from a loss is not hidden: it goes out with the
gradients of colours, which are handed on as they are, and of Gaussians whose incoming gradient is not finite.
"""

import warp as wp

from .types import GRADIENT_MAX, POSITION_MAX

wp.set_module_options({"enable_backward": False})


@wp.func
def passed(gradient: float) -> float:
    """The gradient, or 0 where it is not finite or beyond use."""
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
    """1 for NaN and what is beyond use, else 0: sums of it tell how many are."""
    return wp.where(wp.abs(gradient) <= GRADIENT_MAX, 0, 1)


@wp.func
def beyond(gradient: wp.vec3) -> int:  # noqa: F811
    return beyond(gradient[0]) + beyond(gradient[1]) + beyond(gradient[2])


@wp.func
def beyond(gradient: wp.vec4) -> int:  # noqa: F811
    return beyond(gradient[0]) + beyond(gradient[1]) + beyond(gradient[2]) + beyond(gradient[3])


@wp.func
def near(position: wp.vec3) -> bool:
    """Whether a position is one that gradients can be computed for; false for NaN."""
    return (
        wp.abs(position[0]) <= POSITION_MAX
        and wp.abs(position[1]) <= POSITION_MAX
        and wp.abs(position[2]) <= POSITION_MAX
    )
