// The tiles that splats touch: the functions of kernels/binning.py, for 16 splats, or for 16 rows of tiles of one
// splat, at a time. They repeat that file operation by operation, so that both find the same tiles; the module that
// includes them is compiled without fusing multiplications and additions.
#pragma once
#include "simd.h"

// Ellipses of 16 splats; the fields of kernels/binning.py's Ellipse.
struct Ellipse {
    vf x, y, shear, half_width, half_height, tip, spread, steepness;
    vi usable;
};

// Begin and end of touched tiles along one axis.
struct Span {
    vi begin, end;
};

// The image's tiles, and the range of them that is wanted.
struct TileGrid {
    int width, height, columns, rows, tile_size, tile_begin, tile_end;
    bool part;  // false: the range is the whole image, so nothing needs to be cut off
};

static inline TileGrid tile_grid(
    int width, int height, int columns, int rows, int tile_size, int tile_begin, int tile_end
) {
    const bool part = tile_begin > 0 || tile_end < columns * rows;
    return {width, height, columns, rows, tile_size, tile_begin, tile_end, part};
}

static inline vf least(vf a, vf b) { return b < a ? b : a; }
static inline vf most(vf a, vf b) { return b > a ? b : a; }
static inline vf floats(vi v) { return __builtin_convertvector(v, vf); }

static inline Ellipse ellipse_of(vf x, vf y, vf a, vf b, vf c, vf opacity, vf depth, vi radius_x, vi radius_y) {
    NO_FUSING
    const float coefficients[] = {LOG2_0, LOG2_1, LOG2_2, LOG2_3, LOG2_4, LOG2_5, LOG2_6};
    Ellipse e;
    const vf sum = x + y + a + b + c + opacity + depth;
    const vd da = __builtin_convertvector(a, vd), db = __builtin_convertvector(b, vd);
    const vf determinant = __builtin_convertvector(da * __builtin_convertvector(c, vd) - db * db, vf);
    e.usable = (radius_x > 0) & (radius_y > 0) & (opacity >= ALPHA_MIN) & (sum - sum == 0.0f) & (determinant > 0.0f) &
               (a > 0.0f);
    const vu bits_of = (vu)(opacity / ALPHA_MIN);
    const vf m = (vf)((bits_of & 0x7fffffu) | 0x3f800000u) - 1.0f;
    vf log2 = vf{} + coefficients[6];
    for (int k = 5; k >= 0; --k) log2 = log2 * m + coefficients[k];
    log2 = log2 * m + floats((vi)(bits_of >> 23) - 127);
    const vf reach = most(vf{}, 1.3862943611198906f * log2) + REACH_SLACK;
    const vf scale = 1.0f / a;
    e.x = x;
    e.y = y;
    e.shear = -b * scale;
    e.spread = reach * scale;
    e.steepness = determinant * scale * scale;
    e.half_width = __builtin_elementwise_sqrt(reach * c / determinant);
    e.half_height = __builtin_elementwise_sqrt(reach * a / determinant);
    e.tip = -b * __builtin_elementwise_sqrt(reach / (c * determinant));
    return e;
}

static inline Span touched(vf low, vf high, int tile_size, int tiles, int extent) {
    NO_FUSING
    const vf ZERO = {};
    const vi NONE = {};
    const vi meets = (high >= 0.5f) & (low <= (float)extent - 0.5f);
    const float scale = 1.0f / (float)tile_size;
    low = meets ? low : ZERO;
    high = meets ? high : ZERO;
    vi begin = __builtin_convertvector((most(ZERO + 0.5f, low) - 0.5f) * scale, vi);
    begin -= low > floats((begin + 1) * tile_size) - 0.5f;  // true is -1 in a lane
    vi end = __builtin_convertvector((least(ZERO + (float)extent, high) - 0.5f) * scale, vi) + 1;
    end = end < begin ? begin : end;
    end = end > tiles ? NONE + tiles : end;
    return {meets ? begin : NONE, meets ? end : NONE};
}

static inline Span touched_rows(const TileGrid& grid, const Ellipse& e) {
    NO_FUSING
    const vi NONE = {};
    Span span = touched(e.y - e.half_height, e.y + e.half_height, grid.tile_size, grid.rows, grid.height);
    if (grid.part) {
        const int top = grid.tile_begin / grid.columns;
        const int bottom = (grid.tile_end + grid.columns - 1) / grid.columns;
        span.begin = span.begin < top ? NONE + top : span.begin;
        span.end = span.end > bottom ? NONE + bottom : span.end;
    }
    return {e.usable ? span.begin : NONE, e.usable ? span.end : NONE};
}

static inline Span touched_columns(const TileGrid& grid, const Ellipse& e, vi row) {
    NO_FUSING
    const vf ZERO = {};
    const vi below = (row + 1) * grid.tile_size, height = vi{} + grid.height;
    const vf low = most(-e.half_height, floats(row * grid.tile_size) + 0.5f - e.y);
    const vf high = least(e.half_height, floats(below < height ? below : height) - 0.5f - e.y);
    const vf right = least(high, most(low, e.tip)), left = least(high, most(low, -e.tip));
    const vf x_right = e.shear * right + __builtin_elementwise_sqrt(most(ZERO, e.spread - e.steepness * right * right));
    const vf x_left = e.shear * left - __builtin_elementwise_sqrt(most(ZERO, e.spread - e.steepness * left * left));
    Span span = touched(e.x + x_left, e.x + x_right, grid.tile_size, grid.columns, grid.width);
    if (grid.part) {
        const vi first = grid.tile_begin - row * grid.columns, last = grid.tile_end - row * grid.columns;
        span.begin = span.begin < first ? first : span.begin;
        span.end = span.end > last ? last : span.end;
        span.end = span.end < span.begin ? span.begin : span.end;
    }
    return span;
}
