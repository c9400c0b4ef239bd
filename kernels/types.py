"""Constants that several stages share, each with its reason."""

from __future__ import annotations

import warp as wp

LOG2_E = 1.4426950408889634
"""log2(e): exponentials are taken to base 2."""

TILE_SIZE = 16
"""Side of a tile in pixels: one row of it is one 512-bit SIMD register, its 256 pixels are one CUDA block."""

LANES = 16
"""Floats of a vector in the CPU's kernels, one AVX-512 register."""

ALPHA_MIN = wp.constant(1.0 / 255.0)
"""A splat is skipped at a pixel where its alpha is smaller: it could not change an 8-bit image."""

ALPHA_MAX = wp.constant(0.999)
"""Alpha is clamped here, so that the adjoint can divide by 1 - alpha; the clamped alpha passes no gradient."""

TRANSMITTANCE_MIN = wp.constant(1.0e-4)
"""A pixel ends for good before the splat that would leave no more than this: what follows is invisible."""

CHANNEL_MAX = wp.constant(1.0e18)
"""A splat with a channel beyond this is left out, as one with a NaN is: its square is still a float32, and so are the
gradients of what lies behind it."""

GRADIENT_MAX = wp.constant(1.0e30)
"""Larger gradients of one Gaussian are dropped: sums over a hundred million Gaussians are still finite."""

POSITION_MAX = wp.constant(1.0e18)
"""Gaussians farther from the origin pass their control points no gradient: products with it would overflow."""

SLOT_GEOMETRY = 8
"""Leading columns of a gradient slot: 2D mean (2), conic (3), opacity (1), absolute 2D mean (2); channels follow."""

PACKED_GEOMETRY = 8
"""Leading columns of a splat packed for the CPU: mean 2, scaled conic 3, log2 of the opacity, its inverse, -B / A."""

CHANNEL_GROUP = 8
"""Channels of a splat packed for the CPU are padded with zeros to a multiple of this."""

MAX_DIMENSIONS = 64
"""Most dimensions of points that the SIMD search for neighbours takes: it keeps a block's coordinates on the stack."""

MAX_HYPER = 8
"""Most hyper-coordinates of a Gaussian that SIMD skinning takes: the room for them in a control point's row."""
