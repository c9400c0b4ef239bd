// Correctives of 16 Gaussians, one per lane, by the formulas of kernels/correctives.py, and their adjoint.
#pragma once
#include "turn_block.h"

// The rotations of a block: `turn`, less the identity, determines the displacement, and `rotation` carries it along.
struct Turns {
    vf turn[9], rotation[9];

    __attribute__((always_inline)) Turns(const vf* rest, const vf* posed, const vf* own) {
        rotation_between(rest, posed, rotation);
        for (int k = 0; k < 9; ++k) turn[k] = rotation[k];
        if (own) rotation_between(rest, own, turn);
        subtract_identity(turn);
    }
};

// Read the rotations of a block.
ALWAYS_INLINE Turns read_turns(
    int begin, int rows, const wp::array_t<wp::vec4>& quats, const wp::array_t<wp::vec4>& quats_t,
    const wp::array_t<wp::vec4>& quats_own, int has_own
) {
    vf rest[4], posed[4], own[4];
    read_vectors(quats.data, begin, rows, 4, rest);
    read_vectors(quats_t.data, begin, rows, 4, posed);
    if (has_own) read_vectors(quats_own.data, begin, rows, 4, own);
    return Turns(rest, posed, has_own ? own : nullptr);
}

// Read the 27 columns of the matrices C as two sixteens that overlap.
ALWAYS_INLINE void read_matrix(const wp::array_t<float>& correctives, int begin, int rows, vf* C) {
    const long long size = 27ll * correctives.shape[0];
    vf right[16];
    prefetch_next(correctives.data, begin, 27);
    read_columns(correctives.data, size, begin, rows, 27, 0, C);
    read_columns(correctives.data, size, begin, rows, 27, 11, right);
    for (int k = 5; k < 16; ++k) C[11 + k] = right[k];
}

// Write the matrices C. Changes them.
ALWAYS_INLINE void write_matrix(wp::array_t<float>& correctives, int begin, int rows, vf* C) {
    vf right[16];
    for (int k = 0; k < 16; ++k) right[k] = C[11 + k];
    write_columns(correctives.data, begin, rows, 27, 0, 16, C);
    write_columns(correctives.data, begin, rows, 27, 11, 16, right);
}

// Displace the means of a block.
ALWAYS_INLINE void displace(const vf* C, const Turns& turns, vf* mean) {
    FUSE_WITHIN_EXPRESSIONS
    vf shift[3], moved[3];
    for (int a = 0; a < 3; ++a) {
        shift[a] = C[9 * a] * turns.turn[0];
        for (int k = 1; k < 9; ++k) shift[a] = shift[a] + C[9 * a + k] * turns.turn[k];
    }
    vf change = {};
    for (int a = 0; a < 3; ++a) {
        const vf* R = turns.rotation + 3 * a;
        moved[a] = mean[a] + CORRECTIVE_SCALE * (R[0] * shift[0] + R[1] * shift[1] + R[2] * shift[2]);
        change = change + (moved[a] - mean[a]);
    }
    const vi valid = finite(change);
    for (int a = 0; a < 3; ++a) mean[a] = valid ? moved[a] : mean[a];
}

// Compute the gradients of the matrices C of a block; 0 for a displacement that is left out.
ALWAYS_INLINE void displace_adjoint(const vf* C, const Turns& turns, const vf* v_mean, vf* v_C) {
    FUSE_WITHIN_EXPRESSIONS
    vf v_shift[3], total = {};
    for (int a = 0; a < 3; ++a) {
        const vf* R = turns.rotation + a;
        v_shift[a] = CORRECTIVE_SCALE * (R[0] * v_mean[0] + R[3] * v_mean[1] + R[6] * v_mean[2]);
        for (int k = 0; k < 9; ++k) {
            v_C[9 * a + k] = v_shift[a] * turns.turn[k];
            total = total + (C[9 * a + k] * turns.turn[k] + v_C[9 * a + k]);
        }
    }
    const vi valid = finite(total);
    for (int k = 0; k < 27; ++k) v_C[k] = valid ? v_C[k] : vf{};
}

static inline void correct_block(
    int begin, const wp::array_t<wp::vec3>& means, const wp::array_t<float>& correctives,
    const wp::array_t<wp::vec4>& quats, const wp::array_t<wp::vec4>& quats_t, const wp::array_t<wp::vec4>& quats_own,
    int has_own, wp::array_t<wp::vec3>& means_t
) {
    const int rows = means.shape[0] - begin < 16 ? means.shape[0] - begin : 16;
    const Turns turns = read_turns(begin, rows, quats, quats_t, quats_own, has_own);
    vf C[27], mean[3];
    read_matrix(correctives, begin, rows, C);
    read_vectors(means.data, begin, rows, 3, mean);
    displace(C, turns, mean);
    write_vectors(means_t.data, begin, rows, 3, mean);
}

static inline void correct_block_adjoint(
    int begin, const wp::array_t<float>& correctives, const wp::array_t<wp::vec4>& quats,
    const wp::array_t<wp::vec4>& quats_t, const wp::array_t<wp::vec4>& quats_own, int has_own,
    const wp::array_t<wp::vec3>& v_means_t, wp::array_t<float>& v_correctives
) {
    const int total_rows = correctives.shape[0];
    const int rows = total_rows - begin < 16 ? total_rows - begin : 16;
    const Turns turns = read_turns(begin, rows, quats, quats_t, quats_own, has_own);
    vf C[27], v_mean[3], v_C[27];
    read_matrix(correctives, begin, rows, C);
    read_vectors(v_means_t.data, begin, rows, 3, v_mean);
    displace_adjoint(C, turns, v_mean, v_C);
    write_matrix(v_correctives, begin, rows, v_C);
}
