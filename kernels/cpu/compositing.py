"""Alpha compositing on a CPU: one thread a tile, a row of 16 pixels in one SIMD register.

The bodies are native snippets with Clang's vector types, which compile for every CPU (one AVX-512 register, two AVX2
ones, four NEON ones). Semantics and arguments are those of ``compositing``; what differs is how the work is laid out:

- Splats come packed (``pack_splats``): one gather of a cache line or two per pair, logarithm and divisions done once.
- In base 2: ``alpha = 2^(power + log2 o)``, where ``power = -q / (2 ln 2)`` has its factor folded into the conic.
- The rows of a tile that a splat reaches are found by one vector operation over all 16 rows; only those are visited.
- A pixel that has ended is marked by the sign of its transmittance: its next transmittance is then never > 1e-4.
- The adjoint contracts the channels with the incoming gradient first, so one running sum a pixel suffices. It keeps
  the sums of a (tile, splat) pair in registers, a lane a column, and adds the lanes up at the end, 16 sums at a time.
"""

from __future__ import annotations

import warp as wp

from ..types import ALPHA_MAX, CHANNEL_MAX, TRANSMITTANCE_MIN
from .simd import LANE_SUMS, SIMD

wp.set_module_options({"enable_backward": False})

PACKED_GEOMETRY = 8
"""Leading columns of a packed splat: mean 2, scaled conic 3, log2 of the opacity, its inverse, -B / A."""

CHANNEL_GROUP = 8
"""Packed channels are padded with zeros to a multiple of this."""

TILE_SIDE = 16
"""The only tile size this form serves: a row is a register."""

_LOG2_E = 1.4426950408889634


@wp.kernel
def pack_splats(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N]
    conics_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    channels_in: wp.array2d[float],  # [N, C]
    # Out:
    packed_out: wp.array2d[float],  # [N, 8 + C padded to a multiple of 8]
):
    i = first + wp.tid()
    conic = conics_in[i]
    opacity = opacities_in[i]
    factor = float(-0.5 * _LOG2_E)
    count = channels_in.shape[1]
    for c in range(count):
        if not wp.abs(channels_in[i, c]) <= CHANNEL_MAX:
            opacity = float(0.0)  # never added: see compositing.finite_opacities
        packed_out[i, PACKED_GEOMETRY + c] = channels_in[i, c]
    for c in range(PACKED_GEOMETRY + count, packed_out.shape[1]):
        packed_out[i, c] = 0.0
    packed_out[i, 0] = means2d_in[i][0]
    packed_out[i, 1] = means2d_in[i][1]
    packed_out[i, 2] = factor * conic[0]
    packed_out[i, 3] = 2.0 * factor * conic[1]
    packed_out[i, 4] = factor * conic[2]
    packed_out[i, 5] = -1.0e30
    packed_out[i, 6] = 0.0
    packed_out[i, 7] = -conic[1] / conic[0]
    if opacity > 0.0:
        packed_out[i, 5] = wp.log2(opacity)
        packed_out[i, 6] = 1.0 / opacity


_PRELUDE = f"""
#if !defined(__CUDA_ARCH__)
{SIMD}
    const float ALPHA_MAX = {float(ALPHA_MAX)!r}f, TRANSMITTANCE_MIN = {float(TRANSMITTANCE_MIN)!r}f;
    const float LOG2_ALPHA_MIN = -7.994353436858858f;
    const int GEOMETRY = {PACKED_GEOMETRY}, GROUP = {CHANNEL_GROUP};

    // A splat as seen from the tile's first pixel; the lanes of the last three are the tile's rows.
    struct Splat {{
        float mx, a, log2_opacity, floor;
        vf dy, bdy, cdy2;
    }};
    const float x_begin = 16.0f * (tile % columns) + 0.5f, y_begin = 16.0f * (tile / columns) + 0.5f;
    auto read = [&](const float* s) -> Splat {{
        Splat g;
        g.mx = s[0] - x_begin;
        g.a = s[2];
        g.log2_opacity = s[5];
        g.floor = LOG2_ALPHA_MIN - s[5];
        g.dy = LANE - (s[1] - y_begin);
        g.bdy = s[3] * g.dy;
        g.cdy2 = s[4] * g.dy * g.dy;
        return g;
    }};
    // One bit for each row in which the ellipse meets the tile: q at the row's point nearest to the ellipse's axis.
    auto reached_rows = [&](const Splat& g, float slope) -> unsigned {{
        vf x = slope * g.dy;
        vf low = ZERO - g.mx, high = ZERO + (15.0f - g.mx);
        x = x < low ? low : x;
        x = x > high ? high : x;
        return bits((g.a * x + g.bdy) * x + g.cdy2 >= g.floor - 1e-3f);
    }};
    // The exponent at a row's pixels; forward and adjoint must round alike, or they disagree on who contributed.
    auto power_of = [](vf dx, float a, float bdy, float cdy2) -> vf {{
        return (a * dx + bdy) * dx + cdy2;
    }};
    const int begin = ranges.data[tile].c[0], end = ranges.data[tile].c[1];
    const int x0 = 16 * (tile % columns), y0 = 16 * (tile / columns);
    const int wide = width - x0 < 16 ? width - x0 : 16, tall = height - y0 < 16 ? height - y0 : 16;
    const long long plane = (long long)width * height, corner = (long long)y0 * width + x0;
    const int stride = packed.shape.dims[1];
"""

_FORWARD = (
    _PRELUDE
    + """
    struct Four { enum { value = 4 }; };
    struct Eight { enum { value = 8 }; };
    struct Yes { enum { value = 1 }; };
    struct No { enum { value = 0 }; };
    const bool keep = last.shape.dims[0] > 0;

    // One pass over the tile's splats for the channels from c0 on; only the first pass stores what has no channels.
    // By chunks of 32 splats, row by row: a row's state stays in registers while it walks those that reach it.
    auto pass = [&](auto group, auto keeping, int c0, int count) {
        constexpr int C = decltype(group)::value;
        constexpr bool KEEP = decltype(keeping)::value;
        vf T[16], sum[16][C];
        vi ends[16];
        Splat chunk[32];
        float channel[32][C];
        alignas(64) short reached[32];
        for (int r = 0; r < 16; ++r) {
            T[r] = LANE < (float)wide ? ZERO + 1.0f : ZERO - 1.0f;
            for (int c = 0; c < C; ++c) sum[r][c] = ZERO;
            ends[r] = vi{};
        }
        unsigned alive = (1u << tall) - 1u;
        for (int p0 = begin; p0 < end && alive; p0 += 32) {
            const int n = end - p0 < 32 ? end - p0 : 32;
            for (int k = 0; k < n; ++k) {
                const float* s = packed.data + (long long)splats.data[p0 + k] * stride;
                chunk[k] = read(s);
                reached[k] = (short)reached_rows(chunk[k], s[7]);
                for (int c = 0; c < C; ++c) channel[k][c] = s[GEOMETRY + c0 + c];
            }
            for (int k = n; k < 32; ++k) reached[k] = 0;
            for (unsigned rows = alive; rows; rows &= rows - 1u) {
                const int r = __builtin_ctz(rows);
                vs in_row;
                __builtin_memcpy(&in_row, reached, 64);
                unsigned hits = __builtin_bit_cast(unsigned, __builtin_convertvector((in_row >> r) << 15, vb32));
                vf t = T[r], own[C];
                vi own_ends = ends[r];
                for (int c = 0; c < C; ++c) own[c] = sum[r][c];
                for (; hits; hits &= hits - 1u) {
                    const int k = __builtin_ctz(hits);
                    const Splat& g = chunk[k];
                    const vf power = power_of(LANE - g.mx, g.a, ((const float*)&g.bdy)[r], ((const float*)&g.cdy2)[r]);
                    const vi skip = ~((power <= 0.0f) & (power >= g.floor));  // NaN too: infinities may cancel
                    vf alpha = exp2v(power + g.log2_opacity);
                    alpha = alpha > ALPHA_MAX ? ZERO + ALPHA_MAX : alpha;
                    alpha = skip ? ZERO : alpha;
                    const vf next = t - t * alpha;
                    const vi go = next > TRANSMITTANCE_MIN;
                    const vf w = go ? alpha * t : ZERO;
                    t = go ? next : (vf)((vu)t | 0x80000000u);
                    for (int c = 0; c < C; ++c) own[c] += w * channel[k][c];
                    if (KEEP) own_ends = (w > 0.0f) ? vi{} + (p0 + k + 1) : own_ends;
                }
                T[r] = t;
                for (int c = 0; c < C; ++c) sum[r][c] = own[c];
                if (KEEP) ends[r] = own_ends;
                if (!bits(t > 0.0f)) alive &= ~(1u << r);
            }
        }
        for (int r = 0; r < tall; ++r) {
            const vf t = (vf)((vu)T[r] & 0x7fffffffu);
            const long long at = corner + (long long)r * width;
            for (int c = 0; c < count; ++c)
                store(image.data + (c0 + c) * plane + at, sum[r][c] + t * background.data[c0 + c], wide);
            if (c0 == 0) store(alpha_image.data + at, 1.0f - t, wide);
            if (KEEP) {
                store(transmittance.data + at, t, wide);
                store((float*)last.data + at, (vf)ends[r], wide);
            }
        }
    };
    const int channels = image.shape.dims[0];
    for (int c0 = 0; c0 == 0 || c0 < channels; c0 += GROUP) {
        const int count = channels - c0 < GROUP ? channels - c0 : GROUP;
        const bool first_pass = keep && c0 == 0;
        if (count <= 4) first_pass ? pass(Four(), Yes(), c0, count) : pass(Four(), No(), c0, count);
        else first_pass ? pass(Eight(), Yes(), c0, count) : pass(Eight(), No(), c0, count);
    }
#endif
"""
)

_ADJOINT = (
    _PRELUDE
    + LANE_SUMS
    + """
    struct Any { enum { value = 0 }; };
    struct Four { enum { value = 4 }; };
    struct Yes { enum { value = 1 }; };
    struct No { enum { value = 0 }; };
    const int channels = v_image.shape.dims[0];
    const int row_size = v_slots.shape.dims[1];

    auto pass = [&](auto group, auto absolute_sums) {
        constexpr int C = decltype(group)::value;  // 0: any number of channels, read where they lie
        constexpr bool ABSOLUTE = decltype(absolute_sums)::value;
        constexpr int K = C > 0 ? C : 1;
        vf T[16], behind[16], v[16][K], w[16];
        vi ends[16];
        vi row_ends = {};
        int last_pair = begin;
        for (int r = 0; r < 16; ++r) {
            const int n = r < tall ? wide : 0;
            const long long at = corner + (long long)r * width;
            T[r] = load(transmittance.data + at, n);
            ends[r] = (vi)load((const float*)last.data + at, n);
            vf total = ZERO - load(v_alpha.data + at, n);
            for (int c = 0; c < channels; ++c) total += load(v_image.data + c * plane + at, n) * background.data[c];
            behind[r] = total * T[r];
            for (int c = 0; c < C; ++c) v[r][c] = c < channels ? load(v_image.data + c * plane + at, n) : ZERO;
            for (int k = 0; k < 16; ++k) row_ends[r] = ends[r][k] > row_ends[r] ? ends[r][k] : row_ends[r];
            last_pair = row_ends[r] > last_pair ? row_ends[r] : last_pair;
        }
        for (int p = last_pair; p < end; ++p)
            __builtin_memset(v_slots.data + (long long)slots.data[p] * row_size, 0, row_size * sizeof(float));

        for (int p = last_pair - 1; p >= begin; --p) {
            const float* s = packed.data + (long long)splats.data[p] * stride;
            float* out = v_slots.data + (long long)slots.data[p] * row_size;
            const Splat g = read(s);
            unsigned rows = reached_rows(g, s[7]) & bits(row_ends > p);
            const unsigned visited = rows;
            if (!rows) {
                __builtin_memset(out, 0, row_size * sizeof(float));
                continue;
            }
            const float to_conic = -1.3862943611198906f;  // undoes the factor folded into the packed conic
            const float A = to_conic * s[2], B = 0.5f * to_conic * s[3], D = to_conic * s[4];
            const vf dx = LANE - g.mx, adx = A * dx, bdx = B * dx;
            const float *dys = (const float*)&g.dy, *bdy = (const float*)&g.bdy, *cdy2 = (const float*)&g.cdy2;
            vf g0 = ZERO, g1 = ZERO, g2 = ZERO, abs_x = ZERO, abs_y = ZERO, v_channel[K];
            for (int c = 0; c < K; ++c) v_channel[c] = ZERO;
            while (rows) {
                const int r = __builtin_ctz(rows);
                rows &= rows - 1u;
                const float dy = dys[r];
                const vf power = power_of(dx, g.a, bdy[r], cdy2[r]);
                const vi skip = ~((power <= 0.0f) & (power >= g.floor)) | (ends[r] <= p);
                const vf raw = exp2v(power + g.log2_opacity);
                vf alpha = raw > ALPHA_MAX ? ZERO + ALPHA_MAX : raw;
                alpha = skip ? ZERO : alpha;
                const vf inverse = 1.0f / (1.0f - alpha);
                const vf t = T[r] * inverse;
                const vf weight = alpha * t;
                vf own = ZERO;
                if (C > 0) for (int c = 0; c < C; ++c) own += v[r][c] * s[GEOMETRY + c];
                else for (int c = 0; c < channels; ++c)
                    own += load(v_image.data + c * plane + corner + (long long)r * width, wide) * s[GEOMETRY + c];
                vf grad = alpha * (own * t - behind[r] * inverse);
                grad = raw > ALPHA_MAX ? ZERO : grad;
                behind[r] += own * weight;
                T[r] = t;
                const vf grad_dy = grad * dy;
                g0 += grad;
                g1 += grad_dy;
                g2 += grad_dy * dy;
                if (ABSOLUTE) {
                    const vf gx = grad * (adx + B * dy), gy = grad * (bdx + D * dy);
                    abs_x += gx < 0.0f ? -gx : gx;
                    abs_y += gy < 0.0f ? -gy : gy;
                }
                if (C > 0) for (int c = 0; c < C; ++c) v_channel[c] += v[r][c] * weight;
                else w[r] = weight;
            }
            const vf g0dx = g0 * dx;
            vf sums[16] = {A * g0dx + B * g1, B * g0dx + D * g1, -0.5f * (g0dx * dx), -(g1 * dx), -0.5f * g2,
                g0 * s[6], abs_x, abs_y};
            for (int c = 0; c < C; ++c) sums[8 + c] = v_channel[c];
            const vf total = lane_sums(sums);
            if (C > 0) {
                store(out, total, 16);
                continue;
            }
            store(out, total, 8);
            for (int c0 = 0; c0 < channels; c0 += 16) {
                const int count = channels - c0 < 16 ? channels - c0 : 16;
                vf channel_sums[16] = {};
                for (int c = 0; c < count; ++c)
                    for (unsigned left = visited; left; left &= left - 1u) {
                        const long long at = corner + (long long)__builtin_ctz(left) * width;
                        channel_sums[c] += load(v_image.data + (c0 + c) * plane + at, wide) * w[__builtin_ctz(left)];
                    }
                store(out + 8 + c0, lane_sums(channel_sums), count);
            }
        }
    };
    if (channels <= 4) absolute ? pass(Four(), Yes()) : pass(Four(), No());
    else absolute ? pass(Any(), Yes()) : pass(Any(), No());
#endif
"""
)


# fmt: off
@wp.func_native(_FORWARD)
def composite_tile(
    tile: int, packed: wp.array2d[float], background: wp.array[float], ranges: wp.array[wp.vec2i],
    splats: wp.array[int], width: int, height: int, columns: int,
    image: wp.array3d[float], alpha_image: wp.array2d[float], transmittance: wp.array2d[float], last: wp.array2d[int],
): ...


@wp.func_native(_ADJOINT)
def composite_tile_adjoint(
    tile: int, packed: wp.array2d[float], background: wp.array[float], ranges: wp.array[wp.vec2i],
    splats: wp.array[int], slots: wp.array[int], transmittance: wp.array2d[float], last: wp.array2d[int],
    v_image: wp.array3d[float], v_alpha: wp.array2d[float], width: int, height: int, columns: int, absolute: int,
    v_slots: wp.array2d[float],
): ...
# fmt: on


@wp.kernel
def composite_tiles(
    first: int,
    # In:
    packed_in: wp.array2d[float],  # [N, 8 + C padded]
    background_in: wp.array[float],  # [C]
    ranges_in: wp.array[wp.vec2i],  # [T]
    splats_in: wp.array[int],  # [P]
    width: int,
    height: int,
    columns: int,
    # Out:
    image_out: wp.array3d[float],  # [C, H, W]
    alpha_out: wp.array2d[float],  # [H, W]
    transmittance_out: wp.array2d[float],  # [H, W]; empty: not wanted
    last_out: wp.array2d[int],  # [H, W]; empty too
):
    composite_tile(
        first + wp.tid(),
        packed_in,
        background_in,
        ranges_in,
        splats_in,
        width,
        height,
        columns,
        image_out,
        alpha_out,
        transmittance_out,
        last_out,
    )


@wp.kernel
def composite_tiles_adjoint(
    first: int,
    # In:
    packed_in: wp.array2d[float],  # [N, 8 + C padded]
    background_in: wp.array[float],  # [C]
    ranges_in: wp.array[wp.vec2i],  # [T]
    splats_in: wp.array[int],  # [P]
    slots_in: wp.array[int],  # [P]
    transmittance_in: wp.array2d[float],  # [H, W]
    last_in: wp.array2d[int],  # [H, W]
    v_image_in: wp.array3d[float],  # [C, H, W]
    v_alpha_in: wp.array2d[float],  # [H, W]
    width: int,
    height: int,
    columns: int,
    absolute: int,  # whether the absolute sums are wanted; else zero
    # Out:
    v_slots_out: wp.array2d[float],  # [P, S], S >= 16 and S >= 8 + C
):
    composite_tile_adjoint(
        first + wp.tid(),
        packed_in,
        background_in,
        ranges_in,
        splats_in,
        slots_in,
        transmittance_in,
        last_in,
        v_image_in,
        v_alpha_in,
        width,
        height,
        columns,
        absolute,
        v_slots_out,
    )
