// A tile of 16 x 16 pixels as 16 blocks of 4 x 4, one vector each, and packed splats as its blocks see them. Block b
// lies in column b % 4 and row b / 4 of the blocks; lane k holds the pixel in column k % 4 and row k / 4 of a block.
#pragma once
#include "simd.h"

// Position of a tile in the image and in the list of pairs.
struct Tile {
    int begin, end;       // its pairs
    int wide, tall;       // its pixels inside the image
    float x, y;           // centre of its first pixel
    long long corner;     // index of its first pixel
    long long plane;      // pixels of the image
    long long row_pitch;  // pixels of a row of the image

    Tile(int tile, const wp::array_t<wp::vec_t<2, int>>& ranges, int width, int height, int columns) {
        const int x0 = 16 * (tile % columns), y0 = 16 * (tile / columns);
        begin = ranges.data[tile].c[0];
        end = ranges.data[tile].c[1];
        wide = width - x0 < 16 ? width - x0 : 16;
        tall = height - y0 < 16 ? height - y0 : 16;
        x = 16.0f * (tile % columns) + 0.5f;
        y = 16.0f * (tile / columns) + 0.5f;
        corner = (long long)y0 * width + x0;
        plane = (long long)width * height;
        row_pitch = width;
    }

    // Columns, rows and first pixel of a block inside the image.
    int wide_of(int block) const { return wide - 4 * (block & 3); }
    int tall_of(int block) const { return tall - 4 * (block >> 2); }
    long long at(int block) const { return corner + 4 * (block & 3) + 4 * (block >> 2) * row_pitch; }

    // Blocks that have pixels inside the image, one bit each.
    unsigned blocks() const {
        unsigned inside = 0;
        for (int b = 0; b < 16; ++b) inside |= (unsigned)(wide_of(b) > 0 && tall_of(b) > 0) << b;
        return inside;
    }
};

// Column and row of a block's pixels, or of a tile's blocks: 0 to 3.
static inline vf lane_columns() { return vf{0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3}; }
static inline vf lane_rows() { return vf{0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3}; }

// Points of an image: the centres of a block's pixels, or of the first pixels of a tile's blocks.
struct Points {
    vf x, y;
};

static inline Points first_pixels(const Tile& tile) {
    return {4.0f * lane_columns() + tile.x, 4.0f * lane_rows() + tile.y};
}

static inline Points pixels_of(const Tile& tile, int block) {
    return {lane_columns() + (tile.x + 4 * (block & 3)), lane_rows() + (tile.y + 4 * (block >> 2))};
}

// Return -log2 of a Gaussian of sharpness 0 at a distance from its mean.
static inline vf fall_at(const float* splat, vf dx, vf dy) {
    FUSE_WITHIN_EXPRESSIONS
    return (splat[2] * dx + splat[3] * dy) * dx + splat[4] * dy * dy;
}

// A packed splat at a block's pixels.
struct Seen {
    vf dx, dy;  // from the mean to the pixels
    vf fall;    // -log2 of the Gaussian of sharpness 0
    vf raw;     // alpha before it is clamped, garbage where it does not count
    vi counts;  // where alpha is at least ALPHA_MIN
};

// Forward pass and adjoint both call this, so they agree on the pixels that count. The fall counts if it is at least
// zero and below a positive, finite bound: as integers, negative floats and NaN exceed all such bounds.
ALWAYS_INLINE Seen see(const float* splat, const Points& pixels, float curvature) {
    FUSE_WITHIN_EXPRESSIONS
    const vf dx = pixels.x - splat[0], dy = pixels.y - splat[1];
    const vf fall = fall_at(splat, dx, dy);
    const vf raw = exp2v(splat[5] - fall * (1.0f + curvature * fall));
    return {dx, dy, fall, raw, (vu)fall < __builtin_bit_cast(unsigned, splat[8])};
}

static inline vf clamped(vf value, vf low, vf high) {
    value = value < low ? low : value;
    return value > high ? high : value;
}

// Return one bit per block, set if the ellipse meets the rectangle that the block's pixel centres span, or nearly meets
// it, since the falls are rounded. A rectangle's point of least fall lies on the side that faces the mean in x, or on
// the one that faces it in y.
static inline unsigned reached_blocks(const float* splat, const Points& first) {
    FUSE_WITHIN_EXPRESSIONS
    if (__builtin_bit_cast(unsigned, splat[8]) == 0) return 0;
    const vf left = first.x - splat[0], top = first.y - splat[1], right = left + 3.0f, bottom = top + 3.0f;
    const vf x0 = clamped(vf{}, left, right), y0 = clamped(splat[9] * x0, top, bottom);
    const vf y1 = clamped(vf{}, top, bottom), x1 = clamped(splat[7] * y1, left, right);
    const float bound = splat[8] + 1e-3f;
    return bits((fall_at(splat, x0, y0) <= bound) | (fall_at(splat, x1, y1) <= bound));
}

// Load the pixels of a block of which `wide` columns and `tall` rows lie inside the image, with zeros elsewhere.
static inline vf load_block(const float* from, long long pitch, int wide, int tall) {
    vf v = {};
    if (wide >= 4 && tall >= 4)
        for (int r = 0; r < 4; ++r) __builtin_memcpy((float*)&v + 4 * r, from + r * pitch, 16);
    else
        for (int k = 0; k < 16; ++k)
            if ((k & 3) < wide && (k >> 2) < tall) v[k] = from[(k >> 2) * pitch + (k & 3)];
    return v;
}

// Store the pixels of a block that lie inside the image.
static inline void store_block(float* to, vf v, long long pitch, int wide, int tall) {
    if (wide >= 4 && tall >= 4)
        for (int r = 0; r < 4; ++r) __builtin_memcpy(to + r * pitch, (float*)&v + 4 * r, 16);
    else
        for (int k = 0; k < 16; ++k)
            if ((k & 3) < wide && (k >> 2) < tall) to[(k >> 2) * pitch + (k & 3)] = v[k];
}
