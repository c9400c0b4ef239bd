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

// The GPU's own approximations, one instruction each and good to two units in the last place or so. Functions of the
// CUDA library take up to twenty more for denormal numbers, which are flushed to zero here.
#if defined(__CUDACC__) || defined(__CUDACC_RTC__)
#define APPROXIMATION(name, instruction, otherwise)                    \
    static inline __device__ float name(float x) {                     \
        float y;                                                       \
        asm(instruction ".approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x)); \
        return y;                                                      \
    }
#else
#define APPROXIMATION(name, instruction, otherwise) \
    static inline __device__ float name(float x) { return otherwise; }
#endif
APPROXIMATION(power_of_two, "ex2", exp2f(x))
APPROXIMATION(logarithm_of_two, "lg2", log2f(x))
APPROXIMATION(root, "sqrt", sqrtf(x))
APPROXIMATION(inverse_of, "rcp", 1.0f / x)
#undef APPROXIMATION

// Return x, which the compiler then keeps in a register; otherwise it computes x again in every round of a loop.
static inline __device__ int computed_once(int x) {
#if defined(__CUDACC__) || defined(__CUDACC_RTC__)
    asm volatile("" : "+r"(x));
#endif
    return x;
}

// A splat at a pixel. Both passes call this one function, whose multiply-adds are explicit, so that they agree to the
// bit about which splats a pixel uses.
struct Blend {
    float dx, dy;
    float row;    // s.w dy
    float third;  // r.x dy
    float plain;  // -q / (2 ln 2)
    float raw;    // alpha before the clamp
};

static inline __device__ Blend blend_at(const float4& s, const float4& r, float x, float y, float bend) {
    Blend at;
    at.dx = x - s.x;
    at.dy = y - s.y;
    at.row = s.w * at.dy;
    at.third = r.x * at.dy;
    at.plain = fmaf(at.third, at.dy, fmaf(s.z, at.dx, at.row) * at.dx);
    at.raw = power_of_two(fmaf(at.plain, fmaf(bend, at.plain, 1.0f), r.y));
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
    if (!(determinant > 1.0e-30f && determinant < 1.0e30f)) return 255u;
    const float depth = fmaxf(LN_2 * logarithm_of_two(opacity * 255.0f), 0.0f);
    const float bent = 1.0f + root(1.0f + 4.0f * sharpness * depth);
    const float reach = 4.0f * depth * inverse_of(bent) + 1.0e-3f, scale = reach * inverse_of(determinant);
    const float half_width = 1.0001f * root(scale * c) + 0.01f, half_height = 1.0001f * root(scale * a) + 0.01f;
    unsigned parts = 0u;
    for (int part = 0; part < 8; ++part) {
        const float left = at.corner_x + (part & 1) * 8 + 0.5f, top = at.corner_y + (part >> 1) * 4 + 0.5f;
        const bool beside = mx + half_width < left || mx - half_width > left + 7.0f;
        const bool above = my + half_height < top || my - half_height > top + 3.0f;
        if (!beside && !above) parts |= 1u << part;
    }
    return parts;
}

// Return a value of a conic, 1e24 at most; NaN stays.
static inline __device__ float at_most(float value) { return value > 1.0e24f ? 1.0e24f : value; }

// Store the geometry of a splat for ``blend_at``: the mean and the first two values of the scaled conic, then its third
// value, the logarithm of the opacity, and the inverse opacity. Splats lie 48 bytes apart, so that neither eight
// threads that store them nor a warp that reads one meet in a bank. The conic is limited so that no distance on an
// image overflows: with a bend of 0, infinity times 0 would be NaN, and the clamp of alpha would take it for opaque.
static inline __device__ void stage(float4* splat, float mx, float my, float a, float b, float c, float opacity) {
    splat[0] = make_float4(mx, my, -0.5f * LOG2_E * at_most(a), -LOG2_E * at_most(b));
    splat[1] = make_float4(-0.5f * LOG2_E * at_most(c), logarithm_of_two(opacity), inverse_of(opacity), 0.0f);
}

// Return up to four channels, and zeros beyond the last.
static inline __device__ float4 channels_from(const float* own, int count) {
    return make_float4(own[0], count > 1 ? own[1] : 0.0f, count > 2 ? own[2] : 0.0f, count > 3 ? own[3] : 0.0f);
}

static inline __device__ void composite_tile(
    int tile, const wp::array_t<wp::vec2>& means2d, const wp::array_t<wp::vec3>& conics,
    const wp::array_t<float>& opacities, const wp::array_t<float>& channels, const wp::array_t<float>& background,
    const wp::array_t<wp::vec2i>& ranges, const wp::array_t<int>& splats, int width, int height, int columns,
    float sharpness, wp::array_t<float>& image, wp::array_t<float>& alpha_image,
    wp::array_t<float>& transmittance_image, wp::array_t<int>& last_image
) {
    // One structure, so that all addresses have one base.
    struct Shared {
        float4 staged[256][3];  // geometry (2), channels
        unsigned reached[256];
    };
    __shared__ Shared shared;
    const TileThread at = tile_thread(tile, ranges, width, height, columns);
    const int thread = at.thread, lane = at.lane, warp = at.warp, begin = at.begin, end = at.end;
    const bool inside = at.inside;
    const float centre_x = at.x + 0.5f, centre_y = at.y + 0.5f, bend = -LN_2 * sharpness;
    const long long plane = (long long)width * height, pixel = (long long)at.y * width + at.x;
    const float* means = (const float*)means2d.data;
    const float* all_conics = (const float*)conics.data;
    const int count = image.shape.dims[0], stride = channels.shape.dims[1];

    for (int base = 0; base < count; base += 4) {
        float sum[4] = {0.0f, 0.0f, 0.0f, 0.0f};
        float transmittance = 1.0f;
        int last = 0;
        float least = inside ? ALPHA_MIN : 2.0f;  // the smallest alpha that is blended; 2: the pixel is closed
        for (int first = begin; first < end; first += 256) {
            // This is also the barrier after which no thread reads the previous batch.
            if (__syncthreads_count(least < 1.0f) == 0) break;
            const int size = end - first < 256 ? end - first : 256;
            unsigned parts = 0u;
            if (thread < size) {
                const int i = splats.data[first + thread];
                const float mx = means[2 * i], my = means[2 * i + 1], opacity = opacities.data[i];
                const float a = all_conics[3 * i], b = all_conics[3 * i + 1], c = all_conics[3 * i + 2];
                const float* own = channels.data + (long long)i * stride + base;
                parts = parts_reached(at, mx, my, a, b, c, opacity, sharpness);
                stage(shared.staged[thread], mx, my, a, b, c, opacity);
                shared.staged[thread][2] = channels_from(own, count - base);
            }
            shared.reached[thread] = parts;
            __syncthreads();
            for (int word = 0; word < size; word += 32) {
                unsigned left = __ballot_sync(ALL_LANES, (shared.reached[word + lane] >> warp) & 1u);
                if (!__any_sync(ALL_LANES, least < 1.0f)) break;
                while (left) {
                    const int j = word + __ffs(left) - 1;
                    left &= left - 1u;
                    const float4 s = shared.staged[j][0], r = shared.staged[j][1], c = shared.staged[j][2];
                    const Blend here = blend_at(s, r, centre_x, centre_y, bend);
                    const float alpha = fminf(ALPHA_MAX, here.raw);
                    if (here.plain <= 0.0f && alpha >= least) {
                        const float remaining = fmaf(-alpha, transmittance, transmittance);
                        if (!(remaining > TRANSMITTANCE_MIN)) {
                            least += 2.0f;
                        } else {
                            const float weight = alpha * transmittance;
                            sum[0] = fmaf(c.x, weight, sum[0]);
                            sum[1] = fmaf(c.y, weight, sum[1]);
                            sum[2] = fmaf(c.z, weight, sum[2]);
                            sum[3] = fmaf(c.w, weight, sum[3]);
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

// Return what all pixels of a sum share, which is multiplied in when the sum is there.
static inline __device__ float factor_of(int column, float inverse_opacity) {
    if (column == 5) return inverse_opacity;
    if (column >= 8) return 1.0f;
    const float size = column < 2 || column >= 6 ? LN_2 : column == 3 ? 1.0f : 0.5f;
    return column < 5 ? -size : size;
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
    struct Three {
        enum { value = 3 };
    };
    struct Four {
        enum { value = 4 };
    };
    struct Six {
        enum { value = 6 };
    };
    struct Eight {
        enum { value = 8 };
    };
    // One structure, so that all addresses have one base.
    struct Shared {
        float4 staged[128][3];  // geometry (2), the first channels
        float4 further[128];    // the other channels
        unsigned reached[128];
        int slot_of[128];
        float partial[8 * 32 * 16];  // sums of each warp for each pair that it hit
        unsigned hits[8];
        int deepest[8];
    };
    __shared__ Shared shared;
    const TileThread at = tile_thread(tile, ranges, width, height, columns);
    const int thread = at.thread, lane = at.lane, warp = at.warp, begin = at.begin, end = at.end;
    const bool inside = at.inside;
    const float centre_x = at.x + 0.5f, centre_y = at.y + 0.5f, bend = -LN_2 * sharpness;
    const long long plane = (long long)width * height, pixel = (long long)at.y * width + at.x;
    const float* means = (const float*)means2d.data;
    const float* all_conics = (const float*)conics.data;
    const int count = channels.shape.dims[1], column = thread & 15;
    const int last = inside ? last_image.data[pixel] : 0;
    int warp_last = last;
    for (int step = 16; step > 0; step >>= 1) {
        const int other = __shfl_xor_sync(ALL_LANES, warp_last, step);
        warp_last = other > warp_last ? other : warp_last;
    }
    if (lane == 0) shared.deepest[warp] = warp_last;
    __syncthreads();
    int stop = begin;
    for (int w = 0; w < 8; ++w) stop = shared.deepest[w] > stop ? shared.deepest[w] : stop;
    for (int p = stop + (thread >> 4); p < end; p += 16)  // pairs that no pixel used
        v_slots.data[(long long)slots.data[p] * 16 + column] = 0.0f;
    const int own_sums = computed_once(32 * 16 * warp + (lane >> 1));

    auto walk = [&](auto most) {
        constexpr int CHANNELS = decltype(most)::value;
        float v_pixel[CHANNELS], transmittance = 1.0f, behind = 0.0f;
        for (int c = 0; c < CHANNELS; ++c) v_pixel[c] = inside && c < count ? v_image.data[c * plane + pixel] : 0.0f;
        if (inside) {
            transmittance = transmittance_image.data[pixel];
            behind = -v_alpha.data[pixel];  // colour behind the current splat, weighted by v_image
            for (int c = 0; c < CHANNELS; ++c)
                if (c < count) behind += v_pixel[c] * background.data[c];
            behind *= transmittance;
        }
        for (; stop > begin; stop -= 128) {
            const int start = stop - 128 > begin ? stop - 128 : begin, size = stop - start;
            if (thread < 128) {
                unsigned parts = 0u;
                if (thread < size) {
                    const int i = splats.data[start + thread];
                    const float mx = means[2 * i], my = means[2 * i + 1], opacity = opacities.data[i];
                    const float a = all_conics[3 * i], b = all_conics[3 * i + 1], c = all_conics[3 * i + 2];
                    const float* own = channels.data + (long long)i * count;
                    parts = parts_reached(at, mx, my, a, b, c, opacity, sharpness);
                    stage(shared.staged[thread], mx, my, a, b, c, opacity);
                    shared.staged[thread][2] = channels_from(own, count);
                    if (CHANNELS > 4) shared.further[thread] = channels_from(own + 4, count - 4);
                    shared.slot_of[thread] = slots.data[start + thread];
                }
                shared.reached[thread] = parts;
            }
            __syncthreads();
            for (int group = (size - 1) >> 5; group >= 0; --group) {
                const int first = 32 * group;
                unsigned left = __ballot_sync(ALL_LANES, (shared.reached[first + lane] >> warp) & 1u);
                const int over = start + first + 32 - warp_last;  // number of pairs behind this warp's last one
                if (over > 0) left = over >= 32 ? 0u : left & (ALL_LANES >> over);
                unsigned hit = 0u;
                while (left) {
                    const int bit = 31 - __clz(left), j = first + bit;
                    left ^= 1u << bit;
                    const float4 s = shared.staged[j][0], r = shared.staged[j][1];
                    const Blend here = blend_at(s, r, centre_x, centre_y, bend);
                    const float alpha = fminf(ALPHA_MAX, here.raw);
                    const bool valid = start + j < last && here.plain <= 0.0f && alpha >= ALPHA_MIN;
                    if (!__any_sync(ALL_LANES, valid)) continue;
                    hit |= 1u << bit;
                    float v[8 + CHANNELS];
#pragma unroll
                    for (int k = 0; k < 8 + CHANNELS; ++k) v[k] = 0.0f;
                    if (valid) {
                        const float inverse = inverse_of(1.0f - alpha);
                        transmittance *= inverse;
                        const float weight = alpha * transmittance;
                        const float4 c = shared.staged[j][2];
                        float seen = c.x * v_pixel[0] + c.y * v_pixel[1] + c.z * v_pixel[2] + c.w * v_pixel[3];
                        if constexpr (CHANNELS > 4) {
                            const float4 d = shared.further[j];
                            seen += d.x * v_pixel[4] + d.y * v_pixel[5] + d.z * v_pixel[6] + d.w * v_pixel[7];
                        }
#pragma unroll
                        for (int k = 0; k < CHANNELS; ++k) v[8 + k] = weight * v_pixel[k];
                        const float v_alpha_here = seen * transmittance - behind * inverse;
                        behind += seen * weight;
                        v[5] = here.raw <= ALPHA_MAX ? v_alpha_here * here.raw : 0.0f;  // a clamped alpha passes none
                        const float g = v[5] * fmaf(2.0f * bend, here.plain, 1.0f);     // gradient to -q / 2
                        const float gx = g * here.dx, gy = g * here.dy;
                        v[0] = g * fmaf(2.0f * s.z, here.dx, here.row);
                        v[1] = g * fmaf(s.w, here.dx, 2.0f * here.third);
                        v[2] = gx * here.dx;
                        v[3] = gx * here.dy;
                        v[4] = gy * here.dy;
                        v[6] = fabsf(v[0]);
                        v[7] = fabsf(v[1]);
                    }
                    // Each step halves the number of sums per lane and doubles the lanes that each sum covers. In the
                    // end lanes 2 k and 2 k + 1 hold sum k; of 12 sums, lanes 8 k to 8 k + 5 hold 3 k to 3 k + 2.
                    auto fold = [&](auto half, int step) {
                        constexpr int HALF = decltype(half)::value;
                        const bool upper = (lane & step) != 0;
#pragma unroll
                        for (int k = 0; k < HALF; ++k) {
                            const float kept = upper ? v[k + HALF] : v[k], given = upper ? v[k] : v[k + HALF];
                            v[k] = kept + __shfl_xor_sync(ALL_LANES, given, step);
                        }
                    };
                    if constexpr (CHANNELS > 4) {
                        fold(Eight(), 16);
                        fold(Four(), 8);
                    } else {
                        fold(Six(), 16);
                        fold(Three(), 8);
                        v[3] = 0.0f;
                    }
                    fold(Two(), 4);
                    fold(One(), 2);
                    v[0] += __shfl_xor_sync(ALL_LANES, v[0], 1);
                    if ((lane & 1) == 0) shared.partial[own_sums + 16 * bit] = v[0];
                }
                if (lane == 0) shared.hits[warp] = hit;
                __syncthreads();
                for (int j = thread >> 4; j < 32 && first + j < size; j += 16) {
                    const int place = CHANNELS == 4 ? column + column / 3 : column;
                    float sum = 0.0f;
                    if (column < 8 + CHANNELS)
                        for (int w = 0; w < 8; ++w)
                            if ((shared.hits[w] >> j) & 1u) sum += shared.partial[(32 * w + j) * 16 + place];
                    v_slots.data[(long long)shared.slot_of[first + j] * 16 + column] =
                        sum * factor_of(column, shared.staged[first + j][1].z);
                }
                __syncthreads();
            }
        }
    };
    if (count > 4)
        walk(Eight());
    else
        walk(Four());
    __syncthreads();
}
