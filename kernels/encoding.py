"""Positional encoding of positions and times: the rows that the deformation network reads."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def encoded(value: float, part: int, frequencies: int) -> float:
    """Return part 0: the value; 1 to F: sin(2^k value), k = 0 .. F - 1; F + 1 to 2 F: cos(2^k value)."""
    if part == 0:
        return value
    octave = part - 1
    if octave >= frequencies:
        octave -= frequencies
    angle = value * float(1 << octave)
    if part > frequencies:
        return wp.cos(angle)
    return wp.sin(angle)


@wp.kernel
def encode(
    first: int,
    # In:
    positions_in: wp.array2d[float],  # [M, 3]
    times_in: wp.array[float],  # [T]
    position_frequencies: int,
    time_frequencies: int,
    columns: int,  # 3 (1 + 2 F) of the position, then 1 + 2 F of the time
    # Out:
    rows_out: wp.array2d[float],  # [T M, columns]
):
    """Write one entry. Grid: T M columns."""
    index = first + wp.tid()
    row = index // columns
    column = index - row * columns
    count = positions_in.shape[0]
    instant = row // count
    own = 3 * (1 + 2 * position_frequencies)
    if column < own:
        value = positions_in[row - instant * count, column % 3]
        rows_out[row, column] = encoded(value, column // 3, position_frequencies)
    else:
        rows_out[row, column] = encoded(times_in[instant], column - own, time_frequencies)
