// Splats packed for compositing: 16 splats, one per lane, are written as rows.
#pragma once
#include "columns.h"
#include "exponential.h"

// Read up to 16 channels, from channel `from` on, with zeros behind the last.
ALWAYS_INLINE void read_channels(const wp::array_t<float>& channels, int begin, int rows, int from, vf* to) {
    const int count = channels.shape[1];
    if (count == 3 || count == 4)
        read_vectors(channels.data, begin, rows, count, to);
    else
        read_columns(channels.data, (long long)channels.shape[0] * count, begin, rows, count, from, to);
    for (int c = 0; c < 16; ++c) to[c] = from + c < count ? to[c] : vf{};
}

// Return the bound below which a splat's fall counts (Seen::fall): where the fall is equal or larger, alpha, with its
// sharpness, is under ALPHA_MIN. 0: it counts nowhere.
ALWAYS_INLINE vf fall_bound(vf log2_opacity, float sharpness) {
    FUSE_WITHIN_EXPRESSIONS
    const vf fall = 7.994353436858858f + log2_opacity;  // log2(255)
    const vf largest = 2.0f * fall / (1.0f + __builtin_elementwise_sqrt(1.0f + 4.0f * LN_2 * sharpness * fall));
    return fall >= 0.0f ? (vf)((vi)largest + 1) : vf{};
}

static inline void pack_block(
    int begin, const wp::array_t<wp::vec2>& means2d, const wp::array_t<wp::vec3>& conics,
    const wp::array_t<float>& opacities, const wp::array_t<float>& channels, float sharpness, wp::array_t<float>& packed
) {
    FUSE_WITHIN_EXPRESSIONS
    const int total = opacities.shape[0], width = packed.shape[1];
    const int rows = total - begin < 16 ? total - begin : 16;
    const float factor = 0.5f * LOG2_E;
    vf mean[2], conic[3], own[16] = {}, values[16];
    read_vectors(means2d.data, begin, rows, 2, mean);
    read_vectors(conics.data, begin, rows, 3, conic);
    // Channels first: they decide whether the splat is left out.
    vi whole = vi{} - 1;
    for (int from = 0; from + PACKED_GEOMETRY < width; from += 16) {
        read_channels(channels, begin, rows, from, values);
        for (int c = 0; c < 16; ++c) whole &= __builtin_elementwise_abs(values[c]) <= CHANNEL_MAX;
        for (int c = 0; c < 16 - PACKED_GEOMETRY && width == 16; ++c) own[PACKED_GEOMETRY + c] = values[c];
        const int room = width - PACKED_GEOMETRY - from;
        if (width > 16)
            write_columns(packed.data, begin, rows, width, PACKED_GEOMETRY + from, room < 16 ? room : 16, values);
    }
    vf opacity = load(opacities.data + begin, rows);
    opacity = whole ? opacity : vf{};  // never added: see compositing.finite_opacities
    const vi visible = opacity > 0.0f;
    const vf safe = visible ? opacity : vf{} + 1.0f;
    own[0] = mean[0];
    own[1] = mean[1];
    own[2] = factor * conic[0];
    own[3] = 2.0f * factor * conic[1];
    own[4] = factor * conic[2];
    own[5] = visible ? logarithm2(safe) : vf{} - 1.0e30f;
    own[6] = visible ? 1.0f / safe : vf{};
    own[7] = -conic[1] / conic[0];
    own[8] = fall_bound(own[5], sharpness);
    own[9] = -conic[1] / conic[2];
    write_columns(packed.data, begin, rows, width, 0, width == 16 ? 16 : PACKED_GEOMETRY, own);
}
