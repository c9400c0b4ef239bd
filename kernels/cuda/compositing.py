"""Alpha compositing on CUDA: one block of 256 threads a tile of 16 x 16, one thread a pixel, native bodies.

Same meaning as ``compositing``, the readable truth. How the work is laid out:

- A warp holds 8 x 4 pixels. Splats are staged through shared memory in batches; whoever stages one finds which of the
  tile's eight such parts its ellipse may reach, and each warp walks only its own splats, by the bits of a ballot.
- In base 2: ``alpha = o 2^power``, where ``power = -q / (2 ln 2)`` has its factor folded into the staged conic.
- The adjoint adds a warp's 16 sums of a pair (the columns of a slot) up in 16 shuffles, each of which halves what a
  lane is left with, instead of 5 a sum. The partial sums of the eight warps meet in shared memory, 32 pairs at a time,
  and are added in the order of the warps into the pair's own slot: no atomics, the same bits every time.

On a CPU the bodies are empty; tests compile them with a shim that runs a block's threads as fibres.
"""

from __future__ import annotations

import warp as wp

from ..types import ALPHA_MAX, ALPHA_MIN, SLOT_GEOMETRY, TILE_SIZE, TRANSMITTANCE_MIN
from .slots import SLOT_WIDTH

wp.set_module_options({"enable_backward": False})

BLOCK_DIM = TILE_SIZE * TILE_SIZE
MAX_CHANNELS = SLOT_WIDTH - SLOT_GEOMETRY
"""Channels that fit a slot; the forward pass has no such bound."""

_BOUNDS = (BLOCK_DIM, 4)
"""Four blocks a multiprocessor: 64 registers a thread, of which next to nothing is spilled."""

_PLACE = """
    const unsigned ALL = 0xffffffffu;
    const int thread = threadIdx.x, lane = thread & 31, warp = thread >> 5;
    const int corner_x = (tile % columns) * 16, corner_y = (tile / columns) * 16;
    const int x = corner_x + (warp & 1) * 8 + (lane & 7);
    const int y = corner_y + (warp >> 1) * 4 + (lane >> 3);
    const bool inside = x < width && y < height;
    const float centre_x = x + 0.5f, centre_y = y + 0.5f;
    const long long plane = (long long)width * height, pixel = (long long)y * width + x;
    const int begin = ((const int*)ranges.data)[2 * tile], end = ((const int*)ranges.data)[2 * tile + 1];
    const float* means = (const float*)means2d.data;
    const float* all_conics = (const float*)conics.data;

    // The parts (a bit each, in the order of the warps) where alpha may be 1/255 or more; rather one too many.
    auto parts_of = [&](float mx, float my, float a, float b, float c, float opacity) -> unsigned {
        if (!(opacity >= ALPHA_MIN)) return 0u;
        const float squared = b * b;  // a c - b b, exact to the last bit: of a needle's little else is left
        const float determinant = fmaf(a, c, -squared) + fmaf(-b, b, squared);
        if (!(determinant > 0.0f)) return 255u;
        const float reach = fmaxf(2.0f * logf(opacity * 255.0f), 0.0f) + 1.0e-3f;
        const float half_width = 1.0001f * sqrtf(reach * c / determinant) + 0.01f;
        const float half_height = 1.0001f * sqrtf(reach * a / determinant) + 0.01f;
        unsigned parts = 0u;
        for (int part = 0; part < 8; ++part) {
            const float left = corner_x + (part & 1) * 8 + 0.5f, top = corner_y + (part >> 1) * 4 + 0.5f;
            const bool beside = mx + half_width < left || mx - half_width > left + 7.0f;
            const bool above = my + half_height < top || my - half_height > top + 3.0f;
            if (!beside && !above) parts |= 1u << part;
        }
        return parts;
    };
"""

_FORWARD = """
#if defined(__CUDA_ARCH__)
    __shared__ float4 shape[256];  // mean, then the first two of the scaled conic
    __shared__ float4 rest[256];  // its third, the opacity
    __shared__ float4 color[256];
    __shared__ unsigned reached[256];
    PLACE
    const int count = image.shape.dims[0], stride = channels.shape.dims[1];

    for (int base = 0; base < count; base += 4) {
        float sum[4] = {0.0f, 0.0f, 0.0f, 0.0f};
        float transmittance = 1.0f;
        int last = 0;
        bool open = inside;
        for (int at = begin; at < end; at += 256) {
            // Also the barrier after which nobody reads the batch before.
            if (__syncthreads_count(open) == 0) break;
            unsigned parts = 0u;
            if (at + thread < end) {
                const int i = splats.data[at + thread];
                const float mx = means[2 * i], my = means[2 * i + 1], opacity = opacities.data[i];
                const float a = all_conics[3 * i], b = all_conics[3 * i + 1], c = all_conics[3 * i + 2];
                const float* own = channels.data + (long long)i * stride + base;
                const int rest_of = count - base;
                parts = parts_of(mx, my, a, b, c, opacity);
                shape[thread] = make_float4(mx, my, -0.5f * LOG2_E * a, -LOG2_E * b);
                rest[thread] = make_float4(-0.5f * LOG2_E * c, opacity, 0.0f, 0.0f);
                color[thread] = make_float4(own[0], rest_of > 1 ? own[1] : 0.0f, rest_of > 2 ? own[2] : 0.0f,
                    rest_of > 3 ? own[3] : 0.0f);
            }
            reached[thread] = parts;
            __syncthreads();
            for (int word = 0; word < 8; ++word) {
                unsigned left = __ballot_sync(ALL, (reached[32 * word + lane] >> warp) & 1u);
                if (!__any_sync(ALL, open)) break;
                while (left) {
                    const int j = 32 * word + __ffs(left) - 1;
                    left &= left - 1u;
                    const float4 s = shape[j];
                    const float4 r = rest[j];
                    const float dx = centre_x - s.x, dy = centre_y - s.y;
                    const float power = dx * (s.z * dx + s.w * dy) + r.x * dy * dy;
                    const float alpha = fminf(ALPHA_MAX, r.y * exp2f(power));
                    if (open && power <= 0.0f && alpha >= ALPHA_MIN) {
                        const float remaining = transmittance * (1.0f - alpha);
                        if (remaining <= TRANSMITTANCE_MIN) {
                            open = false;
                        } else {
                            const float weight = alpha * transmittance;
                            const float4 c = color[j];
                            sum[0] += c.x * weight;
                            sum[1] += c.y * weight;
                            sum[2] += c.z * weight;
                            sum[3] += c.w * weight;
                            transmittance = remaining;
                            last = at + j + 1;
                        }
                    }
                }
            }
        }
        if (inside) {
            for (int c = 0; c < 4; ++c)
                if (base + c < count)
                    image.data[(base + c) * plane + pixel] = sum[c] + background.data[base + c] * transmittance;
            alpha_image.data[pixel] = 1.0f - transmittance;
            if (last_image.data) {
                transmittance_image.data[pixel] = transmittance;
                last_image.data[pixel] = last;
            }
        }
        __syncthreads();
    }
#endif
"""

_ADJOINT = """
#if defined(__CUDA_ARCH__)
    __shared__ float4 shape[128];
    __shared__ float4 rest[128];
    __shared__ float color[128][8];
    __shared__ unsigned reached[128];
    __shared__ int slot_of[128];
    __shared__ float partial[8][32][16];  // of each warp: the sums of each pair it hit
    __shared__ unsigned hits[8];
    __shared__ int deepest[8];
    PLACE
    const int count = channels.shape.dims[1];
    float transmittance = 1.0f, behind = 0.0f, v_pixel[8];
    int last = 0;
    for (int c = 0; c < 8; ++c) v_pixel[c] = inside && c < count ? v_image.data[c * plane + pixel] : 0.0f;
    if (inside) {
        last = last_image.data[pixel];
        transmittance = transmittance_image.data[pixel];
        behind = -v_alpha.data[pixel];  // what lies behind the current splat, weighted by v_image
        for (int c = 0; c < 8; ++c)
            if (c < count) behind += v_pixel[c] * background.data[c];
        behind *= transmittance;
    }
    int warp_last = last;
    for (int step = 16; step > 0; step >>= 1) {
        const int other = __shfl_xor_sync(ALL, warp_last, step);
        warp_last = other > warp_last ? other : warp_last;
    }
    if (lane == 0) deepest[warp] = warp_last;
    __syncthreads();
    int stop = begin;
    for (int w = 0; w < 8; ++w) stop = deepest[w] > stop ? deepest[w] : stop;
    for (int p = stop + (thread >> 4); p < end; p += 16)  // pairs that no pixel used
        v_slots.data[(long long)slots.data[p] * 16 + (thread & 15)] = 0.0f;

    for (; stop > begin; stop -= 128) {
        const int start = stop - 128 > begin ? stop - 128 : begin, size = stop - start;
        if (thread < 128) {
            unsigned parts = 0u;
            if (thread < size) {
                const int i = splats.data[start + thread];
                const float mx = means[2 * i], my = means[2 * i + 1], opacity = opacities.data[i];
                const float a = all_conics[3 * i], b = all_conics[3 * i + 1], c = all_conics[3 * i + 2];
                parts = parts_of(mx, my, a, b, c, opacity);
                shape[thread] = make_float4(mx, my, -0.5f * LOG2_E * a, -LOG2_E * b);
                rest[thread] = make_float4(-0.5f * LOG2_E * c, opacity, 0.0f, 0.0f);
                slot_of[thread] = slots.data[start + thread];
                for (int k = 0; k < 8; ++k)
                    color[thread][k] = k < count ? channels.data[(long long)i * count + k] : 0.0f;
            }
            reached[thread] = parts;
        }
        __syncthreads();
        for (int group = (size - 1) >> 5; group >= 0; --group) {
            unsigned left = __ballot_sync(ALL, (reached[32 * group + lane] >> warp) & 1u);
            const int over = start + 32 * group + 32 - warp_last;  // pairs behind the last that this warp used
            if (over > 0) left = over >= 32 ? 0u : left & (ALL >> over);
            unsigned hit = 0u;
            while (left) {
                const int bit = 31 - __clz(left), j = 32 * group + bit;
                left ^= 1u << bit;
                const float4 s = shape[j];
                const float4 r = rest[j];
                const float dx = centre_x - s.x, dy = centre_y - s.y;
                const float power = dx * (s.z * dx + s.w * dy) + r.x * dy * dy;
                const float falloff = exp2f(power), raw = r.y * falloff;
                const float alpha = fminf(ALPHA_MAX, raw);
                const bool valid = start + j < last && power <= 0.0f && alpha >= ALPHA_MIN;
                if (!__any_sync(ALL, valid)) continue;
                hit |= 1u << bit;
                float v[16];
                #pragma unroll
                for (int k = 0; k < 16; ++k) v[k] = 0.0f;
                if (valid) {
                    const float inverse = __fdividef(1.0f, 1.0f - alpha);
                    transmittance *= inverse;
                    const float weight = alpha * transmittance;
                    float seen = 0.0f;
                    #pragma unroll
                    for (int c = 0; c < 8; ++c) {
                        seen += color[j][c] * v_pixel[c];
                        v[8 + c] = weight * v_pixel[c];
                    }
                    const float v_alpha_here = seen * transmittance - behind * inverse;
                    behind += seen * weight;
                    if (raw <= ALPHA_MAX) {
                        const float g = v_alpha_here * raw;  // gradient to -q / 2
                        v[0] = -LN_2 * g * (2.0f * s.z * dx + s.w * dy);
                        v[1] = -LN_2 * g * (s.w * dx + 2.0f * r.x * dy);
                        v[2] = -0.5f * g * dx * dx;
                        v[3] = -g * dx * dy;
                        v[4] = -0.5f * g * dy * dy;
                        v[5] = v_alpha_here * falloff;
                        v[6] = fabsf(v[0]);
                        v[7] = fabsf(v[1]);
                    }
                }
                // Each step halves the sums a lane holds and doubles the lanes a sum has seen: in the end sum k lies
                // in the lanes 2 k and 2 k + 1.
                FOLD
                v[0] += __shfl_xor_sync(ALL, v[0], 1);
                if ((lane & 1) == 0) partial[warp][bit][lane >> 1] = v[0];
            }
            if (lane == 0) hits[warp] = hit;
            __syncthreads();
            for (int j = thread >> 4; j < 32 && 32 * group + j < size; j += 16) {
                float sum = 0.0f;
                for (int w = 0; w < 8; ++w)
                    if ((hits[w] >> j) & 1u) sum += partial[w][j][thread & 15];
                v_slots.data[(long long)slot_of[32 * group + j] * 16 + (thread & 15)] = sum;
            }
            __syncthreads();
        }
    }
    __syncthreads();
#endif
"""

_FOLD = """
                #pragma unroll
                for (int k = 0; k < HALF; ++k) {
                    const bool upper = (lane & (2 * HALF)) != 0;
                    const float kept = upper ? v[k + HALF] : v[k], given = upper ? v[k] : v[k + HALF];
                    v[k] = kept + __shfl_xor_sync(ALL, given, 2 * HALF);
                }
"""


def _complete(body: str) -> str:
    """The body with its common beginning and the shared constants written out."""
    constants = {
        "ALPHA_MAX": ALPHA_MAX,
        "ALPHA_MIN": ALPHA_MIN,
        "TRANSMITTANCE_MIN": TRANSMITTANCE_MIN,
        "LOG2_E": 1.4426950408889634,
        "LN_2": 0.6931471805599453,
    }
    body = body.replace("    PLACE\n", _PLACE)
    # Written out: of a loop over the halves the compiler keeps the sums in memory.
    body = body.replace("FOLD", "".join(_FOLD.replace("HALF", str(half)) for half in (8, 4, 2, 1)))
    for name, value in constants.items():
        body = body.replace(name, f"{float(value):.9e}f")
    return body


FORWARD = _complete(_FORWARD)
ADJOINT = _complete(_ADJOINT)


# Parameters stand on few lines here: the bodies above are long enough.
# fmt: off
@wp.func_native(FORWARD)
def composite_tile(
    tile: int, means2d: wp.array[wp.vec2], conics: wp.array[wp.vec3], opacities: wp.array[float],
    channels: wp.array2d[float], background: wp.array[float], ranges: wp.array[wp.vec2i], splats: wp.array[int],
    width: int, height: int, columns: int, image: wp.array3d[float], alpha_image: wp.array2d[float],
    transmittance_image: wp.array2d[float], last_image: wp.array2d[int],
): ...


@wp.func_native(ADJOINT)
def composite_tile_adjoint(
    tile: int, means2d: wp.array[wp.vec2], conics: wp.array[wp.vec3], opacities: wp.array[float],
    channels: wp.array2d[float], background: wp.array[float], ranges: wp.array[wp.vec2i], splats: wp.array[int],
    slots: wp.array[int], transmittance_image: wp.array2d[float], last_image: wp.array2d[int],
    v_image: wp.array3d[float], v_alpha: wp.array2d[float], width: int, height: int, columns: int,
    v_slots: wp.array2d[float],
): ...
# fmt: on


@wp.kernel(launch_bounds=_BOUNDS)
def composite_tiles(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N] pixels
    conics_in: wp.array[wp.vec3],  # [N] (A, B, C), 1 / px^2
    opacities_in: wp.array[float],  # [N]
    channels_in: wp.array2d[float],  # [N, C]
    background_in: wp.array[float],  # [C]
    ranges_in: wp.array[wp.vec2i],  # [T] begin and end of each tile in the sorted list
    splats_in: wp.array[int],  # [P] the sorted list
    width: int,
    height: int,
    columns: int,
    # Out:
    image_out: wp.array3d[float],  # [C, H, W] on the background
    alpha_out: wp.array2d[float],  # [H, W] 1 - final transmittance
    transmittance_out: wp.array2d[float],  # [H, W] final transmittance; empty: not wanted
    last_out: wp.array2d[int],  # [H, W] index in the sorted list of the last contributor, + 1; 0: none; empty too
):
    """Grid: T x 256."""
    block, _lane = wp.tid()
    composite_tile(
        first + block, means2d_in, conics_in, opacities_in, channels_in, background_in, ranges_in, splats_in,
        width, height, columns, image_out, alpha_out, transmittance_out, last_out,
    )  # fmt: skip


@wp.kernel(launch_bounds=_BOUNDS)
def composite_tiles_adjoint(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N]
    conics_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    channels_in: wp.array2d[float],  # [N, C], C <= 8
    background_in: wp.array[float],  # [C]
    ranges_in: wp.array[wp.vec2i],  # [T]
    splats_in: wp.array[int],  # [P]
    slots_in: wp.array[int],  # [P] row of v_slots_out of each pair
    transmittance_in: wp.array2d[float],  # [H, W] what the forward pass stored
    last_in: wp.array2d[int],  # [H, W]
    v_image_in: wp.array3d[float],  # [C, H, W]
    v_alpha_in: wp.array2d[float],  # [H, W]
    width: int,
    height: int,
    columns: int,
    # Out:
    v_slots_out: wp.array2d[float],  # [P, 16] row: mean 2, conic 3, opacity 1, |mean| 2, channels C, zeros
):
    """Grid: T x 256."""
    block, _lane = wp.tid()
    composite_tile_adjoint(
        first + block, means2d_in, conics_in, opacities_in, channels_in, background_in, ranges_in, splats_in, slots_in,
        transmittance_in, last_in, v_image_in, v_alpha_in, width, height, columns, v_slots_out,
    )  # fmt: skip
