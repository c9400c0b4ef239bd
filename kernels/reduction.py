"""Column sums, added up in an order that depends on the data's shape alone."""

import warp as wp

wp.set_module_options({"enable_backward": False})

ROWS = wp.constant(64)


@wp.kernel
def sum_rows(
    first: int,
    # In:
    values_in: wp.array2d[float],  # [N, C]
    # Out:
    sums_out: wp.array2d[float],  # [ceil(N / ROWS), C]
):
    """Sum each column over groups of ``ROWS`` consecutive rows. Grid: ceil(N / ROWS) x C."""
    i = first + wp.tid()
    columns = values_in.shape[1]
    group = i // columns
    column = i - group * columns
    total = float(0.0)
    for row in range(group * ROWS, wp.min((group + 1) * ROWS, values_in.shape[0])):
        total += values_in[row, column]
    sums_out[group, column] = total
