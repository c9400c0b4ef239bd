// What follows the skinning of 16 Gaussians, one per lane: correctives, tints, shading and activations in one pass, and
// the adjoint.
#pragma once
#include "activations.h"
#include "correctives.h"
#include "shading.h"

// Quaternions of a block: at rest, posed, and those that correctives and shading follow (null: the posed ones).
struct Quaternions {
    const vf *rest, *posed, *own;
};

// Displace the means of a block in place, write its scales and its colours, and return its opacities. `extra` holds log
// scales or tints, as `extras` says.
ALWAYS_INLINE vf finish(
    int begin, int rows, const wp::array_t<wp::vec3>& log_scales, const wp::array_t<float>& opacity_logits,
    const wp::array_t<wp::vec3>& sh_dc, const wp::array_t<float>& correctives, const wp::array_t<float>& shading,
    const Quaternions& quat, const vf* extra, int extras, vf* mean, vf* scale, vf* color
) {
    read_vectors(sh_dc.data, begin, rows, 3, color);
    if (extras == EXTRAS_TINTS)
        for (int c = 0; c < 3; ++c) brighten(tint_factor(extra[c]), color[c]);
    if (correctives.shape[1] || shading.shape[1]) {
        const Turns turns = Turns(quat.rest, quat.posed, quat.own);
        if (correctives.shape[1]) {
            vf C[27];
            read_matrix(correctives, begin, rows, C);
            displace(C, turns, mean);
        }
        if (shading.shape[1]) {
            const vf factor = Gain(begin, rows, shading, turns.turn).limited();
            for (int c = 0; c < 3; ++c) brighten(factor, color[c]);
        }
    }
    read_vectors(log_scales.data, begin, rows, 3, scale);
    for (int c = 0; c < 3; ++c)
        scale[c] = whole_exponential(extras == EXTRAS_LOG_SCALES ? scale[c] + extra[c] : scale[c]);
    return sigmoid_of(load(opacity_logits.data + begin, rows));
}

// Write what changes: means with correctives, colours with tints or shading, and scales and opacities. Quaternions are
// read with correctives or shading, extras if there are any.
static inline void finish_block(
    int begin, const wp::array_t<wp::vec3>& means, const wp::array_t<wp::vec3>& log_scales,
    const wp::array_t<float>& opacity_logits, const wp::array_t<wp::vec3>& sh_dc, const wp::array_t<float>& correctives,
    const wp::array_t<float>& shading, const wp::array_t<wp::vec3>& extras_in, int extras,
    const wp::array_t<wp::vec4>& quats, const wp::array_t<wp::vec4>& quats_t, const wp::array_t<wp::vec4>& quats_own,
    int has_own, wp::array_t<wp::vec3>& means_t, wp::array_t<wp::vec3>& scales_t, wp::array_t<float>& opacities_t,
    wp::array_t<wp::vec3>& sh_dc_t
) {
    const int rows = log_scales.shape[0] - begin < 16 ? log_scales.shape[0] - begin : 16;
    const bool displaced = correctives.shape[1], shaded = shading.shape[1];
    vf mean[3] = {}, extra[3] = {}, rest[4] = {}, posed[4] = {}, own[4] = {}, scale[3], color[3];
    if (displaced) read_vectors(means.data, begin, rows, 3, mean);
    if (extras) read_vectors(extras_in.data, begin, rows, 3, extra);
    if (displaced || shaded) {
        read_vectors(quats.data, begin, rows, 4, rest);
        read_vectors(quats_t.data, begin, rows, 4, posed);
        if (has_own) read_vectors(quats_own.data, begin, rows, 4, own);
    }
    const Quaternions quat{rest, posed, has_own ? own : nullptr};
    const vf opacity = finish(
        begin, rows, log_scales, opacity_logits, sh_dc, correctives, shading, quat, extra, extras, mean, scale, color
    );
    if (displaced) write_vectors(means_t.data, begin, rows, 3, mean);
    write_vectors(scales_t.data, begin, rows, 3, scale);
    store(opacities_t.data + begin, opacity, rows);
    if (shaded || extras == EXTRAS_TINTS) write_vectors(sh_dc_t.data, begin, rows, 3, color);
}

// Write the gradients of what changed the results. Those of means pass unchanged, and those of added log scales are
// those of the log scales: both are left to the caller.
// A result without a gradient (null) passes none on.
static inline void finish_block_adjoint(
    int begin, const wp::array_t<wp::vec3>& scales_t, const wp::array_t<float>& opacities_t,
    const wp::array_t<wp::vec3>& sh_dc, const wp::array_t<float>& correctives, const wp::array_t<float>& shading,
    const wp::array_t<wp::vec3>& tints, int extras, const wp::array_t<wp::vec4>& quats,
    const wp::array_t<wp::vec4>& quats_t, const wp::array_t<wp::vec4>& quats_own, int has_own,
    const wp::array_t<wp::vec3>& v_means_t, const wp::array_t<wp::vec3>& v_scales_t,
    const wp::array_t<float>& v_opacities_t, const wp::array_t<wp::vec3>& v_sh_dc_t,
    wp::array_t<wp::vec3>& v_log_scales, wp::array_t<float>& v_opacity_logits, wp::array_t<wp::vec3>& v_sh_dc,
    wp::array_t<float>& v_correctives, wp::array_t<float>& v_shading, wp::array_t<wp::vec3>& v_tints
) {
    const int rows = scales_t.shape[0] - begin < 16 ? scales_t.shape[0] - begin : 16;
    const bool displaced = correctives.shape[1] && v_means_t.data;
    const bool shaded = shading.shape[1] && v_sh_dc_t.data, tinted = extras == EXTRAS_TINTS && v_sh_dc_t.data;
    // 1. Activations.
    if (v_scales_t.data) {
        vf scale[3], v_scale[3];
        read_vectors(scales_t.data, begin, rows, 3, scale);
        read_vectors(v_scales_t.data, begin, rows, 3, v_scale);
        for (int c = 0; c < 3; ++c) v_scale[c] = v_scale[c] * scale[c];
        write_vectors(v_log_scales.data, begin, rows, 3, v_scale);
    }
    if (v_opacities_t.data) {
        const vf opacity = load(opacities_t.data + begin, rows), v_opacity = load(v_opacities_t.data + begin, rows);
        store(v_opacity_logits.data + begin, v_opacity * ((1.0f - opacity) * opacity), rows);
    }
    // 2. Colours: first as shading found them, then as tints did.
    vf tint[3], factor[3], color[3], shown[3], v_color[3];
    if (tinted || shaded) {
        read_vectors(sh_dc.data, begin, rows, 3, color);
        read_vectors(v_sh_dc_t.data, begin, rows, 3, v_color);
    }
    if (tinted) {
        read_vectors(tints.data, begin, rows, 3, tint);
        for (int c = 0; c < 3; ++c) factor[c] = tint_factor(tint[c]);
    }
    if (displaced || shaded) {
        const Turns turns = read_turns(begin, rows, quats, quats_t, quats_own, has_own);
        if (shaded) {
            vf v_G[16];
            for (int c = 0; c < 3; ++c) {
                shown[c] = color[c];
                if (tinted) brighten(factor[c], shown[c]);
            }
            Gain(begin, rows, shading, turns.turn).adjoint(shown, v_color, v_G);
            write_columns(v_shading.data, begin, rows, 10, 0, 10, v_G);
        }
        if (displaced) {
            vf C[27], v_mean[3], v_C[27];
            read_matrix(correctives, begin, rows, C);
            read_vectors(v_means_t.data, begin, rows, 3, v_mean);
            displace_adjoint(C, turns, v_mean, v_C);
            write_matrix(v_correctives, begin, rows, v_C);
        }
    }
    if (tinted) {
        vf v_tint[3];
        for (int c = 0; c < 3; ++c) v_tint[c] = tint_adjoint(tint[c], factor[c], color[c], v_color[c]);
        write_vectors(v_tints.data, begin, rows, 3, v_tint);
    }
    if (tinted || shaded) write_vectors(v_sh_dc.data, begin, rows, 3, v_color);
}
