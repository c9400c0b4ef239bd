"""The search for the K nearest control points on a CPU: sixteen points a thread, as lanes of SIMD registers.

``nearest_lanes`` looks at every node. ``nearest_listed`` looks at those that a block of sixteen Gaussians, close
together in space, had within reach when ``list_blocks`` ran, and proves that nothing else matters: a node outside the
list was at least ``reach`` from the block's centre c, and has come closer by no more than the largest shift of any node
since. So if ``|x - c| + d_K + shift < reach``, the K nearest are in the list; a block with a lane for which this does
not hold is searched in full. Both visit nodes in ascending order, compute distances by the same expression and insert
on a strict ``<``: they give the same indices, ties included, whatever the lists.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LANES = wp.constant(16)
"""Points a grid index handles: a block."""
MAX_DIMENSIONS = 64
"""Above this many dimensions there is no room for the points' lanes; the plain kernel takes any."""

_TYPES = """
    // Multiply and add are fused within an expression, and only there: every search computes the same distances.
    #pragma clang fp contract(on)
    typedef float vf __attribute__((vector_size(64)));
    typedef int vi __attribute__((vector_size(64)));
    struct Two { enum { value = 2 }; }; struct Three { enum { value = 3 }; }; struct Four { enum { value = 4 }; };
    struct Eight { enum { value = 8 }; }; struct Sixteen { enum { value = 16 }; };
    const int N = points.shape[0], M = nodes.shape[0], D = points.shape[1];
    const float* source = points.data;
    const float* node_data = nodes.data;
    const float infinity = __builtin_inff();
    // A template argument of 3 means three dimensions, 2 any number.
    auto squared = [&](auto dc, const vf* x, const float* node) -> vf {
        vf e = x[0] - node[0];
        vf s = e * e;
        if (decltype(dc)::value == 3) {
            vf e1 = x[1] - node[1], e2 = x[2] - node[2];
            s = s + e1 * e1 + e2 * e2;
        } else {
            for (int d = 1; d < D; ++d) { e = x[d] - node[d]; s = s + e * e; }
        }
        return s;
    };
    auto dispatch = [&](auto search) {
        auto sized = [&](auto dc) {  // size of the sorted list, >= K
            if (K <= 3) search(Three{}, dc);
            else if (K == 4) search(Four{}, dc);
            else if (K <= 8) search(Eight{}, dc);
            else search(Sixteen{}, dc);
        };
        if (D == 3) sized(Three{});
        else sized(Two{});
    };
    auto read = [&](auto dc, vf* x, const int* rows) {
        const int dims = decltype(dc)::value == 3 ? 3 : D;
        for (int d = 0; d < dims; ++d) {
            float lanes[16];
            for (int lane = 0; lane < 16; ++lane) lanes[lane] = source[(long long)rows[lane] * D + d];
            __builtin_memcpy(&x[d], lanes, 64);
        }
    };
    auto begin_list = [&](auto kc, vf* best, vi* index) {
        constexpr int S = decltype(kc)::value;
        for (int j = 0; j < S; ++j) { best[j] = (vf){} + infinity; index[j] = (vi){} + (j < M ? j : 0); }
    };
    auto insert = [&](auto kc, vf* best, vi* index, vf s, int m) {  // a NaN is never inserted
        constexpr int S = decltype(kc)::value;
        const vi number = (vi){} + m;
        #pragma clang loop unroll(full)
        for (int j = S - 1; j > 0; --j) {
            vi here = s < best[j], before = s < best[j - 1];
            index[j] = before ? index[j - 1] : (here ? number : index[j]);
            best[j] = before ? best[j - 1] : (here ? s : best[j]);
        }
        vi here = s < best[0];
        index[0] = here ? number : index[0];
        best[0] = here ? s : best[0];
    };
    auto scan = [&](auto kc, auto dc, const vf* x, vf* best, vi* index) {
        constexpr int S = decltype(kc)::value;
        const int dims = decltype(dc)::value == 3 ? 3 : D;
        begin_list(kc, best, index);
        for (int start = 0; start < M; start += 256) {
            const int stop = start + 256 < M ? start + 256 : M;
            // All distances of this batch, and the least of every sixteen nodes.
            vf d2[256], least[16];
            const int groups = (stop - start + 15) / 16;
            for (int g = 0; g < groups; ++g) {
                vf low = (vf){} + infinity;
                const int end = start + 16 * g + 16 < stop ? start + 16 * g + 16 : stop;
                const float* node = node_data + (start + 16ll * g) * dims;
                vf* out = d2 + 16 * g;
                auto distance = [&](int m) {
                    vf s = squared(dc, x, node + m * dims);
                    out[m] = s;
                    low = s < low ? s : low;
                };
                if (end - start - 16 * g == 16) {
                    #pragma clang loop unroll_count(4)
                    for (int m = 0; m < 16; ++m) distance(m);
                } else
                    for (int m = 0; m < end - start - 16 * g; ++m) distance(m);
                least[g] = low;
            }
            // K groups hold a node within the K-th least of these: nothing beyond it can be among the K nearest.
            vf bound[S];
            for (int j = 0; j < S; ++j) bound[j] = best[j];
            for (int g = 0; g < groups; ++g) {
                vf low = least[g];
                #pragma clang loop unroll(full)
                for (int j = 0; j < S; ++j) {
                    vi under = low < bound[j];
                    vf kept = under ? low : bound[j];
                    low = under ? bound[j] : low;
                    bound[j] = kept;
                }
            }
            const vf limit = bound[S - 1];
            for (int g = 0; g < groups; ++g) {
                if (!__builtin_reduce_or(least[g] <= limit)) continue;
                const int end = start + 16 * g + 16 < stop ? start + 16 * g + 16 : stop;
                unsigned found = 0;
                for (int m = start + 16 * g; m < end; ++m)
                    found |= (unsigned)(__builtin_reduce_or(d2[m - start] <= limit) != 0) << (m - start - 16 * g);
                for (; found; found &= found - 1) {
                    const int m = start + 16 * g + __builtin_ctz(found);
                    insert(kc, best, index, d2[m - start], m);
                }
            }
        }
    };
"""

_NEAREST = (
    """
#if !defined(__CUDA_ARCH__)
{
"""
    + _TYPES
    + """
    const int count = N - begin < 16 ? N - begin : 16;
    int rows[16];
    for (int lane = 0; lane < 16; ++lane) rows[lane] = begin + (lane < count ? lane : count - 1);
    dispatch([&](auto kc, auto dc) {
        vf x[decltype(dc)::value == 3 ? 3 : 64], best[decltype(kc)::value];
        vi index[decltype(kc)::value];
        read(dc, x, rows);
        scan(kc, dc, x, best, index);
        for (int lane = 0; lane < count; ++lane)
            for (int j = 0; j < K; ++j) {
                indices.data[(long long)rows[lane] * K + j] = index[j][lane];
                distances.data[(long long)rows[lane] * K + j] = best[j][lane];
            }
    });
}
#endif
"""
)

_LISTED = (
    """
#if !defined(__CUDA_ARCH__)
{
"""
    + _TYPES
    + """
    const int count = N - 16 * block < 16 ? N - 16 * block : 16, listed = counts.data[block];
    const int* list = lists.data + (long long)block * lists.shape[1];
    const float* centre = centres.data + (long long)block * (D + 1);
    int rows[16];
    for (int lane = 0; lane < 16; ++lane) rows[lane] = order.data[16 * block + (lane < count ? lane : count - 1)];
    dispatch([&](auto kc, auto dc) {
        constexpr int S = decltype(kc)::value;
        vf x[decltype(dc)::value == 3 ? 3 : 64], best[S];
        vi index[S];
        read(dc, x, rows);
        int proven = 0;
        if (listed >= 0) {
            begin_list(kc, best, index);
            const int dims = decltype(dc)::value == 3 ? 3 : D;
            for (int at = 0; at < listed; ++at) {
                vf s = squared(dc, x, node_data + (long long)list[at] * dims);
                if (__builtin_reduce_or(s < best[S - 1])) insert(kc, best, index, s, list[at]);
            }
            vf last = best[S - 1], off = squared(dc, x, centre), poison = x[0] * 0.0f;
            #pragma clang loop unroll(full)
            for (int j = 0; j < S; ++j) last = j == K - 1 ? best[j] : last;
            for (int d = 1; d < dims; ++d) poison = poison + x[d] * 0.0f;
            // Slack for rounding: a few units in the last place of every term, and for squares that underflow.
            vf need = (__builtin_elementwise_sqrt(last) + __builtin_elementwise_sqrt(off) + shift.data[0]) * 1.00002f
                + 1e-15f;
            // A point that is not finite is no distance from any node, in the list or not.
            proven = __builtin_reduce_and((need < centre[D]) | ~(poison == 0.0f));
        }
        failed.data[block] = listed >= 0 && !proven;
        if (!proven) scan(kc, dc, x, best, index);
        int numbers[16][16];
        for (int j = 0; j < S; ++j) __builtin_memcpy(numbers[j], &index[j], 64);
        for (int lane = 0; lane < count; ++lane) {
            #pragma clang loop vectorize(disable)
            for (int j = 0; j < K; ++j) indices.data[(long long)rows[lane] * K + j] = numbers[j][lane];
        }
    });
}
#endif
"""
)


@wp.func_native(_NEAREST)
def _nearest_lanes(
    begin: int,
    K: int,
    points: wp.array2d[float],
    nodes: wp.array2d[float],
    indices: wp.array2d[wp.int32],
    distances: wp.array2d[float],
): ...


@wp.func_native(_LISTED)
def _nearest_listed(
    block: int, K: int, points: wp.array2d[float], nodes: wp.array2d[float], order: wp.array[wp.int32],
    centres: wp.array2d[float], counts: wp.array[wp.int32], lists: wp.array2d[wp.int32], shift: wp.array[float],
    indices: wp.array2d[wp.int32], failed: wp.array[wp.int32],
): ...  # fmt: skip


@wp.kernel
def nearest_lanes(
    first: int,
    # In:
    points_in: wp.array2d[float],  # [N, D], D <= MAX_DIMENSIONS
    nodes_in: wp.array2d[float],  # [M, D]
    K: int,  # <= MAX_NEIGHBORS
    # Out:
    indices_out: wp.array2d[wp.int32],  # [N, K] nearest first
    distances_out: wp.array2d[float],  # [N, K] squared
):
    """K nearest nodes of points ``16 i .. 16 i + 15``."""
    block = first + wp.tid()
    _nearest_lanes(block * LANES, K, points_in, nodes_in, indices_out, distances_out)


@wp.kernel
def nearest_listed(
    first: int,
    # In:
    points_in: wp.array2d[float],  # [N, D], D <= MAX_DIMENSIONS
    nodes_in: wp.array2d[float],  # [M, D]
    K: int,  # <= MAX_NEIGHBORS
    order_in: wp.array[wp.int32],  # [N] points of block i: order[16 i ..]
    centres_in: wp.array2d[float],  # [blocks, D + 1] centre, then how far the list reaches
    counts_in: wp.array[wp.int32],  # [blocks] nodes in the list, -1 where there is none
    lists_in: wp.array2d[wp.int32],  # [blocks, room] ascending
    shift_in: wp.array[float],  # [1] largest shift of a node since the lists were made
    # Out:
    indices_out: wp.array2d[wp.int32],  # [N, K] nearest first
    failed_out: wp.array[wp.int32],  # [blocks] 1 where the list did not suffice
):
    """K nearest nodes of the points of block ``i``, exact."""
    block = first + wp.tid()
    _nearest_listed(
        block, K, points_in, nodes_in, order_in, centres_in, counts_in, lists_in, shift_in, indices_out, failed_out
    )
