// A tile of 16 x 16 pixels as 16 blocks of 4 x 4, one vector each, and splats as its blocks see them. Block b lies in
// column b % 4 and row b / 4 of the blocks; lane k holds the pixel in column k % 4 and row k / 4 of a block.
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

// Column and row of a block's pixels, 0 to 3.
static inline vf pixel_columns() { return vf{0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3}; }
static inline vf pixel_rows() { return vf{0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3}; }

// The depth of a Gaussian, -log2 of its value, as seen from a tile. Lanes of the first three are the tile's blocks,
// those of the last are a block's pixels (u, v):
//     depth = at_first + along_u u + along_v v + quadratic
struct Depth {
    vf at_first, along_u, along_v, quadratic;
};

// Where a tile's blocks lie: their first pixel minus the splat's mean.
struct Offsets {
    vf x, y;
};

static inline Offsets offsets(const float* s, const Tile& tile) {
    FUSE_WITHIN_EXPRESSIONS
    return {4.0f * pixel_columns() - (s[0] - tile.x), 4.0f * pixel_rows() - (s[1] - tile.y)};
}

static inline Depth depth_from(const float* s, const Offsets& o) {
    FUSE_WITHIN_EXPRESSIONS
    const vf u = pixel_columns(), v = pixel_rows();
    const float a = s[2], b = s[3], c = s[4];
    const vf by = b * o.y, cy = c * o.y;
    return {(a * o.x + by) * o.x + cy * o.y, 2.0f * a * o.x + by, b * o.x + 2.0f * cy, (a * u + b * v) * u + c * v * v};
}

// Return the depth at a block's pixels. Forward pass and adjoint must round alike to agree on the contributing splats.
static inline vf depth_at(const Depth& d, int block, vf u, vf v) {
    FUSE_WITHIN_EXPRESSIONS
    const float *first = (const float*)&d.at_first, *along_u = (const float*)&d.along_u,
                *along_v = (const float*)&d.along_v;
    return (d.quadratic + first[block]) + along_u[block] * u + along_v[block] * v;
}

// Return where a depth is at least zero and below the bound: as integers, negative floats and NaN exceed all others.
static inline vi within(vf depth, float bound) { return (vu)depth < __builtin_bit_cast(unsigned, bound); }

static inline vf clamped(vf value, vf low, vf high) {
    value = value < low ? low : value;
    return value > high ? high : value;
}

// Return one bit per block, set if the ellipse meets it. Of a rectangle, the point of least depth lies on the side that
// faces the centre in x, or on the one that faces it in y.
static inline unsigned reached_blocks(const float* s, const Offsets& o) {
    FUSE_WITHIN_EXPRESSIONS
    const vf right = o.x + 3.0f, bottom = o.y + 3.0f, zero = vf{};
    const vf x0 = clamped(zero, o.x, right), y0 = clamped(s[9] * x0, o.y, bottom);
    const vf y1 = clamped(zero, o.y, bottom), x1 = clamped(s[7] * y1, o.x, right);
    const vf d0 = (s[2] * x0 + s[3] * y0) * x0 + s[4] * y0 * y0;
    const vf d1 = (s[2] * x1 + s[3] * y1) * x1 + s[4] * y1 * y1;
    const float bound = s[8] > 0.0f ? s[8] + 1e-3f : -1.0f;
    return bits((d0 <= bound) | (d1 <= bound));
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
