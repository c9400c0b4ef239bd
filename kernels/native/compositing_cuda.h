// Alpha compositing of one tile on CUDA: a block of 256 threads, one pixel per thread, 8 x 4 pixels per warp.
#pragma once

#define ALL_LANES 0xffffffffu

// Position of a thread in its tile.
struct TileThread {
    int thread, lane, warp;
    int corner_x, corner_y;  // the tile's first pixel
    int x, y;                // the thread's pixel
    bool inside;             // whether the thread's pixel lies in the image
    int begin, end;          // the tile's pairs
};

static inline __device__ TileThread
tile_thread(int tile, const wp::array_t<wp::vec2i>& ranges, int width, int height, int columns) {
    TileThread at;
    at.thread = threadIdx.x;
    at.lane = at.thread & 31;
    at.warp = at.thread >> 5;
    at.corner_x = (tile % columns) * 16;
    at.corner_y = (tile / columns) * 16;
    at.x = at.corner_x + (at.warp & 1) * 8 + (at.lane & 7);
    at.y = at.corner_y + (at.warp >> 1) * 4 + (at.lane >> 3);
    at.inside = at.x < width && at.y < height;
    at.begin = ranges.data[tile].c[0];
    at.end = ranges.data[tile].c[1];
    return at;
}

// Return the parts of the tile (a bit each, in the order of the warps) where alpha may be 1/255 or more. The bound is
// conservative.
static inline __device__ unsigned parts_reached(
    const TileThread& at, float mx, float my, float a, float b, float c, float opacity, float sharpness
) {
    if (!(opacity >= ALPHA_MIN)) return 0u;
    const float squared = b * b;  // makes a c - b b exact, which cancels for needles
    const float determinant = fmaf(a, c, -squared) + fmaf(-b, b, squared);
    if (!(determinant > 0.0f)) return 255u;
    const float depth = fmaxf(logf(opacity * 255.0f), 0.0f);
    const float reach = 4.0f * depth / (1.0f + sqrtf(1.0f + 4.0f * sharpness * depth)) + 1.0e-3f;
    const float half_width = 1.0001f * sqrtf(reach * c / determinant) + 0.01f;
    const float half_height = 1.0001f * sqrtf(reach * a / determinant) + 0.01f;
    unsigned parts = 0u;
    for (int part = 0; part < 8; ++part) {
        const float left = at.corner_x + (part & 1) * 8 + 0.5f, top = at.corner_y + (part >> 1) * 4 + 0.5f;
        const bool beside = mx + half_width < left || mx - half_width > left + 7.0f;
        const bool above = my + half_height < top || my - half_height > top + 3.0f;
        if (!beside && !above) parts |= 1u << part;
    }
    return parts;
}

static inline __device__ void composite_tile(
    int tile, const wp::array_t<wp::vec2>& means2d, const wp::array_t<wp::vec3>& conics,
    const wp::array_t<float>& opacities, const wp::array_t<float>& channels, const wp::array_t<float>& background,
    const wp::array_t<wp::vec2i>& ranges, const wp::array_t<int>& splats, int width, int height, int columns,
    float sharpness, wp::array_t<float>& image, wp::array_t<float>& alpha_image,
    wp::array_t<float>& transmittance_image, wp::array_t<int>& last_image
) {
    __shared__ float4 shape[256];  // mean, then the first two values of the scaled conic
    __shared__ float4 rest[256];   // third value of the scaled conic, opacity
    __shared__ float4 color[256];
    __shared__ unsigned reached[256];
    const TileThread at = tile_thread(tile, ranges, width, height, columns);
    const int thread = at.thread, lane = at.lane, warp = at.warp, begin = at.begin, end = at.end;
    const bool inside = at.inside;
    const float centre_x = at.x + 0.5f, centre_y = at.y + 0.5f;
    const long long plane = (long long)width * height, pixel = (long long)at.y * width + at.x;
    const float* means = (const float*)means2d.data;
    const float* all_conics = (const float*)conics.data;
    const int count = image.shape.dims[0], stride = channels.shape.dims[1];

    for (int base = 0; base < count; base += 4) {
        float sum[4] = {0.0f, 0.0f, 0.0f, 0.0f};
        float transmittance = 1.0f;
        int last = 0;
        bool open = inside;
        for (int first = begin; first < end; first += 256) {
            // This is also the barrier after which no thread reads the previous batch.
            if (__syncthreads_count(open) == 0) break;
            unsigned parts = 0u;
            if (first + thread < end) {
                const int i = splats.data[first + thread];
                const float mx = means[2 * i], my = means[2 * i + 1], opacity = opacities.data[i];
                const float a = all_conics[3 * i], b = all_conics[3 * i + 1], c = all_conics[3 * i + 2];
                const float* own = channels.data + (long long)i * stride + base;
                const int rest_of = count - base;
                parts = parts_reached(at, mx, my, a, b, c, opacity, sharpness);
                shape[thread] = make_float4(mx, my, -0.5f * LOG2_E * a, -LOG2_E * b);
                rest[thread] = make_float4(-0.5f * LOG2_E * c, opacity, 0.0f, 0.0f);
                color[thread] = make_float4(
                    own[0], rest_of > 1 ? own[1] : 0.0f, rest_of > 2 ? own[2] : 0.0f, rest_of > 3 ? own[3] : 0.0f
                );
            }
            reached[thread] = parts;
            __syncthreads();
            for (int word = 0; word < 8; ++word) {
                unsigned left = __ballot_sync(ALL_LANES, (reached[32 * word + lane] >> warp) & 1u);
                if (!__any_sync(ALL_LANES, open)) break;
                while (left) {
                    const int j = 32 * word + __ffs(left) - 1;
                    left &= left - 1u;
                    const float4 s = shape[j];
                    const float4 r = rest[j];
                    const float dx = centre_x - s.x, dy = centre_y - s.y;
                    const float plain = dx * (s.z * dx + s.w * dy) + r.x * dy * dy;
                    const float power = plain * (1.0f - LN_2 * sharpness * plain);
                    const float alpha = fminf(ALPHA_MAX, r.y * exp2f(power));
                    if (open && plain <= 0.0f && alpha >= ALPHA_MIN) {
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
                            last = first + j + 1;
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
}

static inline __device__ void composite_tile_adjoint(
    int tile, const wp::array_t<wp::vec2>& means2d, const wp::array_t<wp::vec3>& conics,
    const wp::array_t<float>& opacities, const wp::array_t<float>& channels, const wp::array_t<float>& background,
    const wp::array_t<wp::vec2i>& ranges, const wp::array_t<int>& splats, const wp::array_t<int>& slots,
    const wp::array_t<float>& transmittance_image, const wp::array_t<int>& last_image,
    const wp::array_t<float>& v_image, const wp::array_t<float>& v_alpha, int width, int height, int columns,
    float sharpness, wp::array_t<float>& v_slots
) {
    struct One {
        enum { value = 1 };
    };
    struct Two {
        enum { value = 2 };
    };
    struct Four {
        enum { value = 4 };
    };
    struct Eight {
        enum { value = 8 };
    };
    __shared__ float4 shape[128];
    __shared__ float4 rest[128];
    __shared__ float color[128][8];
    __shared__ unsigned reached[128];
    __shared__ int slot_of[128];
    __shared__ float partial[8][32][16];  // sums of each warp for each pair that it hit
    __shared__ unsigned hits[8];
    __shared__ int deepest[8];
    const TileThread at = tile_thread(tile, ranges, width, height, columns);
    const int thread = at.thread, lane = at.lane, warp = at.warp, begin = at.begin, end = at.end;
    const bool inside = at.inside;
    const float centre_x = at.x + 0.5f, centre_y = at.y + 0.5f;
    const long long plane = (long long)width * height, pixel = (long long)at.y * width + at.x;
    const float* means = (const float*)means2d.data;
    const float* all_conics = (const float*)conics.data;
    const int count = channels.shape.dims[1];
    float transmittance = 1.0f, behind = 0.0f, v_pixel[8];
    int last = 0;
    for (int c = 0; c < 8; ++c) v_pixel[c] = inside && c < count ? v_image.data[c * plane + pixel] : 0.0f;
    if (inside) {
        last = last_image.data[pixel];
        transmittance = transmittance_image.data[pixel];
        behind = -v_alpha.data[pixel];  // colour behind the current splat, weighted by v_image
        for (int c = 0; c < 8; ++c)
            if (c < count) behind += v_pixel[c] * background.data[c];
        behind *= transmittance;
    }
    int warp_last = last;
    for (int step = 16; step > 0; step >>= 1) {
        const int other = __shfl_xor_sync(ALL_LANES, warp_last, step);
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
                parts = parts_reached(at, mx, my, a, b, c, opacity, sharpness);
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
            unsigned left = __ballot_sync(ALL_LANES, (reached[32 * group + lane] >> warp) & 1u);
            const int over = start + 32 * group + 32 - warp_last;  // number of pairs behind this warp's last one
            if (over > 0) left = over >= 32 ? 0u : left & (ALL_LANES >> over);
            unsigned hit = 0u;
            while (left) {
                const int bit = 31 - __clz(left), j = 32 * group + bit;
                left ^= 1u << bit;
                const float4 s = shape[j];
                const float4 r = rest[j];
                const float dx = centre_x - s.x, dy = centre_y - s.y;
                const float plain = dx * (s.z * dx + s.w * dy) + r.x * dy * dy;
                const float power = plain * (1.0f - LN_2 * sharpness * plain);
                const float falloff = exp2f(power), raw = r.y * falloff;
                const float alpha = fminf(ALPHA_MAX, raw);
                const bool valid = start + j < last && plain <= 0.0f && alpha >= ALPHA_MIN;
                if (!__any_sync(ALL_LANES, valid)) continue;
                hit |= 1u << bit;
                float v[16];
                auto fold = [&](auto half) {
                    constexpr int HALF = decltype(half)::value;
#pragma unroll
                    for (int k = 0; k < HALF; ++k) {
                        const bool upper = (lane & (2 * HALF)) != 0;
                        const float kept = upper ? v[k + HALF] : v[k], given = upper ? v[k] : v[k + HALF];
                        v[k] = kept + __shfl_xor_sync(ALL_LANES, given, 2 * HALF);
                    }
                };
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
                        const float slope = 1.0f - 2.0f * LN_2 * sharpness * plain;
                        const float g = v_alpha_here * raw * slope;  // gradient to -q / 2
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
                // Each step halves the number of sums per lane and doubles the lanes that each sum covers. In the end
                // lanes 2 k and 2 k + 1 hold sum k.
                fold(Eight());
                fold(Four());
                fold(Two());
                fold(One());
                v[0] += __shfl_xor_sync(ALL_LANES, v[0], 1);
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
}
