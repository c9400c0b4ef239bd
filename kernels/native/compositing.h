// Alpha compositing of one tile and its adjoint: 16 x 16 pixels in blocks of 4 x 4, a block in one vector.
#pragma once
#include "lane_sums.h"
#include "simd.h"
#include "tile_blocks.h"

enum {
    GEOMETRY = PACKED_GEOMETRY,  // leading columns of a packed splat
    GROUP = CHANNEL_GROUP,       // its channels are padded to a multiple of this
    AHEAD = 32,                  // pairs from the request of a packed splat to its use: it seldom lies in a near cache
    AHEAD_ADJOINT = 8,           // the same in the adjoint, which takes longer over a pair
};

// Divide accumulated depths by their alpha, then by the unit in double precision.
ALWAYS_INLINE vf expected(vf accumulated, vf alpha, double unit) {
    const vf mean = accumulated / (alpha > 1e-10f ? alpha : vf{} + 1e-10f);
    return __builtin_convertvector(__builtin_convertvector(mean, vd) * (1.0 / unit), vf);
}

static inline void composite_tile(
    int tile, const wp::array_t<float>& packed, const wp::array_t<float>& background,
    const wp::array_t<wp::vec_t<2, int>>& ranges, const wp::array_t<int>& splats, int width, int height, int columns,
    float sharpness, double depth_unit, wp::array_t<float>& image, wp::array_t<float>& alpha_image,
    wp::array_t<float>& transmittance, wp::array_t<int>& last
) {
    FUSE_WITHIN_EXPRESSIONS
    const Tile place = Tile(tile, ranges, width, height, columns);
    const int begin = place.begin, end = place.end;
    const long long plane = place.plane;
    const int stride = packed.shape.dims[1];
    const Points first = first_pixels(place);
    const vf ZERO = vf{};
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
    const int channels = image.shape.dims[0], depth = depth_unit > 0.0 ? channels - 1 : -1;

    // One pass over the tile's splats for `count` channels from c0 on; only the first pass stores alpha and the like.
    // For each chunk of 32 splats and each block, the block's state stays in registers while the splats that reach it
    // are visited.
    auto pass = [&](auto group, auto keeping, int c0, int count) {
        constexpr int C = decltype(group)::value;
        constexpr bool KEEP = decltype(keeping)::value;
        vf T[16], sum[16][C];
        vi ends[16];
        const float* chunk[32];
        alignas(64) short reached[32];
        for (int b = 0; b < 16; ++b) {
            const vi inside = (lane_columns() < (float)place.wide_of(b)) & (lane_rows() < (float)place.tall_of(b));
            T[b] = inside ? ZERO + 1.0f : ZERO - 1.0f;
            for (int c = 0; c < C; ++c) sum[b][c] = ZERO;
            ends[b] = vi{};
        }
        unsigned alive = place.blocks();
        for (int p0 = begin; p0 < end && alive; p0 += 32) {
            const int n = end - p0 < 32 ? end - p0 : 32;
            for (int k = 0; k < n; ++k) {
                const float* s = packed.data + (long long)splats.data[p0 + k] * stride;
                if (p0 + k + AHEAD < end)
                    __builtin_prefetch(packed.data + (long long)splats.data[p0 + k + AHEAD] * stride);
                chunk[k] = s;
                reached[k] = (short)reached_blocks(s, first);
            }
            for (int k = n; k < 32; ++k) reached[k] = 0;
            for (unsigned blocks = alive; blocks; blocks &= blocks - 1u) {
                const int b = __builtin_ctz(blocks);
                vs in_block;
                __builtin_memcpy(&in_block, reached, 64);
                unsigned hits = __builtin_bit_cast(unsigned, __builtin_convertvector((in_block >> b) << 15, vb32));
                const Points pixels = pixels_of(place, b);
                vf t = T[b], own[C];
                vi own_ends = ends[b];
                for (int c = 0; c < C; ++c) own[c] = sum[b][c];
                for (; hits; hits &= hits - 1u) {
                    const int k = __builtin_ctz(hits);
                    const float* s = chunk[k];
                    const Seen seen = see(s, pixels, curvature);
                    vf alpha = seen.raw > ALPHA_MAX ? ZERO + ALPHA_MAX : seen.raw;
                    alpha = seen.counts ? alpha : ZERO;
                    const vf next = t - t * alpha;
                    const vi go = next > TRANSMITTANCE_MIN;
                    const vf w = go ? alpha * t : ZERO;
                    t = go ? next : (vf)((vu)t | 0x80000000u);
                    for (int c = 0; c < C; ++c) own[c] += w * s[GEOMETRY + c0 + c];
                    if (KEEP) own_ends = (w > 0.0f) ? vi{} + (p0 + k + 1) : own_ends;
                }
                T[b] = t;
                for (int c = 0; c < C; ++c) sum[b][c] = own[c];
                if (KEEP) ends[b] = own_ends;
                if (!bits(t > 0.0f)) alive &= ~(1u << b);
            }
        }
        for (unsigned blocks = place.blocks(); blocks; blocks &= blocks - 1u) {
            const int b = __builtin_ctz(blocks);
            const vf t = (vf)((vu)T[b] & 0x7fffffffu);
            const long long at = place.at(b);
            const int columns_left = place.wide_of(b), rows_left = place.tall_of(b);
            auto put = [&](float* to, vf v) { store_block(to + at, v, width, columns_left, rows_left); };
            for (int c = 0; c < count; ++c) {
                const vf value = sum[b][c] + t * background.data[c0 + c];
                put(image.data + (c0 + c) * plane, c0 + c == depth ? expected(value, 1.0f - t, depth_unit) : value);
            }
            if (c0 == 0) put(alpha_image.data, 1.0f - t);
            if (KEEP) {
                put(transmittance.data, t);
                put((float*)last.data, (vf)ends[b]);
            }
        }
    };
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
    const int begin = place.begin, end = place.end;
    if (begin == end) return;
    const long long plane = place.plane, corner = place.corner;
    const int stride = packed.shape.dims[1];
    const Points first = first_pixels(place);
    const vf ZERO = vf{};
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
        vi block_ends = {};
        int last_pair = begin;
        auto get = [&](const float* from, int b) {
            return load_block(from + place.at(b), width, place.wide_of(b), place.tall_of(b));
        };
        for (int b = 0; b < 16; ++b) {
            T[b] = get(transmittance.data, b);
            ends[b] = (vi)get((const float*)last.data, b);
            vf total = v_alpha.data ? ZERO - get(v_alpha.data, b) : ZERO;
            for (int c = 0; c < channels; ++c) total += get(v_image.data + c * plane, b) * background.data[c];
            behind[b] = total;
            for (int c = 0; c < C; ++c) v[b][c] = c < channels ? get(v_image.data + c * plane, b) : ZERO;
            for (int k = 0; k < 16; ++k) block_ends[b] = ends[b][k] > block_ends[b] ? ends[b][k] : block_ends[b];
            last_pair = block_ends[b] > last_pair ? block_ends[b] : last_pair;
        }
        for (int r = 0; r < 16; ++r) {  // the next tile's pixels
            const long long next = corner + (long long)r * width + 16;
            if (next >= plane) break;
            __builtin_prefetch(transmittance.data + next);
            __builtin_prefetch(last.data + next);
            if (v_alpha.data) __builtin_prefetch(v_alpha.data + next);
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
            unsigned blocks = reached_blocks(s, first) & bits(block_ends > p);
            const unsigned visited = blocks;
            if (!blocks) {
                __builtin_memset(out, 0, row_size * sizeof(float));
                continue;
            }
            const float to_conic = 1.3862943611198906f;  // removes the factor folded into the packed conic
            const float A = to_conic * s[2], B = 0.5f * to_conic * s[3], D = to_conic * s[4];
            vf g_opacity = ZERO, gx = ZERO, gy = ZERO, gxx = ZERO, gxy = ZERO, gyy = ZERO, abs_x = ZERO, abs_y = ZERO;
            vf v_channel[K];
            for (int c = 0; c < K; ++c) v_channel[c] = ZERO;
            while (blocks) {
                const int b = __builtin_ctz(blocks);
                blocks &= blocks - 1u;
                const Seen seen = see(s, pixels_of(place, b), curvature);
                vf alpha = seen.raw > ALPHA_MAX ? ZERO + ALPHA_MAX : seen.raw;
                alpha = (seen.counts & (ends[b] > p)) ? alpha : ZERO;
                const vf t = T[b] / (1.0f - alpha);
                const vf weight = alpha * t;
                vf own = ZERO;
                if (C > 0)
                    for (int c = 0; c < C; ++c) own += v[b][c] * s[GEOMETRY + c];
                else
                    for (int c = 0; c < channels; ++c) own += get(v_image.data + c * plane, b) * s[GEOMETRY + c];
                const vf ahead = own - behind[b];
                vf grad = weight * ahead;
                grad = seen.raw > ALPHA_MAX ? ZERO : grad;
                behind[b] += alpha * ahead;
                T[b] = t;
                g_opacity += grad;
                grad = grad * (1.0f + 2.0f * curvature * seen.fall);
                const vf grad_dx = grad * seen.dx, grad_dy = grad * seen.dy;
                gx += grad_dx;
                gy += grad_dy;
                gxx += grad_dx * seen.dx;
                gxy += grad_dx * seen.dy;
                gyy += grad_dy * seen.dy;
                if (ABSOLUTE) {
                    abs_x += __builtin_elementwise_abs(A * grad_dx + B * grad_dy);
                    abs_y += __builtin_elementwise_abs(B * grad_dx + D * grad_dy);
                }
                if (C > 0)
                    for (int c = 0; c < C; ++c) v_channel[c] += v[b][c] * weight;
                else
                    w[b] = weight;
            }
            vf sums[16] = {A * gx + B * gy, B * gx + D * gy,  -0.5f * gxx, -gxy,
                           -0.5f * gyy,     g_opacity * s[6], abs_x,       abs_y};
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
                        const int b = __builtin_ctz(left);
                        channel_sums[c] += get(v_image.data + (c0 + c) * plane, b) * w[b];
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
