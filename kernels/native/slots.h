// Sums of the gradient slots of 16 splats; a slot is one vector of 16 columns.
#pragma once
#include "columns.h"

ALWAYS_INLINE vf passed(vf v) { return __builtin_elementwise_abs(v) <= GRADIENT_MAX ? v : vf{}; }

static inline void sum_slots_block(
    int begin, const wp::array_t<wp::int64>& offsets, const wp::array_t<float>& v_slots, int more,
    wp::array_t<wp::vec2>& v_means2d, wp::array_t<wp::vec3>& v_conics, wp::array_t<float>& v_opacities,
    wp::array_t<float>& v_channels, wp::array_t<wp::vec2>& absgrad
) {
    FUSE_WITHIN_EXPRESSIONS
    const int total = v_opacities.shape[0], channels = v_channels.shape[1];
    const int rows = total - begin < 16 ? total - begin : 16;
    const bool absolute = absgrad.shape[0] > 0;
    vf sums[16] = {}, channel[16];
    if (more) {
        read_vectors(v_means2d.data, begin, rows, 2, sums);
        read_vectors(v_conics.data, begin, rows, 3, sums + 2);
        sums[5] = load(v_opacities.data + begin, rows);
        if (absolute) read_vectors(absgrad.data, begin, rows, 2, sums + 6);
        read_columns(v_channels.data, (long long)total * channels, begin, rows, channels, 0, channel);
        for (int c = 0; c < channels; ++c) sums[8 + c] = channel[c];
        transpose(sums);
    }
    for (int l = 0; l < rows; ++l) {
        vf sum = sums[l];
        const long long end = offsets.data[begin + l + 1];
        for (long long slot = offsets.data[begin + l]; slot < end; ++slot) sum += load16(v_slots.data + 16 * slot);
        sums[l] = sum;
    }
    transpose(sums);
    for (int k = 0; k < 8; ++k) sums[k] = passed(sums[k]);
    write_vectors(v_means2d.data, begin, rows, 2, sums);
    write_vectors(v_conics.data, begin, rows, 3, sums + 2);
    store(v_opacities.data + begin, sums[5], rows);
    if (absolute) write_vectors(absgrad.data, begin, rows, 2, sums + 6);
    if (channels == 3 || channels == 4) {
        write_vectors(v_channels.data, begin, rows, channels, sums + 8);
        return;
    }
    for (int c = 0; c < 16; ++c) channel[c] = c < 8 ? sums[8 + c] : vf{};
    write_columns(v_channels.data, begin, rows, channels, 0, channels, channel);
}
