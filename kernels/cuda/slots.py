"""Sums over each splat's gradient slots on CUDA."""

from __future__ import annotations

import warp as wp

from ..compositing import SLOT_WIDTH as SLOT_WIDTH
from ..gradient_limits import passed
from ..types import SLOT_GEOMETRY

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def sum_slots(
    first: int,
    # In:
    offsets_in: wp.array[wp.int64],  # [N + 1] a splat's slots
    v_slots_in: wp.array2d[float],  # [P, 16]
    more: int,  # whether these sums go on from what the outputs hold, else from zero
    # Out:
    v_means2d_out: wp.array2d[float],  # [N, 2]
    v_conics_out: wp.array2d[float],  # [N, 3]
    v_opacities_out: wp.array[float],  # [N]
    v_channels_out: wp.array2d[float],  # [N, C], C <= 8
    absgrad_out: wp.array2d[float],  # [N, 2]; empty: not wanted
):
    """Sum each splat's slots as ``compositing.sum_slots`` does, one column per thread to coalesce reads. Grid: 16 N."""
    t = first + wp.tid()
    i = t // SLOT_WIDTH
    column = t - i * SLOT_WIDTH
    total = float(0.0)
    if more != 0:
        if column < 2:
            total = v_means2d_out[i, column]
        elif column < 5:
            total = v_conics_out[i, column - 2]
        elif column < 6:
            total = v_opacities_out[i]
        elif column < SLOT_GEOMETRY:
            if absgrad_out.shape[0] > 0:
                total = absgrad_out[i, column - 6]
        elif column - SLOT_GEOMETRY < v_channels_out.shape[1]:
            total = v_channels_out[i, column - SLOT_GEOMETRY]
    for s in range(int(offsets_in[i]), int(offsets_in[i + 1])):
        total += v_slots_in[s, column]
    if column < SLOT_GEOMETRY:
        total = passed(total)
    if column < 2:
        v_means2d_out[i, column] = total
    elif column < 5:
        v_conics_out[i, column - 2] = total
    elif column < 6:
        v_opacities_out[i] = total
    elif column < SLOT_GEOMETRY:
        if absgrad_out.shape[0] > 0:
            absgrad_out[i, column - 6] = total
    elif column - SLOT_GEOMETRY < v_channels_out.shape[1]:
        v_channels_out[i, column - SLOT_GEOMETRY] = total
