"""RBF weights and skinning in one pass, for CPUs: sixteen Gaussians a step, SIMD in native bodies.

The same mathematics as ``rbf_weights`` and ``skin``, which stay the readable truth, over the rows of
``skinning_palette.py``. Blending is one multiply-add a neighbour, and so is adding a Gaussian's gradient to its node:
the outer product ``v (x, 1)^T`` and the gradient of the blended rotation are again one row. Between the rows of single
Gaussians and lanes of sixteen lie 16 x 16 transpositions.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

MAX_NEIGHBORS = 16
LANES = 16


def _shuffle(step: int, high: bool) -> str:
    """One step of a 16 x 16 transposition: which elements of rows i (0..15) and i + step (16..31) go together."""
    lanes = [(lane | step if high else lane & ~step) + (16 if lane & step else 0) for lane in range(16)]
    return "__builtin_shufflevector(a, b, " + ", ".join(map(str, lanes)) + ")"


def _steps(body: str) -> str:
    return "".join(body.format(step=s, low=_shuffle(s, False), high=_shuffle(s, True)) for s in (8, 4, 2, 1))


_PRELUDE = (
    """
    typedef float vf __attribute__((vector_size(64)));
    typedef int vi __attribute__((vector_size(64)));
    typedef float vu __attribute__((vector_size(64), aligned(4)));
    // Single lanes go through arrays of floats: a lane of a register picked by a variable would be spilled every time.
    auto load = [](const float* at) -> vf { return *(const vu*)at; };
    auto put = [](float* at, vf value) { *(vu*)at = value; };
    auto transpose = [](vf* rows) {
"""
    + _steps("""
        for (int i = 0; i < 16; ++i) if (!(i & {step})) {{
            vf a = rows[i], b = rows[i + {step}];
            rows[i] = {low}; rows[i + {step}] = {high};
        }}""")
    + """
    };
    auto row_sums = [](vf* rows) -> vf {  // lane i: the sum of row i; destroys the rows
"""
    + _steps("""
        for (int i = 0; i < {step}; ++i) {{
            vf a = rows[i], b = rows[i + {step}];
            rows[i] = {low} + {high};
        }}""")
    + """
        return rows[0];
    };
    auto inverse_norm = [](vf a, vf b, vf c, vf d) -> vf {  // 0 where the norm is 0 or not a number
        vf n = a * a + b * b + c * c + d * d, r;
        for (int l = 0; l < 16; ++l) r[l] = 1.0f / __builtin_sqrtf(n[l]);
        return ((n > 0.0f) & (n < __builtin_inff())) ? r : (vf){};
    };
    auto exponential = [](vf x) -> vf {  // of x <= 0; 0 below -87
        vf y = x < -87.0f ? (vf){} - 87.0f : x;
        vf shifted = y * 1.44269504f + 12582912.0f;
        vf n = shifted - 12582912.0f;
        vf f = y - n * 0.693359375f + n * 2.12194440e-4f;
        vf p = 1.0f + f * (1.0f + f * (0.5f + f * (0.16666667f + f * (4.16666667e-2f + f * (8.3333333e-3f
             + f * 1.3888889e-3f)))));
        vi bits = (__builtin_convertvector(n, vi) + 127) << 23;
        return x < -87.0f ? (vf){} : p * (vf)bits;
    };
    const int K = indices.shape[1], N = means.shape[0], H = has_hyper ? hyper.shape[1] : 0;
    const float infinity = __builtin_inff();
    const vi number = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    vf x[3], q[4], points[16], motion_rows[16];
    float xs[3][16], qs[4][16], point[16][16], side[16][16], weight[16][16];
    int picked[16][16];  // node of neighbour k of lane l
    int rows = 0;
    auto read = [&](int begin) {
        rows = N - begin < 16 ? N - begin : 16;
        for (int l = 0; l < 16; ++l) {
            long long g = l < rows ? begin + l : N - 1;
            put(point[l], (vf){});
            for (int d = 0; d < 3; ++d) point[l][d] = xs[d][l] = means.data[g][d];
            for (int d = 0; d < H; ++d) point[l][3 + d] = hyper.data[g * H + d];
            for (int c = 0; c < 4; ++c) qs[c][l] = quats.data[g][c];
            #pragma clang loop vectorize(disable)
            for (int k = 0; k < K; ++k) picked[k][l] = indices.data[g * K + k];
        }
        for (int d = 0; d < 3; ++d) x[d] = load(xs[d]);
        for (int c = 0; c < 4; ++c) q[c] = load(qs[c]);
        for (int l = 0; l < 16; ++l) points[l] = load(point[l]);
    };
    // -1 where a neighbour's shape rotation must be turned to the side of the first one's, else 1.
    const vi upper = number >= 12;
    auto align = [&]() {
        put(side[0], (vf){} + 1.0f);
        for (int k = 1; k < K; ++k) {
            vf products[16];
            for (int l = 0; l < 16; ++l) {
                vf p = load(motion.data + 16ll * picked[k][l]) * load(motion.data + 16ll * picked[0][l]);
                products[l] = upper ? p : (vf){};
            }
            put(side[k], row_sums(products) < 0.0f ? (vf){} - 1.0f : (vf){} + 1.0f);
        }
    };
    auto blend = [&]() {
        for (int l = 0; l < 16; ++l) {
            vf row = (vf){};
            for (int k = 0; k < K; ++k) {
                vf w = upper ? (vf){} + weight[k][l] * side[k][l] : (vf){} + weight[k][l];
                row += w * load(motion.data + 16ll * picked[k][l]);
            }
            motion_rows[l] = row;
        }
        transpose(motion_rows);
    };
"""
)

_FORWARD = (
    """
#if !defined(__CUDA_ARCH__)
{
    #pragma clang fp contract(fast)
"""
    + _PRELUDE
    + """
    read(begin);
    const vi inside = number < 3 + H;
    vf top = (vf){} - infinity, total = (vf){};
    for (int k = 0; k < K; ++k) {
        vf squares[16];
        float inverse[16], strength[16];
        for (int l = 0; l < 16; ++l) {
            const float* at = reach.data + 16ll * picked[k][l];
            vf e = points[l] - load(at);
            squares[l] = inside ? e * e : (vf){};
            inverse[l] = at[14]; strength[l] = at[15];
        }
        vf logit = row_sums(squares) * load(inverse) + load(strength);
        vi good = (logit > -infinity) & (logit < infinity);
        logit = good ? logit : (vf){} - infinity;
        put(weight[k], logit);
        top = logit > top ? logit : top;
    }
    const vi none = top == -infinity;
    for (int k = 0; k < K; ++k) {
        vf logit = load(weight[k]);
        vf w = logit > -infinity ? exponential(logit - (none ? (vf){} : top)) : (vf){};
        if (k == 0) w = none ? (vf){} + 1.0f : w;
        put(weight[k], w);
        total += w;
    }
    for (int k = 0; k < K; ++k) {
        put(weight[k], load(weight[k]) / total);
        #pragma clang loop vectorize(disable)
        for (int l = 0; l < rows; ++l) weights.data[(long long)(begin + l) * K + k] = weight[k][l];
    }
    if (has_log_scales)
        for (int l = 0; l < rows; ++l) {
            vf row = (vf){};
            for (int k = 0; k < K; ++k) row += weight[k][l] * load(reach.data + 16ll * picked[k][l]);
            for (int c = 0; c < 3; ++c) log_scales.data[begin + l][c] = row[11 + c];
        }
    align();
    blend();
    const vf* B = motion_rows;
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
        b[0] * u[0] - b[1] * u[1] - b[2] * u[2] - b[3] * u[3], b[0] * u[1] + b[1] * u[0] + b[2] * u[3] - b[3] * u[2],
        b[0] * u[2] - b[1] * u[3] + b[2] * u[0] + b[3] * u[1], b[0] * u[3] + b[1] * u[2] - b[2] * u[1] + b[3] * u[0]};
    for (int c = 0; c < 3; ++c) put(xs[c], moved[c]);
    for (int c = 0; c < 4; ++c) put(qs[c], turned[c]);
    for (int l = 0; l < rows; ++l) {
        for (int c = 0; c < 3; ++c) means_t.data[begin + l][c] = xs[c][l];
        for (int c = 0; c < 4; ++c) quats_t.data[begin + l][c] = qs[c][l];
    }
}
#endif
"""
)

_ADJOINT = (
    """
#if !defined(__CUDA_ARCH__)
{
    #pragma clang fp contract(fast)
"""
    + _PRELUDE
    + """
    const vi inside = number < 3 + H, scales = (number >= 11) & (number < 14);
    const int M = motion.shape[0];
    float* motion_sum = v_motion.data + (long long)chunk * M * 16;
    float* reach_sum = v_reach.data + (long long)chunk * M * 16;
    for (long long m = 0; m < M; ++m) { put(motion_sum + 16 * m, (vf){}); put(reach_sum + 16 * m, (vf){}); }
    const int end = (chunk + 1) * size < N ? (chunk + 1) * size : N;
    for (int begin = chunk * size; begin < end; begin += 16) {
        read(begin);
        // Gaussians that are not finite, and lanes past the end, pass nothing: they become zeros with zero weights.
        vf probe = x[0] * 0.0f + x[1] * 0.0f + x[2] * 0.0f + q[0] * 0.0f + q[1] * 0.0f + q[2] * 0.0f + q[3] * 0.0f;
        if (has_hyper) {
            float bad[16];
            for (int l = 0; l < 16; ++l) {
                bad[l] = 0.0f;
                for (int d = 0; d < H; ++d) bad[l] += point[l][3 + d] * 0.0f;
            }
            probe += load(bad);
        }
        const vi alive = (probe == 0.0f) & (number < rows);
        int live[16];
        __builtin_memcpy(live, &alive, sizeof(alive));
        vf v[3], v_turned[4], v_scales[16];
        for (int l = 0; l < 16; ++l) {
            long long g = l < rows ? begin + l : N - 1;
            #pragma clang loop vectorize(disable)
            for (int k = 0; k < K; ++k) weight[k][l] = weights.data[g * K + k];
            for (int c = 0; c < 3; ++c) xs[c][l] = v_means_t.data[g][c];
            for (int c = 0; c < 4; ++c) qs[c][l] = v_quats_t.data[g][c];
            v_scales[l] = (vf){};
            if (has_log_scales && live[l]) for (int c = 0; c < 3; ++c) v_scales[l][11 + c] = v_log_scales_t.data[g][c];
            if (!live[l]) points[l] = (vf){};
        }
        for (int k = 0; k < K; ++k) put(weight[k], alive ? load(weight[k]) : (vf){});
        for (int c = 0; c < 3; ++c) { x[c] = alive ? x[c] : (vf){}; v[c] = alive ? load(xs[c]) : (vf){}; }
        for (int c = 0; c < 4; ++c) { q[c] = alive ? q[c] : (vf){}; v_turned[c] = alive ? load(qs[c]) : (vf){}; }
        align();
        blend();
        const vf* B = motion_rows;
        vf nb = inverse_norm(B[12], B[13], B[14], B[15]), nq = inverse_norm(q[0], q[1], q[2], q[3]);
        vf b[4], u[4];
        for (int c = 0; c < 4; ++c) {
            vf identity = (vf){} + (c == 0 ? 1.0f : 0.0f);
            b[c] = nb > 0.0f ? B[12 + c] * nb : identity;
            u[c] = nq > 0.0f ? q[c] * nq : identity;
        }
        const vf* t = v_turned;
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
        vf v_x[3], gradient[16];
        for (int c = 0; c < 3; ++c) {
            v_x[c] = B[c] * v[0] + B[4 + c] * v[1] + B[8 + c] * v[2];
            for (int d = 0; d < 3; ++d) gradient[4 * c + d] = v[c] * x[d];
            gradient[4 * c + 3] = v[c];
        }
        for (int c = 0; c < 4; ++c) {
            v_u[c] = (v_u[c] - u[c] * along_u) * nq;
            gradient[12 + c] = (v_b[c] - b[c] * along_b) * nb;
        }
        transpose(gradient);  // row l: what Gaussian l's blended motion row receives
        vf v_weight[16], mean = (vf){};
        for (int k = 0; k < K; ++k) {
            vf products[16];
            for (int l = 0; l < 16; ++l) {
                const float* at = motion.data + 16ll * picked[k][l];
                vf g = (upper ? (vf){} + side[k][l] : (vf){} + 1.0f) * gradient[l];
                products[l] = g * load(at);
                if (has_log_scales)
                    products[l] += scales ? v_scales[l] * load(reach.data + 16ll * picked[k][l]) : (vf){};
                float* sum = motion_sum + 16ll * picked[k][l];
                *(vu*)sum = load(sum) + weight[k][l] * g;
            }
            v_weight[k] = row_sums(products);
            mean += load(weight[k]) * v_weight[k];
        }
        vf v_points[16];
        for (int l = 0; l < 16; ++l) v_points[l] = (vf){};
        for (int k = 0; k < K; ++k) {
            vf squares[16];
            float v_logit[16], d2[16];
            put(v_logit, load(weight[k]) * (v_weight[k] - mean));
            for (int l = 0; l < 16; ++l) {
                vf e = points[l] - load(reach.data + 16ll * picked[k][l]);
                squares[l] = inside ? e * e : (vf){};
            }
            put(d2, row_sums(squares));
            for (int l = 0; l < 16; ++l) {
                const float* at = reach.data + 16ll * picked[k][l];
                float* sum = reach_sum + 16ll * picked[k][l];
                vf add = weight[k][l] * v_scales[l];
                if (v_logit[l] != 0.0f) {
                    vf e = inside ? points[l] - load(at) : (vf){};
                    v_points[l] += (2.0f * at[14] * v_logit[l]) * e;
                    e[14] = d2[l]; e[15] = 1.0f;
                    add += v_logit[l] * e;
                }
                *(vu*)sum = load(sum) + add;
            }
        }
        for (int c = 0; c < 3; ++c) put(xs[c], v_x[c]);
        for (int c = 0; c < 4; ++c) put(qs[c], v_u[c]);
        for (int l = 0; l < 16; ++l) put(point[l], v_points[l]);
        for (int l = 0; l < rows; ++l) {
            long long g = begin + l;
            for (int c = 0; c < 3; ++c) v_means.data[g][c] = xs[c][l] + point[l][c];
            for (int c = 0; c < 4; ++c) v_quats.data[g][c] = qs[c][l];
            for (int d = 0; d < H; ++d) v_hyper.data[g * H + d] = point[l][3 + d];
        }
    }
}
#endif
"""
)


@wp.func_native(_FORWARD)
def _skin_lanes(
    begin: int, means: wp.array[wp.vec3], quats: wp.array[wp.vec4], hyper: wp.array2d[float], has_hyper: int,
    motion: wp.array2d[float], reach: wp.array2d[float], has_log_scales: int, indices: wp.array2d[wp.int32],
    weights: wp.array2d[float], means_t: wp.array[wp.vec3], quats_t: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
): ...  # fmt: skip


@wp.func_native(_ADJOINT)
def _skin_lanes_adjoint(
    chunk: int, size: int, means: wp.array[wp.vec3], quats: wp.array[wp.vec4], hyper: wp.array2d[float],
    has_hyper: int, motion: wp.array2d[float], reach: wp.array2d[float], has_log_scales: int,
    indices: wp.array2d[wp.int32], weights: wp.array2d[float], v_means_t: wp.array[wp.vec3],
    v_quats_t: wp.array[wp.vec4], v_log_scales_t: wp.array[wp.vec3], v_means: wp.array[wp.vec3],
    v_quats: wp.array[wp.vec4], v_hyper: wp.array2d[float], v_motion: wp.array2d[float], v_reach: wp.array2d[float],
): ...  # fmt: skip


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
    _skin_lanes(
        begin, means_in, quats_in, hyper_in, has_hyper, motion_in, reach_in, has_log_scales, indices_in,
        weights_out, means_out, quats_out, log_scales_out,
    )  # fmt: skip


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
    v_reach_out: wp.array2d[float],  # [chunks * M, 16]: v e, w v_log_scales, v d^2, v of the exponents
):
    """One chunk of Gaussians: their gradients, and their sums for every node."""
    chunk = first + wp.tid()
    _skin_lanes_adjoint(
        chunk, size, means_in, quats_in, hyper_in, has_hyper, motion_in, reach_in, has_log_scales, indices_in,
        weights_in, v_means_in, v_quats_in, v_log_scales_in, v_means_out, v_quats_out, v_hyper_out, v_motion_out,
        v_reach_out,
    )  # fmt: skip
