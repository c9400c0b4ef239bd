"""What keeps feature planes smooth, on a CPU, and its gradient: squared differences between neighbouring texels.

Planes and their table are those of ``planes_cpu.py``. Along t the differences are second ones: a feature may change,
but evenly. Time planes are also drawn to 1, where nothing moves, by their mean absolute distance from it.
"""

from __future__ import annotations

import warp as wp

from .simd import SIMD

wp.set_module_options({"enable_backward": False})

_PRELUDE = (
    SIMD
    + """
    enum { VALUES, COLUMNS, ROWS, LINE, GRADIENT, ENTRIES };
    enum { CHANNELS = 32, PLANES = 6 };
    typedef float vfu __attribute__((vector_size(64), aligned(4)));
    const long long* own = table.data + plane * ENTRIES;
    const int columns = (int)own[COLUMNS], rows = (int)own[ROWS], n = columns * CHANNELS;
    const bool timely = plane % PLANES >= 3;
    if (row >= rows) return;
    const float* x = (const float*)own[VALUES] + (long long)row * n;
    auto at = [&](int r, int k) -> vf { return *(const vfu*)(x + (long long)r * n + k); };  // r from this row
    const float across = space / ((float)CHANNELS * rows * (columns - 1));
    const int terms = rows - (timely ? 2 : 1);
    const float down = terms > 0 ? (timely ? time : space) / ((float)CHANNELS * terms * columns) : 0.0f;
    const float away = timely ? rest / ((float)CHANNELS * rows * columns) : 0.0f;
"""
)

_VALUES = (
    """
#if !defined(__CUDA_ARCH__)
{
"""
    + _PRELUDE
    + """
    vf a = ZERO, d = ZERO, r = ZERO;
    for (int k = 0; k < n - CHANNELS; k += 16) {
        const vf e = at(0, k + CHANNELS) - at(0, k);
        a += e * e;
    }
    if (row < terms)
        for (int k = 0; k < n; k += 16) {
            const vf e = timely ? (at(2, k) - at(1, k)) - (at(1, k) - at(0, k)) : at(1, k) - at(0, k);
            d += e * e;
        }
    if (away != 0.0f)
        for (int k = 0; k < n; k += 16) {
            const vf e = at(0, k) - 1.0f;
            r += e < 0.0f ? -e : e;
        }
    const vf all = a * across + d * down + r * away;
    float sum = 0.0f;
    for (int l = 0; l < 16; ++l) sum += all[l];
    sums.data[place] = sum;
}
#endif
"""
)

_ADJOINT = (
    """
#if !defined(__CUDA_ARCH__)
{
"""
    + _PRELUDE
    + """
    float* to = (float*)own[GRADIENT] + (long long)row * n;
    if (weight == 0.0f) {
        __builtin_memset(to, 0, n * sizeof(float));
        return;
    }
    const float side = 2.0f * weight * across, along = 2.0f * weight * down, pull = weight * away;
    auto bend = [&](int r, int k) -> vf {  // second difference that begins at row r from here, if there is one
        if (row + r < 0 || row + r >= terms) return ZERO;
        return (at(r + 2, k) - at(r + 1, k)) - (at(r + 1, k) - at(r, k));
    };
    for (int k = 0; k < n; k += 16) {
        vf left = ZERO, right = ZERO, sum = ZERO;
        if (k >= CHANNELS) left = at(0, k) - at(0, k - CHANNELS);
        if (k < n - CHANNELS) right = at(0, k + CHANNELS) - at(0, k);
        if (timely) sum = (bend(0, k) - bend(-1, k)) + (bend(-2, k) - bend(-1, k));
        else {
            if (row > 0) sum = at(0, k) - at(-1, k);
            if (row + 1 < rows) sum -= at(1, k) - at(0, k);
        }
        const vf e = at(0, k) - 1.0f, sign = e > 0.0f ? ZERO + pull : (e < 0.0f ? ZERO - pull : ZERO);
        *(vfu*)(to + k) = (left - right) * side + sum * along + sign;
    }
}
#endif
"""
)


# fmt: off
@wp.func_native(_VALUES)
def _variation(
    place: int, plane: int, row: int, space: float, time: float, rest: float, table: wp.array2d[wp.int64],
    sums: wp.array[float],
): ...


@wp.func_native(_ADJOINT)
def _variation_adjoint(
    plane: int, row: int, weight: float, space: float, time: float, rest: float, table: wp.array2d[wp.int64]
): ...
# fmt: on


@wp.kernel
def plane_variation(
    first: int,
    # In:
    rows: int,  # of the tallest plane
    space: float,  # weight of first differences along x, y, z
    time: float,  # of second differences along t
    rest: float,  # of the time planes' distance from 1
    table_in: wp.array2d[wp.int64],  # [6 L, 5]
    # Out:
    sums_out: wp.array[float],  # [6 L rows] zero before
):
    """Weighted sums row by row, each kind divided by the number of its terms in a plane."""
    i = first + wp.tid()
    _variation(i, i // rows, i % rows, space, time, rest, table_in, sums_out)


@wp.kernel
def plane_variation_adjoint(
    first: int,
    # In:
    rows: int,  # of the tallest plane
    weight: float,  # gradient of the whole
    space: float,  # weights as in plane_variation
    time: float,
    rest: float,
    table_in: wp.array2d[wp.int64],  # [6 L, 5]
):
    """Writes the planes' gradients where the table says: all of them, also where the weight is 0."""
    i = first + wp.tid()
    _variation_adjoint(i // rows, i % rows, weight, space, time, rest, table_in)
