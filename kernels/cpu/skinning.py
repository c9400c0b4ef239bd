"""RBF weights and skinning in one pass, for CPUs: sixteen Gaussians a step, SIMD in native bodies.

The same mathematics as ``rbf_weights`` and ``skin``, which stay the readable truth, over the rows of
``skinning_palette.py``: blending is one multiply-add of a whole row a neighbour. ``skin_lanes`` takes weights that are
known, as they are when a scene is rendered; ``skinning_cpu_adjoint.py`` has the gradients.
"""

import warp as wp

from .skinning_layout import BLOCK, SIMD

wp.set_module_options({"enable_backward": False})

MAX_NEIGHBORS = 16
LANES = 16

_MOVE = """
    auto move = [&](int K, const float* weight, const vf* weights_of) INLINE {
        vf B[16], side[16];
        blend(weight, weights_of, K, side, B);
        vf moved[3], b[4], u[4];
        for (int c = 0; c < 3; ++c)
            moved[c] = B[4 * c] * x[0] + B[4 * c + 1] * x[1] + B[4 * c + 2] * x[2] + B[4 * c + 3];
        vf nb = inverse_norm(B[12], B[13], B[14], B[15]), nq = inverse_norm(q[0], q[1], q[2], q[3]);
        for (int c = 0; c < 4; ++c) {
            vf identity = (vf){} + (c == 0 ? 1.0f : 0.0f);
            b[c] = nb > 0.0f ? B[12 + c] * nb : identity;
            u[c] = nq > 0.0f ? q[c] * nq : identity;
        }
        vf turned[4] = {
            b[0] * u[0] - b[1] * u[1] - b[2] * u[2] - b[3] * u[3],
            b[0] * u[1] + b[1] * u[0] + b[2] * u[3] - b[3] * u[2],
            b[0] * u[2] - b[1] * u[3] + b[2] * u[0] + b[3] * u[1],
            b[0] * u[3] + b[1] * u[2] - b[2] * u[1] + b[3] * u[0]};
        write_vectors(means_t.data, begin, Any{}, moved);
        write_vectors(quats_t.data, begin, Four{}, turned);
        if (has_log_scales) {
            float sums[16][4];
            for (int l = 0; l < 16; ++l) {
                v4 row = {};
                for (int k = 0; k < K; ++k)
                    row = row + weight[l * K + k] * *(const v4u*)(reach.data + 16ll * pick[l * K + k] + 4);
                *(v4u*)sums[l] = row;
            }
            for (int l = 0; l < rows; ++l)
                for (int c = 0; c < 3; ++c) log_scales.data[begin + l][c] = sums[l][1 + c];
        }
    };
"""

_STORED = (
    """
#if !defined(__CUDA_ARCH__)
{
"""
    + SIMD
    + """
    const int has_hyper = 0;
    const struct { const float* data; int shape[2]; } hyper = {nullptr, {0, 0}};
"""
    + BLOCK
    + _MOVE
    + """
    auto run = [&](auto kc) INLINE {
        const int K = decltype(kc)::value ? decltype(kc)::value : indices.shape[1];
        read(begin, K);
        const float* weight = read_rows(spare_weights, (const float*)weights.data + (long long)begin * K, K);
        vf columns[16];
        if (!aligned) weight_columns(weight, K, columns);
        move(K, weight, columns);
    };
    if (indices.shape[1] == 4) run(Four{});
    else run(Any{});
    #undef INLINE
}
#endif
"""
)

_RBF = (
    """
#if !defined(__CUDA_ARCH__)
{
"""
    + SIMD
    + BLOCK
    + _MOVE
    + """
    auto run = [&](auto kc) INLINE {
        const int K = decltype(kc)::value ? decltype(kc)::value : indices.shape[1];
        read(begin, K);
        vf w[16], top = (vf){} - infinity, total = (vf){};
        for (int k = 0; k < K; ++k) {
            vf e[12];
            vf logit = offset(K, k, e);
            logit = logit * e[3];
            if (has_strengths) {
                float strength[16];
                #pragma clang loop vectorize(disable)
                for (int l = 0; l < 16; ++l) strength[l] = reach.data[16ll * pick[l * K + k] + 4];
                logit = logit + load(strength);
            }
            w[k] = ((logit > -infinity) & (logit < infinity)) ? logit : (vf){} - infinity;
            top = w[k] > top ? w[k] : top;
        }
        const vi none = top == -infinity;
        for (int k = 0; k < K; ++k) {
            w[k] = w[k] > -infinity ? exponential(w[k] - (none ? (vf){} : top)) : (vf){};
            if (k == 0) w[k] = none ? (vf){} + 1.0f : w[k];
            total = total + w[k];
        }
        const vf inverse = 1.0f / total;
        for (int k = 0; k < K; ++k) w[k] = w[k] * inverse;
        weight_rows(w, K, spare_weights);
        __builtin_memcpy(weights.data + (long long)begin * K, spare_weights, 4 * K * rows);
        move(K, spare_weights, w);
    };
    if (indices.shape[1] == 4) run(Four{});
    else run(Any{});
    #undef INLINE
}
#endif
"""
)


@wp.func_native(_STORED)
def _skin_lanes(
    begin: int, means: wp.array[wp.vec3], quats: wp.array[wp.vec4], motion: wp.array2d[float],
    reach: wp.array2d[float], aligned: int, has_log_scales: int, indices: wp.array2d[wp.int32],
    weights: wp.array2d[float], means_t: wp.array[wp.vec3], quats_t: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
): ...  # fmt: skip


@wp.func_native(_RBF)
def _skin_rbf_lanes(
    begin: int, means: wp.array[wp.vec3], quats: wp.array[wp.vec4], hyper: wp.array2d[float], has_hyper: int,
    motion: wp.array2d[float], reach: wp.array2d[float], aligned: int, has_strengths: int, has_log_scales: int,
    indices: wp.array2d[wp.int32], weights: wp.array2d[float], means_t: wp.array[wp.vec3],
    quats_t: wp.array[wp.vec4], log_scales: wp.array[wp.vec3],
): ...  # fmt: skip


@wp.kernel
def skin_lanes(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N]
    quats_in: wp.array[wp.vec4],  # [N]
    motion_in: wp.array2d[float],  # [M, 16]
    reach_in: wp.array2d[float],  # [M, 16]
    aligned: int,  # all shape rotations lie on the same side
    has_log_scales: int,
    indices_in: wp.array2d[wp.int32],  # [N, K]
    weights_in: wp.array2d[float],  # [N, K]
    # Out:
    means_out: wp.array[wp.vec3],  # [N]
    quats_out: wp.array[wp.vec4],  # [N]
    log_scales_out: wp.array[wp.vec3],  # [N], touched only with has_log_scales
):
    """Gaussians ``16 i .. 16 i + 15``, with weights that are known."""
    begin = (first + wp.tid()) * 16
    _skin_lanes(
        begin, means_in, quats_in, motion_in, reach_in, aligned, has_log_scales, indices_in, weights_in,
        means_out, quats_out, log_scales_out,
    )  # fmt: skip


@wp.kernel
def skin_rbf_lanes(
    first: int,
    # In:
    means_in: wp.array[wp.vec3],  # [N]
    quats_in: wp.array[wp.vec4],  # [N]
    hyper_in: wp.array2d[float],  # [N, H], touched only with has_hyper
    has_hyper: int,
    motion_in: wp.array2d[float],  # [M, 16]
    reach_in: wp.array2d[float],  # [M, 16]
    aligned: int,  # all shape rotations lie on the same side
    has_strengths: int,
    has_log_scales: int,
    indices_in: wp.array2d[wp.int32],  # [N, K]
    # Out:
    weights_out: wp.array2d[float],  # [N, K]
    means_out: wp.array[wp.vec3],  # [N]
    quats_out: wp.array[wp.vec4],  # [N]
    log_scales_out: wp.array[wp.vec3],  # [N], touched only with has_log_scales
):
    """Gaussians ``16 i .. 16 i + 15``."""
    begin = (first + wp.tid()) * 16
    _skin_rbf_lanes(
        begin, means_in, quats_in, hyper_in, has_hyper, motion_in, reach_in, aligned, has_strengths,
        has_log_scales, indices_in, weights_out, means_out, quats_out, log_scales_out,
    )  # fmt: skip
