"""``harmonics`` on a CPU: 16 Gaussians at a time, their coefficients read and written as whole registers.

A Gaussian's 45 coefficients are 15 triples of red, green, blue. They pass through registers of 15 (the 16th lane is
left over), so that a lane always belongs to the same channel; the basis is computed for 16 Gaussians in lanes and then
turned so that each Gaussian has its own in a register.
"""

from __future__ import annotations

import warp as wp

from .. import harmonics
from ..types import GRADIENT_MAX
from .skinning_layout import SIMD

wp.set_module_options({"enable_backward": False})

LANES = 16

_CONSTANTS = ", ".join(
    f"{name} = {float(getattr(harmonics, name))!r}f"
    for name in ("C0", "C1", "C2", "C20", "C22", "C33", "C32", "C31", "C30", "C3Z")
)

_PRELUDE = f"""
#if !defined(__CUDA_ARCH__)
    {SIMD}
    const float {_CONSTANTS}, GRADIENT_MAX = {float(GRADIENT_MAX)!r}f;
    const vf ZERO = {{}};
    const int total = means.shape.dims[0], n = total - begin < 16 ? total - begin : 16;
    const int used = degree == 0 ? 0 : degree == 1 ? 9 : degree == 2 ? 24 : 45;  // floats of a Gaussian's coefficients
    const int row = 3 * rest;
    const long long size = (long long)total * row;
    auto read3 = [&](const void* data, vf* to) INLINE {{
        float spare[48] = {{}};
        const float* from = (const float*)data + 3ll * begin;
        if (n < 16) {{ __builtin_memcpy(spare, from, 12 * n); from = spare; }}
        const vf a[3] = {{load(from), load(from + 16), load(from + 32)}};
        split3(a, to);
    }};
    auto write3 = [&](void* data, const vf* from) INLINE {{
        vf a[3];
        join3(from, a);
        __builtin_memcpy((float*)data + 3ll * begin, a, 12 * n);
    }};
    // 16 floats of a Gaussian's coefficients; what lies behind the array's end is zero.
    auto coefficients = [&](int lane, int offset) INLINE -> vf {{
        const long long at = (long long)(begin + lane) * row + offset;
        const float* from = (const float*)sh_rest.data + at;
        if (at + 16 <= size) return load(from);
        float spare[16] = {{}};
        for (int k = 0; at + k < size; ++k) spare[k] = from[k];
        return load(spare);
    }};
    // The coefficients' factors of basis function 5 v + (lane / 3).
    auto triples = [](vf b, int v) INLINE -> vf {{
        if (v == 0) return __builtin_shufflevector(b, b, 0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4, 15);
        if (v == 1) return __builtin_shufflevector(b, b, 5, 5, 5, 6, 6, 6, 7, 7, 7, 8, 8, 8, 9, 9, 9, 15);
        return __builtin_shufflevector(b, b, 10, 10, 10, 11, 11, 11, 12, 12, 12, 13, 13, 13, 14, 14, 14, 15);
    }};
    vf mean[3], basis[16];
    read3(means.data, mean);
    const vf ox = mean[0] - camera.data[0][0], oy = mean[1] - camera.data[0][1], oz = mean[2] - camera.data[0][2];
    const vf squared = ox * ox + oy * oy + oz * oz;
    const vf inverse = ((squared > 0.0f) & (squared < infinity)) ? 1.0f / __builtin_elementwise_sqrt(squared) : ZERO;
    const vi seen = inverse > 0.0f;
    const vf x = seen ? inverse * ox : ZERO, y = seen ? inverse * oy : ZERO, z = seen ? inverse * oz : ZERO;
    const vf xx = x * x, yy = y * y, zz = z * z;
    basis[0] = -C1 * y; basis[1] = C1 * z; basis[2] = -C1 * x;
    basis[3] = C2 * x * y; basis[4] = -C2 * y * z; basis[5] = C20 * (3.0f * zz - 1.0f); basis[6] = -C2 * x * z;
    basis[7] = C22 * (xx - yy);
    basis[8] = C33 * y * (yy - 3.0f * xx); basis[9] = C32 * x * y * z; basis[10] = C31 * y * (1.0f - 5.0f * zz);
    basis[11] = C30 * z * (5.0f * zz - 3.0f); basis[12] = C31 * x * (1.0f - 5.0f * zz); basis[13] = C3Z * z * (xx - yy);
    basis[14] = C33 * x * (3.0f * yy - xx); basis[15] = ZERO;
"""

_FORWARD = (
    _PRELUDE
    + """
    vf color[3], sums[16];
    read3(sh_dc.data, color);
    for (int c = 0; c < 3; ++c) color[c] = C0 * color[c] + 0.5f;
    if (used) {
        transpose(basis);
        for (int l = 0; l < 16; ++l) {
            sums[l] = ZERO;
            if (l >= n) continue;
            for (int v = 0; 15 * v < used; ++v) {
                const vf product = triples(basis[l], v) * coefficients(l, 15 * v);
                sums[l] += number < used - 15 * v ? product : ZERO;
            }
        }
        transpose(sums);
        for (int c = 0; c < 3; ++c) color[c] += sums[c] + sums[3 + c] + sums[6 + c] + sums[9 + c] + sums[12 + c];
    }
    for (int c = 0; c < 3; ++c) color[c] = color[c] > 0.0f ? color[c] : color[c] - color[c];  // 0; NaN stays NaN
    write3(colors.data, color);
#endif
"""
)

_ADJOINT = (
    _PRELUDE
    + """
    vf color[3], v[16] = {}, v_dc[3], v_mean[3];
    read3(colors.data, color);
    read3(v_colors.data, v);
    for (int c = 0; c < 3; ++c) {
        v[c] = ((color[c] > 0.0f) & (color[c] < infinity)) ? v[c] : ZERO;
        v_dc[c] = C0 * v[c];
    }
    write3(v_sh_dc.data, v_dc);
    // Culled or clamped: its coefficients count for nothing, and a NaN among them stays there.
    const vi live = (v[0] != 0.0f) | (v[1] != 0.0f) | (v[2] != 0.0f);
    int alive[16];
    __builtin_memcpy(alive, &live, sizeof(alive));
    vf turned[16], products[3][16] = {};
    for (int k = 0; k < 16; ++k) turned[k] = basis[k];
    transpose(turned);
    transpose(v);  // row l: the three gradients of Gaussian l
    for (int l = 0; l < n; ++l) {
        const vf channel = __builtin_shufflevector(v[l], v[l], 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2, 15);
        float* to = has_rest ? (float*)v_sh_rest.data + (long long)(begin + l) * row : nullptr;
        for (int at = 0, k = 0; at < row; at += 15, ++k) {
            const int count = row - at < 15 ? row - at : 15;
            vf value = ZERO;
            if (alive[l] && at < used) {
                value = number < used - at ? triples(turned[l], k) * channel : ZERO;
                if (has_means) products[k][l] = number < used - at ? coefficients(l, at) * channel : ZERO;
            }
            if (!has_rest) continue;
            if (count == 15) __builtin_memcpy(to + at, &value, 60);
            else __builtin_memcpy(to + at, &value, 4 * count);
        }
    }
    if (!has_means) return;
    vf s[15];
    for (int k = 0; k < 3; ++k) {
        if (15 * k < used) transpose(products[k]);
        for (int j = 0; j < 5; ++j) s[5 * k + j] = products[k][3 * j] + products[k][3 * j + 1] + products[k][3 * j + 2];
    }
    const vf s4 = C2 * s[3], s5 = C2 * s[4], s6 = 6.0f * C20 * s[5], s7 = C2 * s[6], s8 = 2.0f * C22 * s[7];
    const vf s9 = 3.0f * C33 * s[8], s10 = C32 * s[9], s11 = C31 * s[10], s12 = 3.0f * C30 * s[11], s13 = C31 * s[12];
    const vf s14 = C3Z * s[13], s15 = 3.0f * C33 * s[14];
    const vf gx = -C1 * s[2] + s4 * y - s7 * z + s8 * x - 2.0f * s9 * x * y + s10 * y * z + s13 * (1.0f - 5.0f * zz)
        + 2.0f * s14 * x * z + s15 * (yy - xx);
    const vf gy = -C1 * s[0] + s4 * x - s5 * z - s8 * y + s9 * (yy - xx) + s10 * x * z + s11 * (1.0f - 5.0f * zz)
        - 2.0f * s14 * y * z + 2.0f * s15 * x * y;
    const vf gz = C1 * s[1] + s6 * z - s5 * y - s7 * x + s10 * x * y - 10.0f * z * (s11 * y + s13 * x)
        + s12 * (5.0f * zz - 1.0f) + s14 * (xx - yy);
    // The direction is normalised: only what is perpendicular to it moves it.
    const vf along = gx * x + gy * y + gz * z;
    v_mean[0] = live ? inverse * (gx - along * x) : ZERO;
    v_mean[1] = live ? inverse * (gy - along * y) : ZERO;
    v_mean[2] = live ? inverse * (gz - along * z) : ZERO;
    auto usable = [&](vf v) INLINE -> vi { return __builtin_elementwise_abs(v) <= GRADIENT_MAX; };
    const vi whole = usable(v_mean[0]) & usable(v_mean[1]) & usable(v_mean[2]);  // else it overflows: none
    for (int c = 0; c < 3; ++c) v_mean[c] = whole ? v_mean[c] : ZERO;
    write3(v_means.data, v_mean);
#endif
"""
)


# fmt: off
@wp.func_native(_FORWARD)
def _harmonics(
    begin: int, sh_dc: wp.array[wp.vec3], sh_rest: wp.array[wp.vec3], rest: int, means: wp.array[wp.vec3],
    camera: wp.array[wp.vec3], degree: int, colors: wp.array[wp.vec3],
): ...


@wp.func_native(_ADJOINT)
def _harmonics_adjoint(
    begin: int, sh_rest: wp.array[wp.vec3], rest: int, means: wp.array[wp.vec3], camera: wp.array[wp.vec3],
    degree: int, colors: wp.array[wp.vec3], v_colors: wp.array[wp.vec3], has_rest: int, has_means: int,
    v_sh_dc: wp.array[wp.vec3], v_sh_rest: wp.array[wp.vec3], v_means: wp.array[wp.vec3],
): ...
# fmt: on


@wp.kernel
def spherical_harmonics_lanes(
    first: int,
    # In:
    sh_dc_in: wp.array[wp.vec3],  # [N]
    sh_rest_in: wp.array[wp.vec3],  # [N * R]
    rest: int,  # R
    means_in: wp.array[wp.vec3],  # [N]
    camera_in: wp.array[wp.vec3],  # [1] centre of projection
    degree: int,
    # Out:
    colors_out: wp.array[wp.vec3],  # [N] >= 0, or not finite where a coefficient is not
):
    """Gaussians ``16 i .. 16 i + 15``."""
    _harmonics((first + wp.tid()) * LANES, sh_dc_in, sh_rest_in, rest, means_in, camera_in, degree, colors_out)


@wp.kernel
def spherical_harmonics_lanes_adjoint(
    first: int,
    # In:
    sh_rest_in: wp.array[wp.vec3],  # [N * R]
    rest: int,  # R
    means_in: wp.array[wp.vec3],  # [N]
    camera_in: wp.array[wp.vec3],  # [1]
    degree: int,
    colors_in: wp.array[wp.vec3],  # [N] of the forward pass: 0 where clamped
    v_colors_in: wp.array[wp.vec3],  # [N]
    has_rest: int,  # whether v_sh_rest_out is wanted
    has_means: int,  # whether v_means_out is wanted
    # Out:
    v_sh_dc_out: wp.array[wp.vec3],  # [N]
    v_sh_rest_out: wp.array[wp.vec3],  # [N * R]
    v_means_out: wp.array[wp.vec3],  # [N]; the camera's is minus their sum
):
    """Gaussians ``16 i .. 16 i + 15``."""
    _harmonics_adjoint(
        (first + wp.tid()) * LANES, sh_rest_in, rest, means_in, camera_in, degree, colors_in, v_colors_in, has_rest,
        has_means, v_sh_dc_out, v_sh_rest_out, v_means_out,
    )  # fmt: skip
