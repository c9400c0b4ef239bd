"""Adjoint of ``skin_rbf_lanes``: a chunk of Gaussians a thread, sixteen a step.

Adding a Gaussian's gradient to its node is again one multiply-add of a row: the outer product ``v (x, 1)^T`` and the
gradient of the blended rotation lie as the palette's motion row does.
"""

import warp as wp

from ..types import GRADIENT_MAX, POSITION_MAX
from .skinning_layout import BLOCK, SIMD

wp.set_module_options({"enable_backward": False})

_ADJOINT = (
    """
#if !defined(__CUDA_ARCH__)
{
"""
    + SIMD
    + f"""
    constexpr float GRADIENT_MAX = {float(GRADIENT_MAX)!r}f, POSITION_MAX = {float(POSITION_MAX)!r}f;
"""
    + BLOCK
    + """
    const int M = motion.shape[0];
    float* motion_sum = v_motion.data + (long long)chunk * M * 16;
    float* reach_sum = v_reach.data + (long long)chunk * M * 16;
    __builtin_memset(motion_sum, 0, 64ll * M);
    __builtin_memset(reach_sum, 0, 64ll * M);
    auto add4 = [&](float* table, int K, int k, const vf* columns) INLINE {
        vf parts[4];
        quads(columns, parts);  // quarter l of parts[i]: lane 4 l + i
        float from[64];
        for (int i = 0; i < 4; ++i) put(from + 16 * i, parts[i]);
        for (int l = 0; l < 16; ++l) {
            float* sum = table + 16ll * pick[l * K + k];
            *(v4u*)sum = *(const v4u*)sum + *(const v4u*)(from + 16 * (l % 4) + 4 * (l / 4));
        }
    };
    auto usable = [](vf v) INLINE -> vi { return __builtin_elementwise_abs(v) <= GRADIENT_MAX; };
    auto near = [](vf v) INLINE -> vi { return __builtin_elementwise_abs(v) <= POSITION_MAX; };
    auto run = [&](auto kc, int begin) INLINE {
        const int K = decltype(kc)::value ? decltype(kc)::value : indices.shape[1];
        read(begin, K);
        const float* weight = read_rows(spare_weights, (const float*)weights.data + (long long)begin * K, K);
        vf w[16], v[3], t[4], v_scales[3];
        weight_columns(weight, K, w);
        read_vectors(v_means_t.data, begin, Any{}, v);
        read_vectors(v_quats_t.data, begin, Four{}, t);
        if (has_log_scales) read_vectors(v_log_scales_t.data, begin, Any{}, v_scales);
        vf B[16], side[16], b[4], u[4], v_x[3], rows_of[16];
        blend(weight, w, K, side, B);
        // Gaussians that are not finite, or that a broken control point moves, and lanes past the end, pass nothing:
        // they become zeros with zero weights.
        vf probe = q[0] * 0.0f + q[1] * 0.0f + q[2] * 0.0f + q[3] * 0.0f;
        for (int d = 0; d < H; ++d) probe = probe + hyper_point[d] * 0.0f;
        vi alive = (probe == 0.0f) & (number < rows);
        for (int c = 0; c < 3; ++c) alive = alive & near(x[c]);
        for (int c = 0; c < 16; ++c) alive = alive & near(B[c]);
        if (!__builtin_reduce_and(alive)) {
            for (int c = 0; c < 16; ++c) B[c] = alive ? B[c] : (vf){};
            for (int k = 0; k < K; ++k) w[k] = alive ? w[k] : (vf){};
            for (int c = 0; c < 3; ++c) { x[c] = alive ? x[c] : (vf){}; v[c] = alive ? v[c] : (vf){}; }
            for (int c = 0; c < 4; ++c) { q[c] = alive ? q[c] : (vf){}; t[c] = alive ? t[c] : (vf){}; }
            for (int c = 0; c < 3 && has_log_scales; ++c) v_scales[c] = alive ? v_scales[c] : (vf){};
            for (int d = 0; d < H; ++d) hyper_point[d] = alive ? hyper_point[d] : (vf){};
            weight_rows(w, K, spare_weights);
            weight = spare_weights;
        }
        vf nb = inverse_norm(B[12], B[13], B[14], B[15]), nq = inverse_norm(q[0], q[1], q[2], q[3]);
        for (int c = 0; c < 4; ++c) {
            vf identity = (vf){} + (c == 0 ? 1.0f : 0.0f);
            b[c] = nb > 0.0f ? B[12 + c] * nb : identity;
            u[c] = nq > 0.0f ? q[c] * nq : identity;
        }
        vf v_u[4] = {  // conj(b) t
            b[0] * t[0] + b[1] * t[1] + b[2] * t[2] + b[3] * t[3],
            b[0] * t[1] - b[1] * t[0] - b[2] * t[3] + b[3] * t[2],
            b[0] * t[2] + b[1] * t[3] - b[2] * t[0] - b[3] * t[1],
            b[0] * t[3] - b[1] * t[2] + b[2] * t[1] - b[3] * t[0]};
        vf v_b[4] = {  // t conj(u)
            t[0] * u[0] + t[1] * u[1] + t[2] * u[2] + t[3] * u[3],
            t[1] * u[0] - t[0] * u[1] - t[2] * u[3] + t[3] * u[2],
            t[2] * u[0] - t[0] * u[2] + t[1] * u[3] - t[3] * u[1],
            t[3] * u[0] - t[0] * u[3] - t[1] * u[2] + t[2] * u[1]};
        vf along_u = v_u[0] * u[0] + v_u[1] * u[1] + v_u[2] * u[2] + v_u[3] * u[3];
        vf along_b = v_b[0] * b[0] + v_b[1] * b[1] + v_b[2] * b[2] + v_b[3] * b[3];
        for (int c = 0; c < 3; ++c) {
            v_x[c] = B[c] * v[0] + B[4 + c] * v[1] + B[8 + c] * v[2];
            for (int d = 0; d < 3; ++d) rows_of[4 * c + d] = v[c] * x[d];
            rows_of[4 * c + 3] = v[c];
        }
        for (int c = 0; c < 4; ++c) {
            v_u[c] = (v_u[c] - u[c] * along_u) * nq;
            rows_of[12 + c] = (v_b[c] - b[c] * along_b) * nb;
        }
        // What overflows becomes 0; what came in as NaN goes out as NaN.
        const vi given = usable(v[0]) & usable(v[1]) & usable(v[2])
            & usable(t[0]) & usable(t[1]) & usable(t[2]) & usable(t[3]);
        for (int c = 0; c < 4; ++c) v_u[c] = (usable(v_u[c]) | ~given) ? v_u[c] : (vf){};
        write_vectors(v_quats.data, begin, Four{}, v_u);
        transpose(rows_of);  // row l: what Gaussian l's blended motion row receives
        vf v_weight[16], mean = (vf){};
        for (int k = 0; k < K; ++k) {
            vf products[16];
            float turned[16];
            if (!aligned) put(turned, side[k]);
            for (int l = 0; l < 16; ++l) {
                vf g = aligned ? rows_of[l] : (upper ? (vf){} + turned[l] : (vf){} + 1.0f) * rows_of[l];
                products[l] = g * load(motion.data + 16ll * pick[l * K + k]);
                float* sum = motion_sum + 16ll * pick[l * K + k];
                put(sum, load(sum) + weight[l * K + k] * g);
            }
            v_weight[k] = lane_sums(products);
            if (has_log_scales) {
                vf node[4];
                gather4(reach.data + 4, K, k, node);
                for (int c = 0; c < 3; ++c) v_weight[k] = v_weight[k] + v_scales[c] * node[1 + c];
            }
            v_weight[k] = (alive & usable(v_weight[k])) ? v_weight[k] : (vf){};
            mean = mean + w[k] * v_weight[k];
        }
        vf v_hyper_point[8] = {};
        for (int k = 0; k < K; ++k) {
            vf e[12], part[4];
            vf d2 = offset(K, k, e);
            const vf v_logit = w[k] * (v_weight[k] - mean);
            const vi moves = v_logit != 0.0f;  // elsewhere the distance need not be finite
            vf factor = moves ? 2.0f * e[3] * v_logit : (vf){};
            for (int c = 0; c < 3; ++c) {
                e[c] = moves ? e[c] : (vf){};
                v_x[c] = v_x[c] + factor * e[c];
                part[c] = v_logit * e[c];
            }
            part[3] = moves ? v_logit * d2 : (vf){};
            add4(reach_sum, K, k, part);
            if (has_strengths || has_log_scales) {
                part[0] = v_logit;
                for (int c = 0; c < 3; ++c) part[1 + c] = has_log_scales ? w[k] * v_scales[c] : (vf){};
                add4(reach_sum + 4, K, k, part);
            }
            for (int h = 0; h < H; h += 4) {
                for (int c = 0; c < 4; ++c) {
                    vf other = moves ? e[4 + h + c] : (vf){};
                    v_hyper_point[h + c] = v_hyper_point[h + c] + factor * other;
                    part[c] = v_logit * other;
                }
                add4(reach_sum + 8 + h, K, k, part);
            }
        }
        for (int c = 0; c < 3; ++c) v_x[c] = (usable(v_x[c]) | ~given) ? v_x[c] : (vf){};
        write_vectors(v_means.data, begin, Any{}, v_x);
        for (int d = 0; d < H; ++d) {
            float lanes[16];
            put(lanes, usable(v_hyper_point[d]) ? v_hyper_point[d] : (vf){});
            for (int l = 0; l < rows; ++l) v_hyper.data[(begin + l) * (long long)H + d] = lanes[l];
        }
    };
    const int end = (chunk + 1) * size < N ? (chunk + 1) * size : N;
    for (int begin = chunk * size; begin < end; begin += 16) {
        if (indices.shape[1] == 4) run(Four{}, begin);
        else run(Any{}, begin);
    }
    #undef INLINE
}
#endif
"""
)


@wp.func_native(_ADJOINT)
def _skin_rbf_adjoint(
    chunk: int, size: int, means: wp.array[wp.vec3], quats: wp.array[wp.vec4], hyper: wp.array2d[float],
    has_hyper: int, motion: wp.array2d[float], reach: wp.array2d[float], aligned: int, has_strengths: int,
    has_log_scales: int, indices: wp.array2d[wp.int32], weights: wp.array2d[float], v_means_t: wp.array[wp.vec3],
    v_quats_t: wp.array[wp.vec4], v_log_scales_t: wp.array[wp.vec3], v_means: wp.array[wp.vec3],
    v_quats: wp.array[wp.vec4], v_hyper: wp.array2d[float], v_motion: wp.array2d[float], v_reach: wp.array2d[float],
): ...  # fmt: skip


@wp.kernel
def skin_rbf_lanes_adjoint(
    first: int,
    # In:
    size: int,  # Gaussians a chunk, a multiple of 16 that does not depend on the threads
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
    weights_in: wp.array2d[float],  # [N, K]
    v_means_in: wp.array[wp.vec3],  # [N]
    v_quats_in: wp.array[wp.vec4],  # [N]
    v_log_scales_in: wp.array[wp.vec3],  # [N], touched only with has_log_scales
    # Out:
    v_means_out: wp.array[wp.vec3],  # [N]
    v_quats_out: wp.array[wp.vec4],  # [N]
    v_hyper_out: wp.array2d[float],  # [N, H], touched only with has_hyper
    v_motion_out: wp.array2d[float],  # [chunks * M, 16]
    v_reach_out: wp.array2d[float],  # [chunks * M, 16]: as reach; v e, v d^2, v, w v_log_scales of the exponents' v
):
    """One chunk of Gaussians: their gradients, and their sums for every node."""
    chunk = first + wp.tid()
    _skin_rbf_adjoint(
        chunk, size, means_in, quats_in, hyper_in, has_hyper, motion_in, reach_in, aligned, has_strengths,
        has_log_scales, indices_in, weights_in, v_means_in, v_quats_in, v_log_scales_in, v_means_out, v_quats_out,
        v_hyper_out, v_motion_out, v_reach_out,
    )  # fmt: skip
