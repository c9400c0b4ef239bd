// Shading and tints of 16 Gaussians, one per lane, by the formulas of kernels/shading.py, and their adjoints.
#pragma once
#include "exponential.h"
#include "turn_block.h"

// What the gain of a block's Gaussians depends on; `turn` is their rotation since rest, less the identity.
struct Gain {
    vf turn[9], x, bend, free;

    __attribute__((always_inline)) Gain(int begin, int rows, const wp::array_t<float>& shading, const vf* since_rest) {
        FUSE_WITHIN_EXPRESSIONS
        vf G[16];
        for (int k = 0; k < 9; ++k) turn[k] = since_rest[k];
        prefetch_next(shading.data, begin, 10);
        read_columns(shading.data, 10ll * shading.shape[0], begin, rows, 10, 0, G);
        x = G[0] * turn[0];
        for (int k = 1; k < 9; ++k) x = x + G[k] * turn[k];
        bend = G[9];
        free = 1.0f + x + SHADING_BEND * bend * x * x;
    }

    // Return the gain within its limits, and 1 where it is non-finite.
    __attribute__((always_inline)) vf limited() const {
        const vf low = free < 0.0f ? vf{} : free;
        const vf within = low > SHADING_GAIN_MAX ? vf{} + SHADING_GAIN_MAX : low;
        return finite(free) ? within : vf{} + 1.0f;
    }

    // Turn the gradients `v` of shaded colours into those of `color`, and write those of G and b, 16 columns.
    __attribute__((always_inline)) void adjoint(const vf* color, vf* v, vf* v_G) const {
        FUSE_WITHIN_EXPRESSIONS
        const vf factor = limited();
        vf v_factor = {};
        for (int c = 0; c < 3; ++c) {
            v_factor = v_factor + v[c] * (color[c] + SHADING_GREY);
            v[c] = factor * v[c];
        }
        v_factor = (finite(free) & (free == factor)) ? v_factor : vf{};
        const vf v_x = v_factor * (1.0f + 2.0f * SHADING_BEND * bend * x);
        const vf v_bend = v_factor * SHADING_BEND * x * x;
        const vi valid = finite(v_x * (turn[0] + turn[4] + turn[8]) + v_bend);
        for (int k = 0; k < 9; ++k) v_G[k] = valid ? v_x * turn[k] : vf{};
        v_G[9] = valid ? v_bend : vf{};
        for (int k = 10; k < 16; ++k) v_G[k] = vf{};
    }
};

// Read the gain of a block.
ALWAYS_INLINE Gain read_gain(
    int begin, int rows, const wp::array_t<float>& shading, const wp::array_t<wp::vec4>& quats,
    const wp::array_t<wp::vec4>& quats_t
) {
    vf rest[4], posed[4], turn[9];
    read_vectors(quats.data, begin, rows, 4, rest);
    read_vectors(quats_t.data, begin, rows, 4, posed);
    rotation_between(rest, posed, turn);
    subtract_identity(turn);
    return Gain(begin, rows, shading, turn);
}

// Multiply a block's colours, above grey, by a factor.
ALWAYS_INLINE void brighten(vf factor, vf& color) {
    FUSE_WITHIN_EXPRESSIONS
    color = factor * (color + SHADING_GREY) - SHADING_GREY;
}

static inline void shade_block(
    int begin, const wp::array_t<wp::vec3>& sh_dc, const wp::array_t<float>& shading,
    const wp::array_t<wp::vec4>& quats, const wp::array_t<wp::vec4>& quats_t, wp::array_t<wp::vec3>& shaded
) {
    FUSE_WITHIN_EXPRESSIONS
    const int rows = sh_dc.shape[0] - begin < 16 ? sh_dc.shape[0] - begin : 16;
    const vf factor = read_gain(begin, rows, shading, quats, quats_t).limited();
    vf color[3];
    read_vectors(sh_dc.data, begin, rows, 3, color);
    for (int c = 0; c < 3; ++c) brighten(factor, color[c]);
    write_vectors(shaded.data, begin, rows, 3, color);
}

static inline void shade_block_adjoint(
    int begin, const wp::array_t<wp::vec3>& sh_dc, const wp::array_t<float>& shading,
    const wp::array_t<wp::vec4>& quats, const wp::array_t<wp::vec4>& quats_t, const wp::array_t<wp::vec3>& v_shaded,
    wp::array_t<wp::vec3>& v_sh_dc, wp::array_t<float>& v_shading
) {
    const int rows = sh_dc.shape[0] - begin < 16 ? sh_dc.shape[0] - begin : 16;
    const Gain gain = read_gain(begin, rows, shading, quats, quats_t);
    vf color[3], v[3], v_G[16];
    read_vectors(sh_dc.data, begin, rows, 3, color);
    read_vectors(v_shaded.data, begin, rows, 3, v);
    gain.adjoint(color, v, v_G);
    write_vectors(v_sh_dc.data, begin, rows, 3, v);
    write_columns(v_shading.data, begin, rows, 10, 0, 10, v_G);
}

// Return the factor on a colour, within its limits; 1 where the tint is non-finite.
ALWAYS_INLINE vf tint_factor(vf tint) {
    const vf low = tint < SHADING_TINT_MIN ? vf{} + SHADING_TINT_MIN : tint;
    const vf within = low > SHADING_TINT_MAX ? vf{} + SHADING_TINT_MAX : low;
    return finite(tint) ? exponential(within) : vf{} + 1.0f;
}

// Turn the gradient `v` of a tinted colour into that of `color`, and return that of the tint, whose factor is given.
ALWAYS_INLINE vf tint_adjoint(vf tint, vf factor, vf color, vf& v) {
    FUSE_WITHIN_EXPRESSIONS
    v = factor * v;
    const vf v_tint = v * (color + SHADING_GREY);
    return ((tint > SHADING_TINT_MIN) & (tint < SHADING_TINT_MAX) & finite(v_tint)) ? v_tint : vf{};
}

static inline void tint_block(
    int begin, const wp::array_t<wp::vec3>& sh_dc, const wp::array_t<wp::vec3>& tints, wp::array_t<wp::vec3>& tinted
) {
    FUSE_WITHIN_EXPRESSIONS
    const int rows = sh_dc.shape[0] - begin < 16 ? sh_dc.shape[0] - begin : 16;
    vf color[3], tint[3];
    read_vectors(sh_dc.data, begin, rows, 3, color);
    read_vectors(tints.data, begin, rows, 3, tint);
    for (int c = 0; c < 3; ++c) brighten(tint_factor(tint[c]), color[c]);
    write_vectors(tinted.data, begin, rows, 3, color);
}

static inline void tint_block_adjoint(
    int begin, const wp::array_t<wp::vec3>& sh_dc, const wp::array_t<wp::vec3>& tints,
    const wp::array_t<wp::vec3>& v_tinted, wp::array_t<wp::vec3>& v_sh_dc, wp::array_t<wp::vec3>& v_tints
) {
    const int rows = sh_dc.shape[0] - begin < 16 ? sh_dc.shape[0] - begin : 16;
    vf color[3], tint[3], v[3], v_tint[3];
    read_vectors(sh_dc.data, begin, rows, 3, color);
    read_vectors(tints.data, begin, rows, 3, tint);
    read_vectors(v_tinted.data, begin, rows, 3, v);
    for (int c = 0; c < 3; ++c) v_tint[c] = tint_adjoint(tint[c], tint_factor(tint[c]), color[c], v[c]);
    write_vectors(v_sh_dc.data, begin, rows, 3, v);
    write_vectors(v_tints.data, begin, rows, 3, v_tint);
}
