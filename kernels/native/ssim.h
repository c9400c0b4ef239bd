// Photometric loss of a band of rows of one channel, and its adjoint; a vector holds 16 neighbouring pixels.
#pragma once
#include "simd.h"

// Return lanes s to s + 15 of the 32 in two vectors.
#define NEIGHBOURS(a, b, s)                                                                                     \
    __builtin_shufflevector(                                                                                    \
        a, b, s, s + 1, s + 2, s + 3, s + 4, s + 5, s + 6, s + 7, s + 8, s + 9, s + 10, s + 11, s + 12, s + 13, \
        s + 14, s + 15                                                                                          \
    )

typedef unsigned char vbytes __attribute__((vector_size(16)));

enum { BAND = SSIM_BAND, BLOCK = SSIM_BLOCK };

// Position of a band: rows ``top`` to ``bottom`` of a channel, in blocks of columns of about equal width, which are
// whole vectors except at the right edge.
struct Band {
    int channels, height, width, channel, top, bottom, block;
    long long plane;
    const float *image, *truth;
    const bool* mask;

    Band(
        int index, const wp::array_t<float>& images, const wp::array_t<float>& truths, const wp::array_t<bool>& masks
    ) {
        channels = images.shape[0];
        height = images.shape[1];
        width = images.shape[2];
        const int bands = (height + BAND - 1) / BAND;
        channel = index / bands;
        top = (index % bands) * BAND;
        bottom = top + BAND < height ? top + BAND : height;
        plane = (long long)height * width;
        image = images.data + channel * plane;
        truth = truths.data + channel * plane;
        mask = masks.data;
        const int blocks = (width + BLOCK - 1) / BLOCK;
        block = ((width + blocks - 1) / blocks + 15) / 16 * 16;
    }
};

// Pixels of image and truth. Pixels outside the image or the mask are invalid; there both values are equal.
struct Pixels {
    vf x, y;
    vi valid;
};

static inline Pixels read_pixels(const Band& band, long long at, int column, bool whole) {
    Pixels p = {};
    if (whole) {
        p.x = load(band.image + at, 16);
        p.y = load(band.truth + at, 16);
        p.valid = ~p.valid;
    } else
        for (int k = 0; k < 16; ++k)
            if (column + k >= 0 && column + k < band.width) {
                p.x[k] = band.image[at + k];
                p.y[k] = band.truth[at + k];
                p.valid[k] = -1;
            }
    if (band.mask) {
        if (whole) {
            vbytes m;
            __builtin_memcpy(&m, band.mask + at, 16);
            p.valid = __builtin_convertvector(m, vi) != vi{};
        } else
            for (int k = 0; k < 16; ++k)
                if (column + k >= 0 && column + k < band.width && !band.mask[at + k]) p.valid[k] = 0;
        p.x = p.valid ? p.x : p.y;
    }
    return p;
}

// Return true if a bit of one of the maps is set in any of 16 pixels.
ALWAYS_INLINE bool any_set(const vf* maps, int count) {
    vi all = (vi)maps[0];
    for (int map = 1; map < count; ++map) all |= (vi)maps[map];
    return bits(all != vi{}) != 0;
}

// Return a function that processes a band downwards. ``read(maps, at, column, whole)`` gives the maps of 16 pixels.
// Each row is blurred horizontally into a ring of 11 rows, which stays in the first-level cache. As soon as the ring is
// full, ``finish(row, left, vectors, blur)`` finishes its middle row; in it ``blur(v, maps)`` blurs vertically, and
// returns false if all windows of the 16 pixels hold nothing but zeros: most of the picture of a subject on black.
static inline auto band_walk() {
    FUSE_WITHIN_EXPRESSIONS
    return [](auto map_count, const Band& band, auto read, auto finish) __attribute__((always_inline)) {
        constexpr int MAPS = decltype(map_count)::value;
        const float w[6] = {SSIM_TAP_0, SSIM_TAP_1, SSIM_TAP_2, SSIM_TAP_3, SSIM_TAP_4, SSIM_TAP_5};
        const int width = band.width;
        alignas(64) float ring[MAPS][11][BLOCK];
        unsigned filled[11];  // one bit for each vector of a row of the ring that is not zero
        static_assert(BLOCK <= 16 * 32, "one bit for each vector");
        for (int left = 0; left < width; left += band.block) {
            const int columns = left + band.block < width ? band.block : width - left;
            const int vectors = (columns + 15) / 16;
            for (int row = band.top - 5; row < band.bottom + 5; ++row) {
                const int slot = (row - band.top + 5) % 11;
                filled[slot] = 0;
                if (row < 0 || row >= band.height) {
                    for (int map = 0; map < MAPS; ++map)
                        for (int v = 0; v < vectors; ++v) store(ring[map][slot] + 16 * v, vf{}, 16);
                } else {
                    vf past[2][MAPS];
                    unsigned nonzero = 0;  // of the last three vectors, the last one in bit 0
                    for (int v = 0; v < vectors + 2; ++v) {
                        const int column = left - 16 + 16 * v;
                        vf fresh[MAPS] = {};
                        if (column > -16 && column < width)
                            read(fresh, (long long)row * width + column, column, column >= 0 && column + 16 <= width);
                        nonzero = (nonzero << 1 | any_set(fresh, MAPS)) & 7;
                        // Blur the vector before the last one. Neighbours are shifted in registers, because a load that
                        // crosses a cache line costs as much as two.
                        if (v >= 2 && !nonzero)
                            for (int map = 0; map < MAPS; ++map) store(ring[map][slot] + 16 * (v - 2), vf{}, 16);
                        else if (v >= 2) {
                            filled[slot] |= 1u << (v - 2);
                            for (int map = 0; map < MAPS; ++map) {
                                const vf a = past[0][map], b = past[1][map], c = fresh[map];
                                vf sum = w[0] * b + w[1] * (NEIGHBOURS(a, b, 15) + NEIGHBOURS(b, c, 1));
                                sum += w[2] * (NEIGHBOURS(a, b, 14) + NEIGHBOURS(b, c, 2));
                                sum += w[3] * (NEIGHBOURS(a, b, 13) + NEIGHBOURS(b, c, 3));
                                sum += w[4] * (NEIGHBOURS(a, b, 12) + NEIGHBOURS(b, c, 4));
                                sum += w[5] * (NEIGHBOURS(a, b, 11) + NEIGHBOURS(b, c, 5));
                                store(ring[map][slot] + 16 * (v - 2), sum, 16);
                            }
                        }
                        for (int map = 0; map < MAPS; ++map) {
                            past[0][map] = past[1][map];
                            past[1][map] = fresh[map];
                        }
                    }
                }
                const int out = row - 5;
                if (out < band.top) continue;
                int order[11];         // offset of row out - 5 + k in the ring
                unsigned windows = 0;  // one bit for each vector whose windows are not zero
                for (int k = 0; k < 11; ++k) {
                    order[k] = (slot + 1 + k) % 11 * BLOCK;
                    windows |= filled[k];
                }
                auto blur = [&](int v, vf* blurred) __attribute__((always_inline)) {
                    if (!(windows >> v & 1)) {
                        for (int map = 0; map < MAPS; ++map) blurred[map] = vf{};
                        return false;
                    }
#pragma unroll
                    for (int map = 0; map < MAPS; ++map) {
                        const float* at = ring[map][0] + 16 * v;
                        vf sum =
                            w[0] * load(at + order[5], 16) + w[1] * (load(at + order[4], 16) + load(at + order[6], 16));
#pragma unroll
                        for (int k = 2; k < 6; ++k)
                            sum += w[k] * (load(at + order[5 - k], 16) + load(at + order[5 + k], 16));
                        blurred[map] = sum;
                    }
                    return true;
                };
                finish(out, left, vectors, blur);
            }
        }
    };
}

static inline void photometric_band(
    int index, const wp::array_t<float>& image, const wp::array_t<float>& truth, const wp::array_t<bool>& mask,
    wp::array_t<float>& sums, wp::array_t<float>& partials
) {
    FUSE_WITHIN_EXPRESSIONS
    struct Maps {
        enum { value = 4 };
    };
    const Band band = Band(index, image, truth, mask);
    // What the sum of SSIM gets below where all blurred values are 0.
    const float c1 = SSIM_C1, c2 = SSIM_C2, ssim_of_nothing = c1 * c2 * (1.0f / (c1 * c2));
    auto read = [&](vf* fresh, long long at, int column, bool whole) __attribute__((always_inline)) {
        const Pixels p = read_pixels(band, at, column, whole);
        fresh[0] = p.x;
        fresh[1] = p.y;
        fresh[2] = p.y * p.y + p.x * p.x;
        fresh[3] = p.x * p.y;
    };
    auto finish = [&](int row, int left, int vectors, auto blur) __attribute__((always_inline)) {
        const vf ZERO = {};
        vf l1_sum = {}, ssim_sum = {}, square_sum = {};
        for (int v = 0; v < vectors; ++v) {
            vf blurred[4];
            const bool something = blur(v, blurred);
            const int column = left + 16 * v;
            const long long at = (long long)row * band.width + column;
            const int count = column + 16 <= band.width ? 16 : band.width - column;
            if (!something && !band.mask && count == 16) {
                // Image and truth are zero in these windows. The derivatives would only meet pixels that are zero.
                ssim_sum += ssim_of_nothing;
                for (int j = 0; j < 3 && partials.data; ++j)
                    store(partials.data + (j * (long long)band.channels + band.channel) * band.plane + at, ZERO, 16);
                continue;
            }
            const Pixels p = read_pixels(band, at, column, count == 16);
            const vf cross = blurred[0] * blurred[1];
            const vf squares = blurred[0] * blurred[0] + blurred[1] * blurred[1];
            const vf a1 = 2.0f * cross + SSIM_C1;
            const vf a2 = 2.0f * (blurred[3] - cross) + SSIM_C2;
            const vf b1 = squares + SSIM_C1;
            const vf b2 = blurred[2] - squares + SSIM_C2;
            const vf inverse = 1.0f / (b1 * b2);
            const vf ssim = a1 * a2 * inverse;
            const vf difference = p.x - p.y;
            l1_sum += p.valid ? (difference < ZERO ? -difference : difference) : ZERO;
            ssim_sum += p.valid ? ssim : ZERO;
            square_sum += p.valid ? difference * difference : ZERO;
            if (partials.data) {
                vf partial[3] = {
                    2.0f * inverse * (blurred[1] * (a2 - a1) + blurred[0] * ssim * (b1 - b2)),
                    -ssim * inverse * b1,
                    2.0f * a1 * inverse,
                };
                for (int j = 0; j < 3; ++j) {
                    partial[j] = p.valid ? partial[j] : ZERO;
                    store(
                        partials.data + (j * (long long)band.channels + band.channel) * band.plane + at, partial[j],
                        count
                    );
                }
            }
        }
        float* l1_to = sums.data + band.channel * (long long)band.height + row;
        const vf row_sums[3] = {l1_sum, ssim_sum, square_sum};
        for (int j = 0; j < 3; ++j) {
            float* to = l1_to + j * (long long)band.channels * band.height;
            float total = left == 0 ? 0.0f : *to;
            for (int k = 0; k < 16; ++k) total += row_sums[j][k];
            *to = total;
        }
    };
    band_walk()(Maps(), band, read, finish);
}

static inline void photometric_band_adjoint(
    int index, const wp::array_t<float>& image, const wp::array_t<float>& truth, const wp::array_t<bool>& mask,
    const wp::array_t<float>& partials, const wp::array_t<float>& v_sums, wp::array_t<float>& v_image
) {
    FUSE_WITHIN_EXPRESSIONS
    struct Maps {
        enum { value = 3 };
    };
    const Band band = Band(index, image, truth, mask);
    auto read = [&](vf* fresh, long long at, int column, bool whole) __attribute__((always_inline)) {
        for (int j = 0; j < 3; ++j) {
            const float* from = partials.data + (j * (long long)band.channels + band.channel) * band.plane + at;
            vf value = {};
            if (whole)
                value = load(from, 16);
            else
                for (int k = 0; k < 16; ++k)
                    if (column + k >= 0 && column + k < band.width) value[k] = from[k];
            fresh[j] = value;
        }
    };
    auto finish = [&](int row, int left, int vectors, auto blur) __attribute__((always_inline)) {
        const vf ZERO = {}, ONE = ZERO + 1.0f;
        for (int v = 0; v < vectors; ++v) {
            vf blurred[3];
            blur(v, blurred);
            const int column = left + 16 * v;
            const long long at = (long long)row * band.width + column;
            const int count = column + 16 <= band.width ? 16 : band.width - column;
            const Pixels p = read_pixels(band, at, column, count == 16);
            const vf slope = p.x > p.y ? ONE : (p.x < p.y ? -ONE : ZERO);
            vf gradient =
                v_sums.data[0] * slope + v_sums.data[1] * (blurred[0] + 2.0f * p.x * blurred[1] + p.y * blurred[2]);
            gradient += 2.0f * v_sums.data[2] * (p.x - p.y);
            gradient = p.valid ? gradient : ZERO;
            store(v_image.data + band.channel * band.plane + at, gradient, count);
        }
    };
    band_walk()(Maps(), band, read, finish);
}
