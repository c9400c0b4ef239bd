// Alpha compositing of one tile and its adjoint: 16 x 16 pixels, a row of 16 in one vector.
#pragma once
#include "lane_sums.h"
#include "simd.h"

enum {
    GEOMETRY = PACKED_GEOMETRY,  // leading columns of a packed splat
    GROUP = CHANNEL_GROUP,       // its channels are padded to a multiple of this
    AHEAD = 32,                  // pairs from the request of a packed splat to its use: it seldom lies in a near cache
    AHEAD_ADJOINT = 8,           // the same in the adjoint, which takes longer over a pair
};

// A splat as seen from the tile's first pixel; the lanes of the last three are the tile's rows.
struct Splat {
    float mx, a, log2_opacity, floor;
    vf dy, bdy, cdy2;
};

// Position of a tile in the image and in the list of pairs.
struct Tile {
    int begin, end;       // its pairs
    int wide, tall;       // its pixels inside the image
    float x, y;           // centre of its first pixel
    long long corner;     // index of its first pixel
    long long plane;      // pixels of the image
    long long row_pitch;  // pixels of a row of the image

    Tile(int tile, const wp::array_t<wp::vec_t<2, int>>& ranges, int width, int height, int columns) {
        const int x0 = 16 * (tile % columns), y0 = 16 * (tile / columns);
        begin = ranges.data[tile].c[0];
        end = ranges.data[tile].c[1];
        wide = width - x0 < 16 ? width - x0 : 16;
        tall = height - y0 < 16 ? height - y0 : 16;
        x = 16.0f * (tile % columns) + 0.5f;
        y = 16.0f * (tile / columns) + 0.5f;
        corner = (long long)y0 * width + x0;
        plane = (long long)width * height;
        row_pitch = width;
    }
};

static inline Splat read_splat(const float* s, const Tile& tile) {
    FUSE_WITHIN_EXPRESSIONS
    Splat g;
    g.mx = s[0] - tile.x;
    g.a = s[2];
    g.log2_opacity = s[5];
    g.floor = s[8];
    g.dy = lane_numbers() - (s[1] - tile.y);
    g.bdy = s[3] * g.dy;
    g.cdy2 = s[4] * g.dy * g.dy;
    return g;
}

// Return one bit per row, set if the ellipse meets it: q is evaluated at the row's point nearest to the ellipse's axis.
static inline unsigned reached_rows(const Splat& g, float slope) {
    FUSE_WITHIN_EXPRESSIONS
    vf x = slope * g.dy;
    vf low = vf{} - g.mx, high = vf{} + (15.0f - g.mx);
    x = x < low ? low : x;
    x = x > high ? high : x;
    return bits((g.a * x + g.bdy) * x + g.cdy2 >= g.floor - 1e-3f);
}

// Return the exponent of a Gaussian at a row's pixels. Forward pass and adjoint must round alike to agree on the
// contributing splats.
static inline vf power_of(vf dx, float a, float bdy, float cdy2) {
    FUSE_WITHIN_EXPRESSIONS
    return (a * dx + bdy) * dx + cdy2;
}

static inline void composite_tile(
    int tile, const wp::array_t<float>& packed, const wp::array_t<float>& background,
    const wp::array_t<wp::vec_t<2, int>>& ranges, const wp::array_t<int>& splats, int width, int height, int columns,
    float sharpness, wp::array_t<float>& image, wp::array_t<float>& alpha_image, wp::array_t<float>& transmittance,
    wp::array_t<int>& last
) {
    FUSE_WITHIN_EXPRESSIONS
    const Tile place = Tile(tile, ranges, width, height, columns);
    const int begin = place.begin, end = place.end, wide = place.wide, tall = place.tall;
    const long long plane = place.plane, corner = place.corner;
    const int stride = packed.shape.dims[1];
    const vf LANE = lane_numbers(), ZERO = vf{};
    const float curvature = LN_2 * sharpness;

    struct Three {
        enum { value = 3 };
    };
    struct Four {
        enum { value = 4 };
    };
    struct Eight {
        enum { value = 8 };
    };
    struct Yes {
        enum { value = 1 };
    };
    struct No {
        enum { value = 0 };
    };
    const bool keep = last.shape.dims[0] > 0;

    // One pass over the tile's splats for `count` channels from c0 on; only the first pass stores alpha and the like.
    // For each chunk of 32 splats and each row, the row's state stays in registers while the splats that reach it are
    // visited.
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
                if (p0 + k + AHEAD < end)
                    __builtin_prefetch(packed.data + (long long)splats.data[p0 + k + AHEAD] * stride);
                chunk[k] = read_splat(s, place);
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
                    const vi skip = ~((power <= 0.0f) & (power >= g.floor));  // skips NaN too: infinities may cancel
                    vf alpha = exp2v(power * (1.0f - curvature * power) + g.log2_opacity);
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
        if (count <= 3)
            first_pass ? pass(Three(), Yes(), c0, count) : pass(Three(), No(), c0, count);
        else if (count <= 4)
            first_pass ? pass(Four(), Yes(), c0, count) : pass(Four(), No(), c0, count);
        else
            first_pass ? pass(Eight(), Yes(), c0, count) : pass(Eight(), No(), c0, count);
    }
}

static inline void composite_tile_adjoint(
    int tile, const wp::array_t<float>& packed, const wp::array_t<float>& background,
    const wp::array_t<wp::vec_t<2, int>>& ranges, const wp::array_t<int>& splats, const wp::array_t<int>& slots,
    const wp::array_t<float>& transmittance, const wp::array_t<int>& last, const wp::array_t<float>& v_image,
    const wp::array_t<float>& v_alpha, int width, int height, int columns, float sharpness, int absolute,
    wp::array_t<float>& v_slots
) {
    FUSE_WITHIN_EXPRESSIONS
    const Tile place = Tile(tile, ranges, width, height, columns);
    const int begin = place.begin, end = place.end, wide = place.wide, tall = place.tall;
    if (begin == end) return;
    const long long plane = place.plane, corner = place.corner;
    const int stride = packed.shape.dims[1];
    const vf LANE = lane_numbers(), ZERO = vf{};
    const float curvature = LN_2 * sharpness;

    struct Any {
        enum { value = 0 };
    };
    struct Three {
        enum { value = 3 };
    };
    struct Four {
        enum { value = 4 };
    };
    struct Yes {
        enum { value = 1 };
    };
    struct No {
        enum { value = 0 };
    };
    const int channels = v_image.shape.dims[0];
    const int row_size = v_slots.shape.dims[1];

    auto pass = [&](auto group, auto absolute_sums) {
        constexpr int C = decltype(group)::value;  // 0: any number of channels, read where they lie
        constexpr bool ABSOLUTE = decltype(absolute_sums)::value;
        constexpr int K = C > 0 ? C : 1;
        vf T[16], v[16][K], w[16];
        vf behind[16];  // what shines through from behind, times its gradient, per unit of transmittance
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
            behind[r] = total;
            for (int c = 0; c < C; ++c) v[r][c] = c < channels ? load(v_image.data + c * plane + at, n) : ZERO;
            for (int k = 0; k < 16; ++k) row_ends[r] = ends[r][k] > row_ends[r] ? ends[r][k] : row_ends[r];
            last_pair = row_ends[r] > last_pair ? row_ends[r] : last_pair;
        }
        for (int r = 0; r < 16; ++r) {  // the next tile's pixels
            const long long next = corner + (long long)r * width + 16;
            if (next >= plane) break;
            __builtin_prefetch(transmittance.data + next);
            __builtin_prefetch(last.data + next);
            __builtin_prefetch(v_alpha.data + next);
            for (int c = 0; c < C; ++c) __builtin_prefetch(v_image.data + c * plane + next);
        }
        for (int p = last_pair; p < end; ++p)
            __builtin_memset(v_slots.data + (long long)slots.data[p] * row_size, 0, row_size * sizeof(float));

        for (int p = last_pair - 1; p >= begin; --p) {
            const float* s = packed.data + (long long)splats.data[p] * stride;
            float* out = v_slots.data + (long long)slots.data[p] * row_size;
            if (p - AHEAD_ADJOINT >= begin) {
                __builtin_prefetch(packed.data + (long long)splats.data[p - AHEAD_ADJOINT] * stride);
                __builtin_prefetch(v_slots.data + (long long)slots.data[p - AHEAD_ADJOINT] * row_size, 1);
            }
            const Splat g = read_splat(s, place);
            unsigned rows = reached_rows(g, s[7]) & bits(row_ends > p);
            const unsigned visited = rows;
            if (!rows) {
                __builtin_memset(out, 0, row_size * sizeof(float));
                continue;
            }
            const float to_conic = -1.3862943611198906f;  // removes the factor folded into the packed conic
            const float A = to_conic * s[2], B = 0.5f * to_conic * s[3], D = to_conic * s[4];
            const vf dx = LANE - g.mx, adx = A * dx, bdx = B * dx;
            const float *dys = (const float*)&g.dy, *bdy = (const float*)&g.bdy, *cdy2 = (const float*)&g.cdy2;
            vf g_opacity = ZERO, g0 = ZERO, g1 = ZERO, g2 = ZERO, abs_x = ZERO, abs_y = ZERO, v_channel[K];
            for (int c = 0; c < K; ++c) v_channel[c] = ZERO;
            while (rows) {
                const int r = __builtin_ctz(rows);
                rows &= rows - 1u;
                const float dy = dys[r];
                const vf power = power_of(dx, g.a, bdy[r], cdy2[r]);
                const vi skip = ~((power <= 0.0f) & (power >= g.floor)) | (ends[r] <= p);
                const vf raw = exp2v(power * (1.0f - curvature * power) + g.log2_opacity);
                vf alpha = raw > ALPHA_MAX ? ZERO + ALPHA_MAX : raw;
                alpha = skip ? ZERO : alpha;
                const vf t = T[r] / (1.0f - alpha);
                const vf weight = alpha * t;
                vf own = ZERO;
                if (C > 0)
                    for (int c = 0; c < C; ++c) own += v[r][c] * s[GEOMETRY + c];
                else
                    for (int c = 0; c < channels; ++c)
                        own += load(v_image.data + c * plane + corner + (long long)r * width, wide) * s[GEOMETRY + c];
                const vf ahead = own - behind[r];
                vf grad = weight * ahead;
                grad = raw > ALPHA_MAX ? ZERO : grad;
                behind[r] += alpha * ahead;
                T[r] = t;
                g_opacity += grad;
                grad = grad * (1.0f - 2.0f * curvature * power);
                const vf grad_dy = grad * dy;
                g0 += grad;
                g1 += grad_dy;
                g2 += grad_dy * dy;
                if (ABSOLUTE) {
                    const vf gx = grad * (adx + B * dy), gy = grad * (bdx + D * dy);
                    abs_x += gx < 0.0f ? -gx : gx;
                    abs_y += gy < 0.0f ? -gy : gy;
                }
                if (C > 0)
                    for (int c = 0; c < C; ++c) v_channel[c] += v[r][c] * weight;
                else
                    w[r] = weight;
            }
            const vf g0dx = g0 * dx;
            vf sums[16] = {A * g0dx + B * g1,
                           B * g0dx + D * g1,
                           -0.5f * (g0dx * dx),
                           -(g1 * dx),
                           -0.5f * g2,
                           g_opacity * s[6],
                           abs_x,
                           abs_y};
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
    if (channels <= 3)
        absolute ? pass(Three(), Yes()) : pass(Three(), No());
    else if (channels <= 4)
        absolute ? pass(Four(), Yes()) : pass(Four(), No());
    else
        absolute ? pass(Any(), Yes()) : pass(Any(), No());
}
