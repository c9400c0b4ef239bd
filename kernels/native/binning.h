// Binning on a CPU, band by band. A band is a row of tiles; a stretch is the part of a band that one splat touches.
#pragma once
#include "ellipse.h"

#define EVEN_LANES 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30
#define ODD_LANES 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31
#define LOW_HALVES 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23
#define HIGH_HALVES 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31

// Copy 16 elements of equal size; write zeros for those past the n-th.
static inline void first_lanes(const void* from, void* to, int n, int size) {
    __builtin_memcpy(to, from, n * size);
    __builtin_memset((char*)to + n * size, 0, (16 - n) * size);
}

static inline void count_chunk(
    int chunk, const wp::array_t<wp::vec2>& means2d, const wp::array_t<wp::vec3>& conics,
    const wp::array_t<float>& opacities, const wp::array_t<float>& depths, const wp::array_t<wp::vec2i>& radii,
    int chunk_size, int width, int height, int columns, int rows, int tile_size, int tile_begin, int tile_end,
    wp::array_t<wp::int64>& windows, wp::array_t<wp::vec2i>& corners, wp::array_t<int>& stretches_of_chunk,
    wp::array_t<wp::int64>& pairs_of_chunk
) {
    const TileGrid grid = tile_grid(width, height, columns, rows, tile_size, tile_begin, tile_end);
    const vi ZEROS = {};
    const int count = opacities.shape.dims[0], bands = rows;
    const int begin = chunk * chunk_size, end = count - begin < chunk_size ? count : begin + chunk_size;
    int* stretches = stretches_of_chunk.data + (long long)chunk * (bands + 1);
    __builtin_memset(stretches, 0, (bands + 1) * sizeof(int));
    long long pairs = 0;
    for (int i = begin; i < end; i += 16) {
        const int n = end - i < 16 ? end - i : 16;
        vf m[2], q[3], opacity, depth;
        vi r[2];
        first_lanes(means2d.data + i, m, n, 8);
        first_lanes(conics.data + i, q, n, 12);
        first_lanes(opacities.data + i, &opacity, n, 4);
        first_lanes(depths.data + i, &depth, n, 4);
        first_lanes(radii.data + i, r, n, 8);
        // Split interleaved fields into one vector each.
        const vf x = __builtin_shufflevector(m[0], m[1], EVEN_LANES),
                 y = __builtin_shufflevector(m[0], m[1], ODD_LANES);
        const vi rx = __builtin_shufflevector(r[0], r[1], EVEN_LANES),
                 ry = __builtin_shufflevector(r[0], r[1], ODD_LANES);
        vf a = __builtin_shufflevector(q[0], q[1], 0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 0, 0, 0, 0, 0);
        vf b = __builtin_shufflevector(q[0], q[1], 1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31, 0, 0, 0, 0, 0);
        vf c = __builtin_shufflevector(q[0], q[1], 2, 5, 8, 11, 14, 17, 20, 23, 26, 29, 0, 0, 0, 0, 0, 0);
        a = __builtin_shufflevector(a, q[2], 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29);
        b = __builtin_shufflevector(b, q[2], 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30);
        c = __builtin_shufflevector(c, q[2], 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31);

        const Ellipse e = ellipse_of(x, y, a, b, c, opacity, depth, rx, ry);
        const Span span = touched_rows(grid, e);
        const vi left = touched(e.x - e.half_width, e.x + e.half_width, tile_size, columns, width).begin;
        vi found = {}, top = {}, bottom = {}, upper = {}, lower = {}, outside = {};
        const int turns = __builtin_reduce_max(span.end - span.begin);
        for (int k = 0; k < turns; ++k) {
            const vi row = span.begin + k;
            const Span reach = touched_columns(grid, e, row);
            const vi length = row < span.end ? reach.end - reach.begin : ZEROS;
            const vi some = length > 0;
            top = (some & (found == 0)) ? row : top;
            bottom = some ? row : bottom;
            found += length;
            // The window has a byte for each row of tiles and a bit for each column.
            const vi shift = reach.begin - left, line = row - top;
            outside |= some & ((shift < 0) | (shift + length > 8) | (line > 7));
            const vi byte = some ? (((ZEROS + 1) << (length & 15)) - 1) << (shift & 7) : ZEROS;
            const vi place = (line & 3) << 3;
            upper |= line < 4 ? byte << place : ZEROS;
            lower |= line < 4 ? ZEROS : byte << place;
        }
        // For a splat too large for the window, the window holds the last row instead, and the first column is -1.
        const vi column = outside ? ZEROS - 1 : left;
        upper = outside ? bottom : upper;
        lower = outside ? ZEROS : lower;
        vi window[2] = {
            __builtin_shufflevector(upper, lower, LOW_HALVES), __builtin_shufflevector(upper, lower, HIGH_HALVES)
        };
        vi corner[2] = {
            __builtin_shufflevector(top, column, LOW_HALVES), __builtin_shufflevector(top, column, HIGH_HALVES)
        };
        __builtin_memcpy(windows.data + i, window, n * 8);
        __builtin_memcpy(corners.data + i, corner, n * 8);
        for (int k = 0; k < n; ++k) {
            if (found[k] == 0) continue;
            pairs += found[k];
            ++stretches[top[k]];
            --stretches[bottom[k] + 1];
        }
    }
    for (int band = 1; band <= bands; ++band) stretches[band] += stretches[band - 1];
    pairs_of_chunk.data[chunk] = pairs;
}

static inline void deal_chunk(
    int chunk, const wp::array_t<wp::vec2>& means2d, const wp::array_t<wp::vec3>& conics,
    const wp::array_t<float>& opacities, const wp::array_t<float>& depths, int chunk_size, int width, int height,
    int columns, int rows, int tile_size, int tile_begin, int tile_end, const wp::array_t<wp::int64>& windows,
    const wp::array_t<wp::vec2i>& corners, const wp::array_t<wp::int64>& first_slots,
    wp::array_t<int>& cursors_of_chunk, wp::array_t<wp::int64>& offsets, wp::array_t<int>& stretches,
    wp::array_t<wp::int64>& keys, wp::array_t<int>& pairs_before
) {
    typedef int v4 __attribute__((vector_size(16)));
    const TileGrid grid = tile_grid(width, height, columns, rows, tile_size, tile_begin, tile_end);
    const vf ZERO = {};
    const vi ZEROS = {}, LANE = __builtin_convertvector(lane_numbers(), vi);
    const int count = opacities.shape.dims[0], bands = rows;
    const int begin = chunk * chunk_size, end = count - begin < chunk_size ? count : begin + chunk_size;
    int* cursors = cursors_of_chunk.data + (long long)chunk * (bands + 1);
    int* pairs = pairs_before.data + (long long)chunk * (bands + 1);
    __builtin_memset(pairs, 0, (bands + 1) * sizeof(int));
    long long slot = first_slots.data[chunk];
    for (int i = begin; i < end; ++i) {
        offsets.data[i] = slot;
        unsigned long long window = windows.data[i];
        const int top = corners.data[i].c[0], left = corners.data[i].c[1];
        if (window == 0 && left >= 0) continue;
        // Transform the depth's bits so that they sort as unsigned numbers. Adding 0 turns minus zero into zero.
        const float depth = depths.data[i] + 0.0f;
        const unsigned word = __builtin_bit_cast(unsigned, depth);
        const unsigned long long key = (unsigned long long)(word ^ ((unsigned)((int)word >> 31) | 0x80000000u)) << 32;
        auto deal = [&](int row, int column, int length) {
            const int at = cursors[row]++;
            const v4 stretch = {i, (int)slot, column, column + length};
            __builtin_memcpy(stretches.data + 4ll * at, &stretch, 16);
            keys.data[at] = key | (unsigned)at;
            pairs[row] += length;
            slot += length;
        };
        if (left >= 0) {
            for (int row = top; window; ++row, window >>= 8) {
                const unsigned line = window & 255u;
                deal(row, left + __builtin_ctz(line | 256u), __builtin_popcount(line));
            }
            continue;
        }
        const Ellipse e = ellipse_of(
            ZERO + means2d.data[i].c[0], ZERO + means2d.data[i].c[1], ZERO + conics.data[i].c[0],
            ZERO + conics.data[i].c[1], ZERO + conics.data[i].c[2], ZERO + opacities.data[i], ZERO + depths.data[i],
            ZEROS + 1, ZEROS + 1
        );
        const int bottom = (int)window;
        for (int row = top; row <= bottom; row += 16) {
            const Span reach = touched_columns(grid, e, row + LANE);
            for (int k = 0; k < 16 && row + k <= bottom; ++k)
                deal(row + k, reach.begin[k], reach.end[k] - reach.begin[k]);
        }
    }
    if (end == count) offsets.data[count] = slot;
    int before = 0;
    for (int band = 0; band <= bands; ++band) {
        const int own = pairs[band];
        pairs[band] = before;
        before += own;
    }
}

static inline void sort_band(
    int band, const wp::array_t<int>& band_begins, const wp::array_t<int>& stretches,
    const wp::array_t<int>& pairs_before, wp::array_t<wp::int64>& keys, wp::array_t<wp::int64>& spare,
    wp::array_t<int>& cursors, wp::array_t<wp::vec2i>& ranges, wp::array_t<int>& splats, wp::array_t<int>& slots
) {
    typedef unsigned long long u64;
    const int begin = band_begins.data[band], n = band_begins.data[band + 1] - begin;
    const int columns = cursors.shape.dims[1];
    int pair = 0;
    for (int chunk = 0; chunk < pairs_before.shape.dims[0]; ++chunk)
        pair += pairs_before.data[(long long)chunk * pairs_before.shape.dims[1] + band];

    // Count the pairs of each tile: add 1 where a stretch begins and -1 behind its end, then take running sums.
    int* cursor = cursors.data + (long long)band * columns;
    __builtin_memset(cursor, 0, columns * sizeof(int));
    for (int k = begin; k < begin + n; ++k) {
        const int* stretch = stretches.data + 4ll * k;
        if (stretch[2] == stretch[3]) continue;  // the splat reaches no pixel centre of this row
        ++cursor[stretch[2]];
        if (stretch[3] < columns) --cursor[stretch[3]];
    }
    int open = 0;
    for (int column = 0; column < columns; ++column) {
        open += cursor[column];
        cursor[column] = pair;
        ranges.data[(long long)band * columns + column].c[0] = pair;
        pair += open;
        ranges.data[(long long)band * columns + column].c[1] = pair;
    }

    // Radix sort by depth, lowest digit first, over the bits in which the band's depths differ.
    u64 *from = (u64*)keys.data + begin, *to = (u64*)spare.data + begin;
    unsigned low = ~0u, high = 0;
    for (int k = 0; k < n; ++k) {
        const unsigned key = from[k] >> 32;
        low = key < low ? key : low;
        high = key > high ? key : high;
    }
    const int differing = n > 1 && high > low ? 32 - __builtin_clz(high - low) : 0;
    const int most = n < 256 ? 6 : n < 8192 ? 8 : 11;
    const int digits = (differing + most - 1) / most, width = digits ? (differing + digits - 1) / digits : 0;
    for (int digit = 0; digit < digits; ++digit) {
        int places[2048];
        const int shift = digit * width;
        const unsigned mask = (1u << width) - 1u;
        __builtin_memset(places, 0, (mask + 1) * sizeof(int));
        for (int k = 0; k < n; ++k) ++places[(((unsigned)(from[k] >> 32) - low) >> shift) & mask];
        int place = 0;
        for (unsigned value = 0; value <= mask; ++value) {
            const int own = places[value];
            places[value] = place;
            place += own;
        }
        for (int k = 0; k < n; ++k) to[places[(((unsigned)(from[k] >> 32) - low) >> shift) & mask]++] = from[k];
        u64* swap = from;
        from = to;
        to = swap;
    }

    const bool with_slots = slots.shape.dims[0] > 0;
    for (int k = 0; k < n; ++k) {
        const int* stretch = stretches.data + 4ll * (unsigned)from[k];
        if (k + 16 < n) __builtin_prefetch(stretches.data + 4ll * (unsigned)from[k + 16]);
        int slot = stretch[1];
        for (int column = stretch[2]; column < stretch[3]; ++column, ++slot) {
            const int at = cursor[column]++;
            splats.data[at] = stretch[0];
            if (with_slots) slots.data[at] = slot;
        }
    }
}
