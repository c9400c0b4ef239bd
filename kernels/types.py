"""Constants that several stages share, each with its reason."""

from __future__ import annotations

import warp as wp

LOG2_E = 1.4426950408889634
"""Constant log2(e), since exponentials are taken to base 2."""

TILE_SIZE = 16
"""Side of a tile in pixels. Its 256 pixels are 16 SIMD registers of 4 x 4 pixels, or one CUDA block."""

LANES = 16
"""Number of floats in a vector of the CPU's kernels, one AVX-512 register."""

ALPHA_MIN = wp.constant(1.0 / 255.0)
"""Smallest alpha of a splat at a pixel; a smaller one could not change an 8-bit image and is skipped."""

ALPHA_MAX = wp.constant(0.999)
"""Upper clamp of alpha, so that the adjoint can divide by 1 - alpha; a clamped alpha passes no gradient."""

TRANSMITTANCE_MIN = wp.constant(1.0e-4)
"""Smallest transmittance of a pixel: blending ends before the splat that would reduce it to this value or less."""

CHANNEL_MAX = wp.constant(1.0e18)
"""Largest magnitude of a splat's channel; a splat with a larger one or a NaN is left out. The square of the limit and
the gradients of the splats behind still fit into float32."""

GRADIENT_MAX = wp.constant(1.0e30)
"""Largest gradient of one Gaussian; a larger one becomes 0, so that sums over 100 million Gaussians stay finite."""

POSITION_MAX = wp.constant(1.0e18)
"""Largest coordinate of a Gaussian that passes gradients to its control points: larger ones would overflow."""

SLOT_GEOMETRY = 8
"""Number of columns before the channels in a gradient slot: 2D mean (2), conic (3), opacity, absolute 2D mean (2)."""

PACKED_GEOMETRY = 10
"""Number of columns before the channels in a splat packed for the CPU: mean (2), scaled conic (3), log2 of the opacity,
its inverse, -B / A, the bound below which a fall counts (0: nowhere), and -B / C. See ``cpu.compositing``."""

CHANNEL_GROUP = 8
"""More than four channels of a packed splat on the CPU are padded with zeros to a multiple of this number."""

ADAM_CHUNK = 4096
"""Number of elements in a chunk, the part of a tensor that one grid index of the CPU's Adam updates."""

ADAM_GRADIENT_MAX = wp.constant(1.0e19)
"""Limit to which Adam clamps finite gradients: a square that overflows would freeze the value for good."""

STEP_FINE = wp.constant(2**31 - 1)
"""Outcome of a recorded training step that is committed. Any other outcome is the number of what failed; the least one
counts."""

STEP_HALTED = wp.constant(-1)
"""Outcome of a step whose lists had too little room, and of every step after it until the host has made room."""

STEP_LOSS, STEP_REGULARISER, STEP_GRADIENT = wp.constant(0), wp.constant(1), wp.constant(2)
"""Outcomes of steps with a non-finite loss, regulariser or first gradient; the next gradient's is one more."""

ROOFLINE_CHAINS = 12
"""Number of independent sums per thread: enough to hide a multiply-add's latency, few enough for the registers."""

ROOFLINE_BLOCK = 1 << 18
"""Number of floats that one grid index copies: 1 MiB."""

SHARED_ARGUMENTS = 4096
"""Largest size in bytes of the arguments of a kernel that threads of a CPU share."""

NETWORK_PANEL = 32
"""Number of columns in a panel of the network's matrices on a CPU. Widths of hidden layers are multiples of it."""

NETWORK_BLOCK = 32
"""Number of rows that one grid index takes through all layers on a CPU; matrices have a multiple of 8 rows."""
NETWORK_ADJOINT_ROWS = 1024
"""Largest number of rows of the network's adjoint in one launch; a multiple of 32. Its stack grows with it."""

SSIM_BAND = 64
"""Number of rows in a band, which one grid index of the CPU's photometric loss computes; it also blurs 10 rows
beyond."""

SSIM_BLOCK = 128
"""Number of columns of a band processed at once: 4 maps x 11 rows x 128 columns take 22 KiB."""

SSIM_TILE_COLUMNS, SSIM_TILE_ROWS = 32, 16
"""Size of a tile of the photometric loss on CUDA: a warp reads whole rows, two pixels per thread share their reads, and
four blocks fit into 100 KiB of shared memory."""

MAX_DIMENSIONS = 64
"""Largest number of dimensions in the SIMD search for neighbours, which keeps a block's coordinates on the stack."""

MAX_HYPER = 8
"""Largest number of hyper-coordinates in SIMD skinning: a control point's row has room for this many."""
