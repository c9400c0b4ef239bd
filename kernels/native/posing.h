// Posing of 16 Gaussians, one per lane: skinning, correctives, tints, shading and activations in one pass.
#pragma once
#include "activations.h"
#include "correctives.h"
#include "shading.h"
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
        const int* pick = (const int*)read_rows(indices.data + (long long)begin * K, rows, 4 * K, spare_picks);
        const float* weight = (const float*)read_rows(weights.data + (long long)begin * K, rows, 4 * K, spare_weights);
        if (!aligned) weight_columns(weight, K, columns);
        Moved to = moved_by(x, rest, motion, reach, pick, K, weight, columns, aligned, extras != 0);
        // 2. Displace, tint and shade by the rotation since rest.
        vf color[3], own[4];
        read_vectors(sh_dc.data, begin, rows, 3, color);
        if (has_own) read_vectors(quats_own.data, begin, rows, 4, own);
        const Turns turns = Turns(rest, to.quat, has_own ? own : nullptr);
        if (correctives.shape[1]) {
            vf C[27];
            read_matrix(correctives, begin, rows, C);
            displace(C, turns, to.mean);
        }
        if (extras == EXTRAS_TINTS)
            for (int c = 0; c < 3; ++c) brighten(tint_factor(to.extra[c]), color[c]);
        if (shading.shape[1]) {
            const vf factor = Gain(begin, rows, shading, turns.turn).limited();
            for (int c = 0; c < 3; ++c) brighten(factor, color[c]);
        }
        // 3. Activate.
        vf scale[3];
        read_vectors(log_scales.data, begin, rows, 3, scale);
        for (int c = 0; c < 3; ++c)
            scale[c] = whole_exponential(extras == EXTRAS_LOG_SCALES ? scale[c] + to.extra[c] : scale[c]);
        const vf opacity = sigmoid_of(load(opacity_logits.data + begin, rows));
        write_vectors(means_t.data, begin, rows, 3, to.mean);
        write_vectors(quats_t.data, begin, rows, 4, to.quat);
        write_vectors(scales_t.data, begin, rows, 3, scale);
        store(opacities_t.data + begin, opacity, rows);
        write_vectors(sh_dc_t.data, begin, rows, 3, color);
    };
    by_count()(indices.shape[1], run);
}
