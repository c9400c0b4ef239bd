"""Photometric loss in SIMD for the CPU: one grid index a band of rows of one channel. Same meaning as ``ssim``.

A band is walked downwards. Each row is blurred horizontally into a ring of 11 rows, which stays in the first-level
cache; as soon as the ring is full the row in its middle is blurred vertically and finished. A register holds 16
neighbouring pixels (Clang's vector types, which every instruction set implements as well as it can).
"""

from __future__ import annotations

import warp as wp

from ..ssim import C1, C2, TAPS

wp.set_module_options({"enable_backward": False})

BAND = 64
"""Rows a grid index of the SIMD form computes; 10 more rows are blurred horizontally per band."""
BLOCK = 128
"""Columns worked on at once: 4 maps x 11 rows x 128 columns are 22 KiB."""

_SHARED = f"""
#if !defined(__CUDA_ARCH__)
    #pragma clang fp contract(fast)  // Warp's default for the CPU is off: no fused multiply-add
    typedef float lanes __attribute__((vector_size(64), aligned(4), may_alias));
    typedef int truths __attribute__((vector_size(64), aligned(4), may_alias));
    typedef unsigned char bytes __attribute__((vector_size(16), aligned(1), may_alias));
    const float w[6] = {{{", ".join(f"{tap:.9e}f" for tap in TAPS)}}};
    const int height = image.shape[1], width = image.shape[2];
    const int bands = (height + {BAND - 1}) / {BAND};
    const int channel = index / bands;
    const int top = (index % bands) * {BAND};
    const int bottom = top + {BAND} < height ? top + {BAND} : height;
    const size_t plane = size_t(height) * width;
    const float* image_plane = image.data + channel * plane;
    const float* truth_plane = truth.data + channel * plane;
    const bool* valid_plane = mask.data;
    // Blocks of about equal width, whole vectors except at the right edge.
    const int blocks = (width + {BLOCK - 1}) / {BLOCK};
    const int block = ((width + blocks - 1) / blocks + 15) / 16 * 16;
"""


def _shifted(first: str, second: str, start: int) -> str:
    """16 neighbours of the 32 in two vectors, from ``start`` on."""
    return f"__builtin_shufflevector({first}, {second}, {', '.join(str(start + k) for k in range(16))})"


# Of the vector before the last one; shifts in registers, as a load from two cache lines costs as much as two.
_BLUR_ROW = (
    """
                    if (v >= 2)
                        for (int map = 0; map < MAPS; ++map) {
                            const lanes before = past[0][map], middle = past[1][map], after = fresh[map];
                            lanes sum = w[0] * middle;
"""
    + "".join(
        f"sum += w[{k}] * ({_shifted('before', 'middle', 16 - k)} + {_shifted('middle', 'after', k)});\n"
        for k in range(1, 6)
    )
    + """
                            *(lanes*)(ring[map][slot] + 16 * (v - 2)) = sum;
                        }
                    for (int map = 0; map < MAPS; ++map) {
                        past[0][map] = past[1][map];
                        past[1][map] = fresh[map];
                    }
"""
)

_BLUR_COLUMN = """
                    lanes blurred[MAPS];
                    #pragma unroll
                    for (int map = 0; map < MAPS; ++map) {
                        const float* at = ring[map][0] + 16 * v;
                        lanes sum = w[0] * *(const lanes*)(at + order[5]);
                        #pragma unroll
                        for (int k = 1; k < 6; ++k)
                            sum += w[k] * (*(const lanes*)(at + order[5 - k]) + *(const lanes*)(at + order[5 + k]));
                        blurred[map] = sum;
                    }
"""

# The walk down a band: ROW is blurred into the ring, then the row five above it is complete and RESULT uses it.
_WALK = f"""
    alignas(64) float ring[MAPS][11][{BLOCK}];
    for (int left = 0; left < width; left += block) {{
        const int columns = left + block < width ? block : width - left;
        const int vectors = (columns + 15) / 16;
        for (int row = top - 5; row < bottom + 5; ++row) {{
            const int slot = (row - top + 5) % 11;
            if (row < 0 || row >= height) {{
                for (int map = 0; map < MAPS; ++map)
                    for (int v = 0; v < vectors; ++v) *(lanes*)(ring[map][slot] + 16 * v) = lanes{{}};
            }} else {{
                lanes past[2][MAPS];
                for (int v = 0; v < vectors + 2; ++v) {{
                    const int column = left - 16 + 16 * v;
                    const size_t at = size_t(row) * width + column;
                    const bool whole = column >= 0 && column + 16 <= width;
                    lanes fresh[MAPS] = {{}};
                    if (column > -16 && column < width) {{
                        ROW
                    }}
                    {_BLUR_ROW}
                }}
            }}
            const int out = row - 5;
            if (out < top) continue;
            int order[11];  // offset of row ``out - 5 + k`` in the ring
            for (int k = 0; k < 11; ++k) order[k] = (slot + 1 + k) % 11 * {BLOCK};
            RESULT_BEGIN
            for (int v = 0; v < vectors; ++v) {{
                {_BLUR_COLUMN}
                const int column = left + 16 * v;
                const size_t at = size_t(out) * width + column;
                const int count = column + 16 <= width ? 16 : width - column;
                RESULT
            }}
            RESULT_END
        }}
    }}
#endif
"""

_LOAD_PAIR = """
                lanes x = {}, y = {};
                truths valid = {};
                if (COUNT == 16) {
                    x = *(const lanes*)(image_plane + at);
                    y = *(const lanes*)(truth_plane + at);
                    valid = ~valid;
                } else
                    for (int k = 0; k < 16; ++k)
                        if (column + k >= 0 && column + k < width) {
                            x[k] = image_plane[at + k];
                            y[k] = truth_plane[at + k];
                            valid[k] = -1;
                        }
                if (valid_plane) {
                    if (COUNT == 16)
                        valid = __builtin_convertvector(*(const bytes*)(valid_plane + at), truths) != truths{};
                    else
                        for (int k = 0; k < 16; ++k)
                            if (column + k >= 0 && column + k < width && !valid_plane[at + k]) valid[k] = 0;
                    x = valid ? x : y;
                }
"""

_FORWARD_ROW = (
    _LOAD_PAIR.replace("COUNT == 16", "whole")
    + """
                fresh[0] = x;
                fresh[1] = y;
                fresh[2] = x * x + y * y;
                fresh[3] = x * y;
"""
)

_FORWARD_RESULT = (
    _LOAD_PAIR.replace("COUNT == 16", "count == 16")
    + f"""
                const lanes zero = {{}};
                const lanes cross = blurred[0] * blurred[1];
                const lanes squares = blurred[0] * blurred[0] + blurred[1] * blurred[1];
                const lanes a1 = 2.0f * cross + {C1:.9e}f;
                const lanes a2 = 2.0f * (blurred[3] - cross) + {C2:.9e}f;
                const lanes b1 = squares + {C1:.9e}f;
                const lanes b2 = blurred[2] - squares + {C2:.9e}f;
                const lanes inverse = 1.0f / (b1 * b2);
                const lanes ssim = a1 * a2 * inverse;
                const lanes difference = x - y;
                l1_sum += valid ? (difference < zero ? -difference : difference) : zero;
                ssim_sum += valid ? ssim : zero;
                if (partials.data) {{
                    lanes partial[3] = {{
                        2.0f * inverse * (blurred[1] * (a2 - a1) + blurred[0] * ssim * (b1 - b2)),
                        -ssim * inverse * b1,
                        2.0f * a1 * inverse,
                    }};
                    for (int j = 0; j < 3; ++j) {{
                        partial[j] = valid ? partial[j] : zero;
                        float* to = partials.data + (j * size_t(image.shape[0]) + channel) * plane + at;
                        if (count == 16)
                            *(lanes*)to = partial[j];
                        else
                            for (int k = 0; k < count; ++k) to[k] = partial[j][k];
                    }}
                }}
"""
)

_FORWARD_END = """
            float* l1_to = sums.data + channel * size_t(height) + out;
            float* ssim_to = l1_to + size_t(image.shape[0]) * height;
            float l1_total = left == 0 ? 0.0f : *l1_to, ssim_total = left == 0 ? 0.0f : *ssim_to;
            for (int k = 0; k < 16; ++k) {
                l1_total += l1_sum[k];
                ssim_total += ssim_sum[k];
            }
            *l1_to = l1_total;
            *ssim_to = ssim_total;
"""

_ADJOINT_ROW = """
                for (int j = 0; j < 3; ++j) {
                    const float* from = partials.data + (j * size_t(image.shape[0]) + channel) * plane + at;
                    lanes value = {};
                    if (whole)
                        value = *(const lanes*)from;
                    else
                        for (int k = 0; k < 16; ++k)
                            if (column + k >= 0 && column + k < width) value[k] = from[k];
                    fresh[j] = value;
                }
"""

_ADJOINT_RESULT = (
    _LOAD_PAIR.replace("COUNT == 16", "count == 16")
    + """
                const lanes zero = {}, one = zero + 1.0f;
                const lanes slope = x > y ? one : (x < y ? -one : zero);
                lanes gradient = v_sums.data[0] * slope
                    + v_sums.data[1] * (blurred[0] + 2.0f * x * blurred[1] + y * blurred[2]);
                gradient = valid ? gradient : zero;
                float* to = v_image.data + channel * plane + at;
                if (count == 16)
                    *(lanes*)to = gradient;
                else
                    for (int k = 0; k < count; ++k) to[k] = gradient[k];
"""
)


def _walk(maps: int, row: str, result: str, begin: str = "", end: str = "") -> str:
    walk = _WALK.replace("RESULT_BEGIN", begin).replace("RESULT_END", end).replace("RESULT", result)
    return _SHARED + walk.replace("ROW", row).replace("MAPS", str(maps))


@wp.func_native(_walk(4, _FORWARD_ROW, _FORWARD_RESULT, "lanes l1_sum = {}, ssim_sum = {};", _FORWARD_END))
def _band(
    index: int,
    image: wp.array3d[float],
    truth: wp.array3d[float],
    mask: wp.array2d[bool],
    sums: wp.array3d[float],
    partials: wp.array4d[float],
): ...


@wp.func_native(_walk(3, _ADJOINT_ROW, _ADJOINT_RESULT))
def _band_adjoint(
    index: int,
    image: wp.array3d[float],
    truth: wp.array3d[float],
    mask: wp.array2d[bool],
    partials: wp.array4d[float],
    v_sums: wp.array[float],
    v_image: wp.array3d[float],
): ...


@wp.kernel
def photometric_bands(
    first: int,
    # In:
    image_in: wp.array3d[float],  # [C, H, W]
    truth_in: wp.array3d[float],  # [C, H, W]
    mask_in: wp.array2d[bool],  # [H, W], or null: every pixel is valid
    # Out:
    sums_out: wp.array3d[float],  # [2, C, H] of |x - y| and of SSIM along rows
    partials_out: wp.array4d[float],  # [3, C, H, W] of SSIM to blurred x, x^2 + y^2, x y; or null
):
    """Row sums and partial derivatives of a band of one channel. Grid: C x ceil(H / BAND). CPU only."""
    _band(first + wp.tid(), image_in, truth_in, mask_in, sums_out, partials_out)


@wp.kernel
def photometric_bands_adjoint(
    first: int,
    # In:
    image_in: wp.array3d[float],  # [C, H, W]
    truth_in: wp.array3d[float],  # [C, H, W]
    mask_in: wp.array2d[bool],  # [H, W], or null: every pixel is valid
    partials_in: wp.array4d[float],  # [3, C, H, W]
    v_sums_in: wp.array[float],  # [2] of the loss to the sums of L1 and of SSIM
    # Out:
    v_image_out: wp.array3d[float],  # [C, H, W]
):
    """Gradient of a band of one channel of the image. Grid: C x ceil(H / BAND). CPU only."""
    _band_adjoint(first + wp.tid(), image_in, truth_in, mask_in, partials_in, v_sums_in, v_image_out)
