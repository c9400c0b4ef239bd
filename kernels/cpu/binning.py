"""Splats to tiles on a CPU: bands of tile rows, each sorted by itself.

A *band* is a row of tiles, a *stretch* what one splat touches of one band: an interval of columns. In index order, so
that memory is walked from front to back, splats are turned into stretches and dealt to the bands they lie in; a band's
stretches are then few enough for a core's own cache, where they are sorted by depth and laid out tile by tile. Four
launches, of which all but the second are shared among threads:

1. ``count_chunks``: which tiles each splat touches, 16 splats at a time, and how many stretches a chunk of splats has
   in each band.
2. ``place_chunks``: running sums of these counts: where each chunk writes.
3. ``deal_chunks``: the stretches, band by band and there in the order of the splats' indices.
4. ``sort_bands``: a stable radix sort of each band by depth, then its tiles' lists by counting.

Lists sorted by tile, depth and index are unique: nothing depends on how many chunks or threads there are. The bodies
are native snippets with Clang's vector types; their arithmetic is that of ``binning``, operation by operation, so that
a CPU and a GPU find the same tiles.
"""

from __future__ import annotations

import warp as wp

from ..binning import ELLIPSE_SIMD

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

_CHUNK = f"""
#if !defined(__CUDA_ARCH__)
{ELLIPSE_SIMD}
    const int count = opacities.shape.dims[0], bands = rows;
    const int begin = chunk * chunk_size, end = count - begin < chunk_size ? count : begin + chunk_size;
"""

_COUNT = (
    _CHUNK
    + """
    auto first_lanes = [](const void* from, void* to, int n, int size) {  // 16 elements, zeros behind the n-th
        __builtin_memcpy(to, from, n * size);
        __builtin_memset((char*)to + n * size, 0, (16 - n) * size);
    };
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
        // Fields that lie side by side, each into its own vector.
        #define EVEN 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30
        #define ODD 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31
        const vf x = __builtin_shufflevector(m[0], m[1], EVEN), y = __builtin_shufflevector(m[0], m[1], ODD);
        const vi rx = __builtin_shufflevector(r[0], r[1], EVEN), ry = __builtin_shufflevector(r[0], r[1], ODD);
        vf a = __builtin_shufflevector(q[0], q[1], 0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 0, 0, 0, 0, 0);
        vf b = __builtin_shufflevector(q[0], q[1], 1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31, 0, 0, 0, 0, 0);
        vf c = __builtin_shufflevector(q[0], q[1], 2, 5, 8, 11, 14, 17, 20, 23, 26, 29, 0, 0, 0, 0, 0, 0);
        a = __builtin_shufflevector(a, q[2], 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29);
        b = __builtin_shufflevector(b, q[2], 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30);
        c = __builtin_shufflevector(c, q[2], 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31);

        const Ellipse e = ellipse_of(x, y, a, b, c, opacity, depth, rx, ry);
        const Span span = touched_rows(e);
        const vi left = touched(e.x - e.half_width, e.x + e.half_width, columns, width).begin;
        vi found = {}, top = {}, bottom = {}, upper = {}, lower = {}, outside = {};
        const int turns = __builtin_reduce_max(span.end - span.begin);
        for (int k = 0; k < turns; ++k) {
            const vi row = span.begin + k;
            const Span reach = touched_columns(e, row);
            const vi length = row < span.end ? reach.end - reach.begin : ZEROS;
            const vi some = length > 0;
            top = (some & (found == 0)) ? row : top;
            bottom = some ? row : bottom;
            found += length;
            // A byte of the window for each row of tiles, a bit for each column.
            const vi shift = reach.begin - left, line = row - top;
            outside |= some & ((shift < 0) | (shift + length > 8) | (line > 7));
            const vi byte = some ? (((ZEROS + 1) << (length & 15)) - 1) << (shift & 7) : ZEROS;
            const vi place = (line & 3) << 3;
            upper |= line < 4 ? byte << place : ZEROS;
            lower |= line < 4 ? ZEROS : byte << place;
        }
        // Where the window is too small, it holds the last row instead, and the first column is -1.
        const vi column = outside ? ZEROS - 1 : left;
        upper = outside ? bottom : upper;
        lower = outside ? ZEROS : lower;
        vi window[2] = {__builtin_shufflevector(upper, lower, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23),
            __builtin_shufflevector(upper, lower, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31)};
        vi corner[2] = {__builtin_shufflevector(top, column, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23),
            __builtin_shufflevector(top, column, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31)};
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
#endif
"""
)

_DEAL = (
    _CHUNK
    + """
    typedef int v4 __attribute__((vector_size(16)));
    int* cursors = cursors_of_chunk.data + (long long)chunk * (bands + 1);
    int* pairs = pairs_before.data + (long long)chunk * (bands + 1);
    __builtin_memset(pairs, 0, (bands + 1) * sizeof(int));
    long long slot = first_slots.data[chunk];
    for (int i = begin; i < end; ++i) {
        offsets.data[i] = slot;
        unsigned long long window = windows.data[i];
        const int top = corners.data[i].c[0], left = corners.data[i].c[1];
        if (window == 0 && left >= 0) continue;
        // The bits of the depth, turned so that they sort as unsigned numbers; + 0: minus zero becomes zero.
        const float depth = depths.data[i] + 0.0f;
        const unsigned bits = __builtin_bit_cast(unsigned, depth);
        const unsigned long long key = (unsigned long long)(bits ^ ((unsigned)((int)bits >> 31) | 0x80000000u)) << 32;
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
        const Ellipse e = ellipse_of(ZERO + means2d.data[i].c[0], ZERO + means2d.data[i].c[1],
            ZERO + conics.data[i].c[0], ZERO + conics.data[i].c[1], ZERO + conics.data[i].c[2],
            ZERO + opacities.data[i], ZERO + depths.data[i], ZEROS + 1, ZEROS + 1);
        const int bottom = (int)window;
        for (int row = top; row <= bottom; row += 16) {
            const Span reach = touched_columns(e, row + LANE);
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
#endif
"""
)

_SORT = """
#if !defined(__CUDA_ARCH__)
    typedef unsigned long long u64;
    const int begin = band_begins.data[band], n = band_begins.data[band + 1] - begin;
    const int columns = cursors.shape.dims[1];
    int pair = 0;
    for (int chunk = 0; chunk < pairs_before.shape.dims[0]; ++chunk)
        pair += pairs_before.data[(long long)chunk * pairs_before.shape.dims[1] + band];

    // How many pairs each tile has: +1 where a stretch begins, -1 behind its end, and running sums.
    int* cursor = cursors.data + (long long)band * columns;
    __builtin_memset(cursor, 0, columns * sizeof(int));
    for (int k = begin; k < begin + n; ++k) {
        const int* stretch = stretches.data + 4ll * k;
        if (stretch[2] == stretch[3]) continue;  // a row between others that the splat's pixels leave out
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

    // Radix sort by depth, the lowest digit first; only the bits in which a band's depths differ.
    u64 *from = (u64*)keys.data + begin, *to = (u64*)spare.data + begin;
    unsigned low = ~0u, high = 0;
    for (int k = 0; k < n; ++k) {
        const unsigned key = from[k] >> 32;
        low = key < low ? key : low;
        high = key > high ? key : high;
    }
    const int bits = n > 1 && high > low ? 32 - __builtin_clz(high - low) : 0;
    const int most = n < 256 ? 6 : n < 8192 ? 8 : 11;
    const int digits = (bits + most - 1) / most, width = digits ? (bits + digits - 1) / digits : 0;
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

    for (int k = 0; k < n; ++k) {
        const int* stretch = stretches.data + 4ll * (unsigned)from[k];
        int slot = stretch[1];
        for (int column = stretch[2]; column < stretch[3]; ++column, ++slot) {
            const int at = cursor[column]++;
            splats.data[at] = stretch[0];
            slots.data[at] = slot;
        }
    }
#endif
"""


# fmt: off
@wp.func_native(_COUNT)
def count_chunk(
    chunk: int, means2d: wp.array[wp.vec2], conics: wp.array[wp.vec3], opacities: wp.array[float],
    depths: wp.array[float], radii: wp.array[wp.vec2i], chunk_size: int, width: int, height: int, columns: int,
    rows: int, tile_size: int, tile_begin: int, tile_end: int, windows: wp.array[wp.int64],
    corners: wp.array[wp.vec2i], stretches_of_chunk: wp.array2d[int], pairs_of_chunk: wp.array[wp.int64],
): ...


@wp.func_native(_DEAL)
def deal_chunk(
    chunk: int, means2d: wp.array[wp.vec2], conics: wp.array[wp.vec3], opacities: wp.array[float],
    depths: wp.array[float], chunk_size: int, width: int, height: int, columns: int, rows: int, tile_size: int,
    tile_begin: int, tile_end: int, windows: wp.array[wp.int64], corners: wp.array[wp.vec2i],
    first_slots: wp.array[wp.int64], cursors_of_chunk: wp.array2d[int], offsets: wp.array[wp.int64],
    stretches: wp.array2d[int], keys: wp.array[wp.int64], pairs_before: wp.array2d[int],
): ...


@wp.func_native(_SORT)
def sort_band(
    band: int, band_begins: wp.array[int], stretches: wp.array2d[int], pairs_before: wp.array2d[int],
    keys: wp.array[wp.int64], spare: wp.array[wp.int64], cursors: wp.array2d[int], ranges: wp.array[wp.vec2i],
    splats: wp.array[int], slots: wp.array[int],
): ...
# fmt: on


@wp.kernel
def count_chunks(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N]
    conics_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    depths_in: wp.array[float],  # [N]
    radii_in: wp.array[wp.vec2i],  # [N]
    chunk_size: int,  # a multiple of 16
    width: int,
    height: int,
    columns: int,
    rows: int,
    tile_size: int,
    tile_begin: int,  # no tile before this one is wanted
    tile_end: int,  # nor this one and those behind it
    # Out:
    windows_out: wp.array[wp.int64],  # [N] tiles touched in a window of 8 x 8, a byte a row; else the last row
    corners_out: wp.array[wp.vec2i],  # [N] first row, first column; column -1: the tiles do not fit into the window
    stretches_out: wp.array2d[int],  # [chunks, bands + 1] stretches of the chunk in each band; the last is 0
    pairs_out: wp.array[wp.int64],  # [chunks + 2] pairs of the chunk
):
    count_chunk(
        first + wp.tid(), means2d_in, conics_in, opacities_in, depths_in, radii_in, chunk_size, width, height, columns,
        rows, tile_size, tile_begin, tile_end, windows_out, corners_out, stretches_out, pairs_out,
    )  # fmt: skip


@wp.kernel
def place_chunks(
    first: int,
    # Out:
    stretches_out: wp.array2d[int],  # [chunks, bands + 1] counts, becomes: where the chunk's first goes
    pairs_out: wp.array[wp.int64],  # [chunks + 2] counts, becomes: pairs before the chunk; all pairs; all stretches
    band_begins_out: wp.array[int],  # [bands + 1]
):
    """In one grid index: there is little to add up."""
    chunks = stretches_out.shape[0]
    stretches = wp.int64(0)
    for band in range(band_begins_out.shape[0]):
        band_begins_out[band] = int(stretches)
        for chunk in range(chunks):
            own = stretches_out[chunk, band]
            stretches_out[chunk, band] = int(stretches)
            stretches += wp.int64(own)
    pairs = wp.int64(0)
    for chunk in range(chunks):
        of_chunk = pairs_out[chunk]
        pairs_out[chunk] = pairs
        pairs += of_chunk
    pairs_out[chunks] = pairs
    pairs_out[chunks + 1] = stretches


@wp.kernel
def deal_chunks(
    first: int,
    # In:
    means2d_in: wp.array[wp.vec2],  # [N]
    conics_in: wp.array[wp.vec3],  # [N]
    opacities_in: wp.array[float],  # [N]
    depths_in: wp.array[float],  # [N]
    chunk_size: int,
    width: int,
    height: int,
    columns: int,
    rows: int,
    tile_size: int,
    tile_begin: int,
    tile_end: int,
    windows_in: wp.array[wp.int64],  # [N]
    corners_in: wp.array[wp.vec2i],  # [N]
    first_slots_in: wp.array[wp.int64],  # [chunks + 2] pairs before the chunk
    # Out:
    cursors_out: wp.array2d[int],  # [chunks, bands + 1] where the chunk's first stretch of a band goes; scratch
    offsets_out: wp.array[wp.int64],  # [N + 1] a splat's slots
    stretches_out: wp.array2d[int],  # [R, 4] splat, first slot, begin and end of the columns
    keys_out: wp.array[wp.int64],  # [R] depth << 32 | index of the stretch
    pairs_out: wp.array2d[int],  # [chunks, bands + 1] pairs of the chunk in earlier bands
):
    deal_chunk(
        first + wp.tid(), means2d_in, conics_in, opacities_in, depths_in, chunk_size, width, height, columns, rows,
        tile_size, tile_begin, tile_end, windows_in, corners_in, first_slots_in, cursors_out, offsets_out,
        stretches_out, keys_out, pairs_out,
    )  # fmt: skip


@wp.kernel
def sort_bands(
    first: int,
    # In:
    band_begins_in: wp.array[int],  # [bands + 1]
    stretches_in: wp.array2d[int],  # [R, 4] splat, first slot, begin and end of the columns
    pairs_before_in: wp.array2d[int],  # [chunks, bands + 1] pairs of the chunk in earlier bands
    # Out:
    keys_out: wp.array[wp.int64],  # [R] depth << 32 | index of the stretch; scratch
    spare_out: wp.array[wp.int64],  # [R] scratch
    cursors_out: wp.array2d[int],  # [bands, columns] scratch
    ranges_out: wp.array[wp.vec2i],  # [T]
    splats_out: wp.array[int],  # [P] sorted by tile, then depth
    slots_out: wp.array[int],  # [P]
):
    sort_band(
        first + wp.tid(), band_begins_in, stretches_in, pairs_before_in, keys_out, spare_out, cursors_out, ranges_out,
        splats_out, slots_out,
    )  # fmt: skip
