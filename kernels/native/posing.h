// Posing of 16 Gaussians, one per lane: skinning, correctives, tints, shading and activations in one pass.
#pragma once
#include "finishing.h"
#include "skinning.h"

static inline void pose_block(
    int begin, const wp::array_t<wp::vec3>& means, const wp::array_t<wp::vec4>& quats,
    const wp::array_t<wp::vec3>& log_scales, const wp::array_t<float>& opacity_logits,
    const wp::array_t<wp::vec3>& sh_dc, const wp::array_t<float>& correctives, const wp::array_t<float>& shading,
    const wp::array_t<float>& motion, const wp::array_t<float>& reach, int aligned, int extras,
    const wp::array_t<int>& indices, const wp::array_t<float>& weights, const wp::array_t<wp::vec4>& quats_own,
    int has_own, wp::array_t<wp::vec3>& means_t, wp::array_t<wp::vec4>& quats_t, wp::array_t<wp::vec3>& scales_t,
    wp::array_t<float>& opacities_t, wp::array_t<wp::vec3>& sh_dc_t
) {
    auto run = [&](auto kc) __attribute__((always_inline)) {
        const int K = decltype(kc)::value ? decltype(kc)::value : indices.shape[1];
        const int rows = means.shape[0] - begin < 16 ? means.shape[0] - begin : 16;
        // 1. Skin.
        vf x[3], rest[4], columns[16];
        int spare_picks[16 * MAX_NEIGHBORS];
        float spare_weights[16 * MAX_NEIGHBORS];
        read_vectors(means.data, begin, rows, 3, x);
        read_vectors(quats.data, begin, rows, 4, rest);
        prefetch_next(indices.data, begin, K);
        prefetch_next(weights.data, begin, K);
        const int* pick = (const int*)read_rows(indices.data + (long long)begin * K, rows, 4 * K, spare_picks);
        const float* weight = (const float*)read_rows(weights.data + (long long)begin * K, rows, 4 * K, spare_weights);
        if (!aligned) weight_columns(weight, K, columns);
        Moved to = moved_by(x, rest, motion, reach, pick, K, weight, columns, aligned, extras != 0);
        // 2. Displace, tint, shade and activate.
        vf own[4], scale[3], color[3];
        if (has_own) read_vectors(quats_own.data, begin, rows, 4, own);
        const Quaternions quat{rest, to.quat, has_own ? own : nullptr};
        const vf opacity = finish(
            begin, rows, log_scales, opacity_logits, sh_dc, correctives, shading, quat, to.extra, extras, to.mean,
            scale, color
        );
        write_vectors(means_t.data, begin, rows, 3, to.mean);
        write_vectors(quats_t.data, begin, rows, 4, to.quat);
        write_vectors(scales_t.data, begin, rows, 3, scale);
        store(opacities_t.data + begin, opacity, rows);
        write_vectors(sh_dc_t.data, begin, rows, 3, color);
    };
    by_count()(indices.shape[1], run);
}
