// Splats packed for compositing: 16 splats, one per lane, are written as rows of one or two cache lines.
#pragma once
#include "columns.h"
#include "exponential.h"

static inline void pack_block(
    int begin, const wp::array_t<wp::vec2>& means2d, const wp::array_t<wp::vec3>& conics,
    const wp::array_t<float>& opacities, const wp::array_t<float>& channels, wp::array_t<float>& packed
) {
    FUSE_WITHIN_EXPRESSIONS
    const int total = opacities.shape[0], count = channels.shape[1], width = packed.shape[1];
    const int rows = total - begin < 16 ? total - begin : 16;
    const float factor = -0.5f * LOG2_E;
    vf mean[2], conic[3], columns[16];
    read_vectors(means2d.data, begin, rows, 2, mean);
    read_vectors(conics.data, begin, rows, 3, conic);
    vf opacity = load(opacities.data + begin, rows);
    vi whole = vi{} - 1;
    // Channels first: they decide whether the splat is left out. Columns past the last channel are zeros.
    for (int from = 0; from + PACKED_GEOMETRY < width; from += 16) {
        const int left = count - from < 16 ? count - from : 16, room = width - PACKED_GEOMETRY - from;
        if (count == 3 || count == 4)
            read_vectors(channels.data, begin, rows, count, columns);
        else
            read_columns(channels.data, (long long)total * count, begin, rows, count, from, columns);
        for (int c = 0; c < 16; ++c) {
            columns[c] = c < left ? columns[c] : vf{};
            whole &= __builtin_elementwise_abs(columns[c]) <= CHANNEL_MAX;
        }
        write_columns(packed.data, begin, rows, width, PACKED_GEOMETRY + from, room < 16 ? room : 16, columns);
    }
    opacity = whole ? opacity : vf{};  // never added: see compositing.finite_opacities
    const vi visible = opacity > 0.0f;
    const vf safe = visible ? opacity : vf{} + 1.0f;
    for (int c = 0; c < 16; ++c) columns[c] = vf{};
    columns[0] = mean[0];
    columns[1] = mean[1];
    columns[2] = factor * conic[0];
    columns[3] = 2.0f * factor * conic[1];
    columns[4] = factor * conic[2];
    columns[5] = visible ? logarithm2(safe) : vf{} - 1.0e30f;
    columns[6] = visible ? 1.0f / safe : vf{};
    columns[7] = -conic[1] / conic[0];
    write_columns(packed.data, begin, rows, width, 0, PACKED_GEOMETRY, columns);
}
