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
"""Smallest alpha of a splat at a pixel; a smaller one could not change an 8-bit image and is skipped."""

ALPHA_MAX = wp.constant(0.999)
"""Upper clamp of alpha, so that the adjoint can divide by 1 - alpha; a clamped alpha passes no gradient."""

TRANSMITTANCE_MIN = wp.constant(1.0e-4)
"""Smallest transmittance of a pixel: it ends for good before the splat that would leave no more than this."""

CHANNEL_MAX = wp.constant(1.0e18)
"""Largest channel of a splat; a splat beyond this or with a NaN is left out. The square of this is still a float32,
and so are the gradients of the splats behind."""

GRADIENT_MAX = wp.constant(1.0e30)
"""Largest gradient of one Gaussian; one beyond this counts as 0. Sums over a hundred million Gaussians stay finite."""

POSITION_MAX = wp.constant(1.0e18)
"""Largest coordinate of a Gaussian that passes gradients to its control points: products beyond it would overflow."""

SLOT_GEOMETRY = 8
"""Leading columns of a gradient slot: 2D mean (2), conic (3), opacity (1), absolute 2D mean (2); channels follow."""

PACKED_GEOMETRY = 8
"""Leading columns of a splat packed for the CPU: mean 2, scaled conic 3, log2 of the opacity, its inverse, -B / A."""

CHANNEL_GROUP = 8
"""Granularity of a packed splat's channels on the CPU, which are padded with zeros to a multiple of this."""

ADAM_CHUNK = 4096
"""Elements of a chunk, the share of a tensor that one grid index of the CPU's Adam updates."""

ADAM_GRADIENT_MAX = wp.constant(1.0e19)
"""Clamp of finite gradients in Adam: beyond it their square would overflow, and the value would never move again."""

ROOFLINE_CHAINS = 12
"""Independent sums of a thread: enough to hide the latency of a multiply-add, few enough to stay in registers."""

ROOFLINE_BLOCK = 1 << 18
"""Floats that one grid index copies: 1 MiB."""

NETWORK_PANEL = 32
"""Columns of a panel of the network's matrices on a CPU. Widths of hidden layers are multiples of it."""

NETWORK_BLOCK = 32
"""Rows that one grid index takes through all layers on a CPU; matrices have a multiple of 8 rows."""

SSIM_BAND = 64
"""Rows that one grid index of the CPU's photometric loss computes; 10 more rows are blurred horizontally per band."""

SSIM_BLOCK = 128
"""Columns that it works on at once: 4 maps x 11 rows x 128 columns are 22 KiB."""

MAX_DIMENSIONS = 64
"""Most dimensions of points that the SIMD search for neighbours takes: it keeps a block's coordinates on the stack."""

MAX_HYPER = 8
"""Most hyper-coordinates of a Gaussian that SIMD skinning takes: the room for them in a control point's row."""
