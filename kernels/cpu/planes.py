"""Feature planes over (x, y, z, t) on a CPU: samples multiplied over six planes, and their adjoint.

A level has six planes of 32 channels, channels last: (x, y), (x, z), (y, z), (x, t), (y, t), (z, t), each
[second axis, first axis, 32]. One texel is two vectors of 16 channels, two cache lines. All Gaussians are seen at one
time, so the time planes are interpolated along t first, into lines [first axis, 32]; a Gaussian then reads 3 x 4
texels and 3 x 2 of the lines. Channels meet only in the gradient of the positions, and levels nowhere: the adjoint has
one task for each level and half of the channels, which walks the Gaussians in order and adds to texels of its own.
"""

from __future__ import annotations

import warp as wp

from .simd import LANE_SUMS, SIMD

wp.set_module_options({"enable_backward": False})

CHANNELS = 32
HALVES = 2
LANES = 16
PLANES = 6
TABLE_COLUMNS = 5
"""Columns of the table of planes, as the enumeration in ``_PRELUDE``: address of the values, extents along the first
and the second axis, where the plane's line begins in the buffer of lines (time planes), address of the gradient."""

_PRELUDE = (
    SIMD
    + """
    enum { VALUES, COLUMNS, ROWS, LINE, GRADIENT, ENTRIES };
    enum { CHANNELS = 32, HALF = 16, PLANES = 6 };
    typedef float vfu __attribute__((vector_size(64), aligned(4)));
    auto vector = [](const float* at) -> vf { return *(const vfu*)at; };
    auto add = [](float* at, vf value) { *(vfu*)at = *(const vfu*)at + value; };
    auto entry = [&](int plane, int what) -> long long { return table.data[plane * ENTRIES + what]; };
"""
)

_TIME = """
    // Cell of a time: the row before it and the way to the next one.
    auto at_time = [&](int plane, int& row, float& fraction) {
        const int last = (int)entry(plane, ROWS) - 1;
        float t = time * last;
        t = t > 0.0f ? t : 0.0f;  // also where it is not a number
        t = t < last ? t : last;
        row = (int)t < last ? (int)t : last - 1;
        fraction = t - row;
    };
"""

_LOCATE = """
    // Cells of 16 Gaussians on a level's three axes. Positions are kept inside before they become integers; not a
    // number is the first texel. Where one was outside, or on the border, it has no gradient.
    const int N = positions.shape[0];
    const int FIRST[3] = {0, 0, 1}, SECOND[3] = {1, 2, 2};
    float way[3][16], scale[3][16];
    int cell[3][16];
    auto locate = [&](int level, int begin, int n) {
        for (int a = 0; a < 3; ++a) {
            const int last = (int)entry(level * PLANES + 3 + a, COLUMNS) - 1;
            vf p = ZERO;
            for (int l = 0; l < n; ++l) p[l] = positions.data[begin + l][a];
            const vf x = (p + 1.0f) * (0.5f * last);
            const vi inside = (x > 0.0f) & (x < (float)last);
            vf kept = x > 0.0f ? x : ZERO;
            kept = kept < (float)last ? kept : ZERO + (float)last;
            vi c = __builtin_convertvector(kept, vi);
            c = c < last ? c : (vi){} + last - 1;
            const vf w = kept - __builtin_convertvector(c, vf), s = inside ? ZERO + 0.5f * last : ZERO;
            __builtin_memcpy(cell[a], &c, 64);
            __builtin_memcpy(way[a], &w, 64);
            __builtin_memcpy(scale[a], &s, 64);
        }
    };
"""

_INTERPOLATE = (
    """
#if !defined(__CUDA_ARCH__)
{
"""
    + _PRELUDE
    + _TIME
    + """
    int row;
    float f;
    at_time(plane, row, f);
    const int n = (int)entry(plane, COLUMNS) * CHANNELS;
    const float* a = (const float*)entry(plane, VALUES) + (long long)row * n;
    float* to = lines.data + entry(plane, LINE);
    for (int k = 0; k < n; ++k) to[k] = a[k] * (1.0f - f) + a[n + k] * f;
}
#endif
"""
)

_FEATURES = (
    """
#if !defined(__CUDA_ARCH__)
{
"""
    + _PRELUDE
    + _LOCATE
    + """
    const int levels = table.shape.dims[0] / PLANES, begin = block * 16, n = N - begin < 16 ? N - begin : 16;
    for (int level = 0; level < levels; ++level) {
        locate(level, begin, n);
        const float *plane[3], *line[3];
        long long row[3];
        for (int p = 0; p < 3; ++p) {
            plane[p] = (const float*)entry(level * PLANES + p, VALUES);
            row[p] = entry(level * PLANES + p, COLUMNS) * CHANNELS;
            line[p] = lines.data + entry(level * PLANES + 3 + p, LINE);
        }
        for (int l = 0; l < n; ++l) {
            vf product[2];
            #pragma clang loop unroll(full)
            for (int p = 0; p < 3; ++p) {
                const int a = FIRST[p], b = SECOND[p];
                const float* at = plane[p] + cell[b][l] * row[p] + cell[a][l] * CHANNELS;
                const float fa = way[a][l], fb = way[b][l];
                const float w = (1.0f - fa) * (1.0f - fb), e = fa * (1.0f - fb), s = (1.0f - fa) * fb, d = fa * fb;
                #pragma clang loop unroll(full)
                for (int v = 0; v < 2; ++v, at += HALF) {
                    const float* below = at + row[p];
                    const vf value = vector(at) * w + vector(at + CHANNELS) * e + vector(below) * s
                        + vector(below + CHANNELS) * d;
                    product[v] = p ? product[v] * value : value;
                }
            }
            #pragma clang loop unroll(full)
            for (int p = 0; p < 3; ++p) {
                const float* at = line[p] + cell[p][l] * CHANNELS;
                const float f = way[p][l];
                #pragma clang loop unroll(full)
                for (int v = 0; v < 2; ++v, at += HALF)
                    product[v] *= vector(at) * (1.0f - f) + vector(at + CHANNELS) * f;
            }
            float* to = features.data + ((long long)(begin + l) * levels + level) * CHANNELS;
            for (int v = 0; v < 2; ++v) __builtin_memcpy(to + v * HALF, &product[v], 64);
        }
    }
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
    + LANE_SUMS
    + _TIME
    + _LOCATE
    + """
    const int levels = table.shape.dims[0] / PLANES, half = task % 2 * HALF;
    const int level = levels - 1 - task / 2;  // the finest, which takes longest, goes first
    const float *plane[3], *line[3];
    float *v_plane[3], *v_line[3];
    long long row[3];
    for (int p = 0; p < 3; ++p) {
        plane[p] = (const float*)entry(level * PLANES + p, VALUES) + half;
        v_plane[p] = (float*)entry(level * PLANES + p, GRADIENT) + half;
        row[p] = entry(level * PLANES + p, COLUMNS) * CHANNELS;
        line[p] = lines.data + entry(level * PLANES + 3 + p, LINE) + half;
        v_line[p] = v_lines.data + entry(level * PLANES + 3 + p, LINE) + half;
    }
    for (int begin = 0; begin < N; begin += 16) {
        const int n = N - begin < 16 ? N - begin : 16;
        locate(level, begin, n);
        vf slopes[3][16];
        for (int a = 0; a < 3; ++a) for (int l = n; l < 16; ++l) slopes[a][l] = ZERO;
        for (int l = 0; l < n; ++l) {
            vf s[6], v[6], slope[3] = {ZERO, ZERO, ZERO};
            long long at[3];
            #pragma clang loop unroll(full)
            for (int p = 0; p < 3; ++p) {
                const int a = FIRST[p], b = SECOND[p];
                at[p] = cell[b][l] * row[p] + cell[a][l] * CHANNELS;
                const float *upper = plane[p] + at[p], *below = upper + row[p], fa = way[a][l], fb = way[b][l];
                s[p] = (vector(upper) * (1.0f - fa) + vector(upper + CHANNELS) * fa) * (1.0f - fb)
                    + (vector(below) * (1.0f - fa) + vector(below + CHANNELS) * fa) * fb;
            }
            #pragma clang loop unroll(full)
            for (int p = 0; p < 3; ++p) {
                const float *from = line[p] + cell[p][l] * CHANNELS, f = way[p][l];
                s[3 + p] = vector(from) * (1.0f - f) + vector(from + CHANNELS) * f;
            }
            vf v_out;
            __builtin_memcpy(&v_out, v_features.data + ((long long)(begin + l) * levels + level) * CHANNELS + half, 64);
            const vf space = s[0] * s[1] * s[2], times = s[3] * s[4] * s[5];
            const vf v_space = v_out * times, v_times = v_out * space;
            v[0] = v_space * (s[1] * s[2]); v[1] = v_space * (s[0] * s[2]); v[2] = v_space * (s[0] * s[1]);
            v[3] = v_times * (s[4] * s[5]); v[4] = v_times * (s[3] * s[5]); v[5] = v_times * (s[3] * s[4]);
            #pragma clang loop unroll(full)
            for (int p = 0; p < 3; ++p) {
                const int a = FIRST[p], b = SECOND[p];
                const float *upper = plane[p] + at[p], *below = upper + row[p], fa = way[a][l], fb = way[b][l];
                const vf w = vector(upper), e = vector(upper + CHANNELS), o = vector(below);
                const vf d = vector(below + CHANNELS);
                slope[a] += v[p] * ((e - w) * (1.0f - fb) + (d - o) * fb);
                slope[b] += v[p] * ((o - w) * (1.0f - fa) + (d - e) * fa);
                float *to = v_plane[p] + at[p], *next = to + row[p];
                add(to, v[p] * ((1.0f - fa) * (1.0f - fb)));
                add(to + CHANNELS, v[p] * (fa * (1.0f - fb)));
                add(next, v[p] * ((1.0f - fa) * fb));
                add(next + CHANNELS, v[p] * (fa * fb));
            }
            #pragma clang loop unroll(full)
            for (int p = 0; p < 3; ++p) {
                const float *from = line[p] + cell[p][l] * CHANNELS, f = way[p][l];
                slope[p] += v[3 + p] * (vector(from + CHANNELS) - vector(from));
                float* to = v_line[p] + cell[p][l] * CHANNELS;
                add(to, v[3 + p] * (1.0f - f));
                add(to + CHANNELS, v[3 + p] * f);
            }
            for (int a = 0; a < 3; ++a) slopes[a][l] = slope[a];
        }
        for (int a = 0; a < 3; ++a) {
            const vf sums = lane_sums(slopes[a]);
            float* to = v_positions.data + ((long long)task * N + begin) * 3 + a;
            for (int l = 0; l < n; ++l) to[l * 3] = scale[a][l] > 0.0f ? scale[a][l] * sums[l] : 0.0f;
        }
    }
    for (int p = 0; p < 3; ++p) {
        int r;
        float f;
        at_time(level * PLANES + 3 + p, r, f);
        const int columns = (int)entry(level * PLANES + 3 + p, COLUMNS);
        float* to = (float*)entry(level * PLANES + 3 + p, GRADIENT) + (long long)r * columns * CHANNELS + half;
        for (int k = 0; k < columns * CHANNELS; k += CHANNELS) {
            const vf v = vector(v_line[p] + k);
            add(to + k, v * (1.0f - f));
            add(to + columns * CHANNELS + k, v * f);
        }
    }
}
#endif
"""
)


# fmt: off
@wp.func_native(_INTERPOLATE)
def _interpolate(plane: int, time: float, table: wp.array2d[wp.int64], lines: wp.array[float]): ...


@wp.func_native(_FEATURES)
def _features(
    block: int, table: wp.array2d[wp.int64], positions: wp.array[wp.vec3], lines: wp.array[float],
    features: wp.array2d[float],
): ...


@wp.func_native(_ADJOINT)
def _adjoint(
    task: int, time: float, table: wp.array2d[wp.int64], positions: wp.array[wp.vec3], lines: wp.array[float],
    v_features: wp.array2d[float], v_lines: wp.array[float], v_positions: wp.array3d[float],
): ...
# fmt: on


@wp.kernel
def interpolate_times(
    first: int,
    # In:
    time: float,
    table_in: wp.array2d[wp.int64],  # [6 L, 5]
    # Out:
    lines_out: wp.array[float],  # [first axis, 32] of every time plane, one after the other
):
    """The time planes at one time; index: time plane."""
    i = first + wp.tid()
    _interpolate((i // 3) * PLANES + 3 + i % 3, time, table_in, lines_out)


@wp.kernel
def plane_features(
    first: int,
    # In:
    table_in: wp.array2d[wp.int64],  # [6 L, 5]
    positions_in: wp.array[wp.vec3],  # [N] the planes span [-1, 1]
    lines_in: wp.array[float],
    # Out:
    features_out: wp.array2d[float],  # [N, 32 L]
):
    """Products of the six bilinear samples; index: block of 16 Gaussians."""
    _features(first + wp.tid(), table_in, positions_in, lines_in, features_out)


@wp.kernel
def plane_features_adjoint(
    first: int,
    # In:
    time: float,
    table_in: wp.array2d[wp.int64],  # [6 L, 5]
    positions_in: wp.array[wp.vec3],  # [N]
    lines_in: wp.array[float],
    v_features_in: wp.array2d[float],  # [N, 32 L]
    # Out:
    v_lines_out: wp.array[float],  # zero before
    v_positions_out: wp.array3d[float],  # [2 L, N, 3] a share of each task
):
    """Adds to the planes' gradients where the table says; index: level and half of the channels."""
    _adjoint(first + wp.tid(), time, table_in, positions_in, lines_in, v_features_in, v_lines_out, v_positions_out)
