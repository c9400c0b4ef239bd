// Search for the K nearest nodes of 16 points, one per lane, among all nodes or in a list that provably suffices.
#pragma once
#include "simd.h"

// Candidate nodes of a block of points.
struct NodeList {
    const int* nodes;     // ascending
    int count;            // -1: no list
    const float* centre;  // coordinates of the block's centre, then the list's reach
    float shift;          // largest shift of a node since the list was made
};

// Write the neighbours of `count` points, whose indices are `rows`; `distances` may be null. Return false if every node
// was searched, because there was no list or `list` did not suffice.
static inline bool search(
    int K, const wp::array_t<float>& points, const wp::array_t<float>& nodes, const int* rows, int count,
    const NodeList* list, int* indices, float* distances
) {
    FUSE_WITHIN_EXPRESSIONS
    struct All {
        enum { value = 0 };
    };
    struct Listed {
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
    struct Eight {
        enum { value = 8 };
    };
    struct Sixteen {
        enum { value = 16 };
    };
    const int M = nodes.shape[0], D = points.shape[1];
    const float* source = points.data;
    const float* node_data = nodes.data;
    const float infinity = __builtin_inff();
    // A `dc` of 3 or 4 means as many dimensions; 2 means any number.
    auto squared = [&](auto dc, const vf* x, const float* node) -> vf {
        vf e = x[0] - node[0];
        vf s = e * e;
        if (decltype(dc)::value > 2) {
            vf e1 = x[1] - node[1], e2 = x[2] - node[2];
            s = s + e1 * e1 + e2 * e2;
            if (decltype(dc)::value == 4) {
                vf e3 = x[3] - node[3];
                s = s + e3 * e3;
            }
        } else {
            for (int d = 1; d < D; ++d) {
                e = x[d] - node[d];
                s = s + e * e;
            }
        }
        return s;
    };
    auto read = [&](auto dc, vf* x) {
        const int dims = decltype(dc)::value > 2 ? (int)decltype(dc)::value : D;
        for (int d = 0; d < dims; ++d) {
            float lanes[16];
            for (int lane = 0; lane < 16; ++lane) lanes[lane] = source[(long long)rows[lane] * D + d];
            __builtin_memcpy(&x[d], lanes, 64);
        }
    };
    auto begin_list = [&](auto kc, vf* best, vi* index) {
        constexpr int S = decltype(kc)::value;
        for (int j = 0; j < S; ++j) {
            best[j] = (vf){} + infinity;
            index[j] = (vi){} + (j < M ? j : 0);
        }
    };
    auto insert = [&](auto kc, vf* best, vi* index, vf s, int m) {  // NaN is never inserted
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
    // Search the first `total` of all nodes, or those of a list, ascending.
    auto scan = [&](auto kc, auto dc, auto listed, const vf* x, const int* list_nodes, int total, vf* best, vi* index) {
        constexpr int S = decltype(kc)::value;
        const int dims = decltype(dc)::value > 2 ? (int)decltype(dc)::value : D;
        auto number = [&](int at) { return decltype(listed)::value ? list_nodes[at] : at; };
        begin_list(kc, best, index);
        for (int start = 0; start < total; start += 256) {
            const int stop = start + 256 < total ? start + 256 : total;
            // Compute all distances of this batch, and the smallest of every sixteen nodes.
            vf d2[256], least[16];
            const int groups = (stop - start + 15) / 16;
            for (int g = 0; g < groups; ++g) {
                vf low = (vf){} + infinity;
                const int first = start + 16 * g, end = first + 16 < stop ? first + 16 : stop;
                vf* out = d2 + 16 * g;
                auto distance = [&](int m) {
                    vf s = squared(dc, x, node_data + (long long)number(first + m) * dims);
                    out[m] = s;
                    low = s < low ? s : low;
                };
                if (end - first == 16) {
#pragma clang loop unroll_count(4)
                    for (int m = 0; m < 16; ++m) distance(m);
                } else
                    for (int m = 0; m < end - first; ++m) distance(m);
                least[g] = low;
            }
            // K groups hold a node within the K-th smallest of these minima, so no farther node is among the K nearest.
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
                    insert(kc, best, index, d2[m - start], number(m));
                }
            }
        }
    };
    bool proven = false;
    auto run = [&](auto kc, auto dc) {
        constexpr int S = decltype(kc)::value;
        const int dims = decltype(dc)::value > 2 ? (int)decltype(dc)::value : D;
        vf x[decltype(dc)::value > 2 ? (int)decltype(dc)::value : MAX_DIMENSIONS], best[S];
        vi index[S];
        read(dc, x);
        if (list && list->count >= 0) {
            scan(kc, dc, Listed{}, x, list->nodes, list->count, best, index);
            vf last = best[S - 1], off = squared(dc, x, list->centre), poison = x[0] * 0.0f;
#pragma clang loop unroll(full)
            for (int j = 0; j < S; ++j) last = j == K - 1 ? best[j] : last;
            for (int d = 1; d < dims; ++d) poison = poison + x[d] * 0.0f;
            // Slack for rounding: a few units in the last place of every term, and for squares that underflow.
            vf need =
                (__builtin_elementwise_sqrt(last) + __builtin_elementwise_sqrt(off) + list->shift) * 1.00002f + 1e-15f;
            // Non-finite points are exempt: their distances are non-finite for every node, in the list or not.
            proven = __builtin_reduce_and((need < list->centre[D]) | ~(poison == 0.0f));
        }
        if (!proven) scan(kc, dc, All{}, x, nullptr, M, best, index);
        int numbers[S][16];
        __builtin_memcpy(numbers, index, sizeof(numbers));
        for (int lane = 0; lane < count; ++lane) {
#pragma clang loop vectorize(disable)
            for (int j = 0; j < K; ++j) {
                indices[(long long)rows[lane] * K + j] = numbers[j][lane];
                if (distances) distances[(long long)rows[lane] * K + j] = best[j][lane];
            }
        }
    };
    auto sized = [&](auto dc) {  // size of the sorted list, >= K
        if (K <= 3)
            run(Three{}, dc);
        else if (K == 4)
            run(Four{}, dc);
        else if (K <= 8)
            run(Eight{}, dc);
        else
            run(Sixteen{}, dc);
    };
    if (D == 3)
        sized(Three{});
    else if (D == 4)
        sized(Four{});
    else
        sized(Two{});
    return proven;
}

// Find the K nearest of all nodes for points begin to begin + 15.
static inline void nearest(
    int begin, int K, const wp::array_t<float>& points, const wp::array_t<float>& nodes, wp::array_t<int>& indices,
    wp::array_t<float>& distances
) {
    const int N = points.shape[0], count = N - begin < 16 ? N - begin : 16;
    int rows[16];
    for (int lane = 0; lane < 16; ++lane) rows[lane] = begin + (lane < count ? lane : count - 1);
    search(K, points, nodes, rows, count, nullptr, indices.data, distances.data);
}

// Find the K nearest nodes for the points of a block, from the block's list if it suffices.
static inline void nearest_listed(
    int block, int K, const wp::array_t<float>& points, const wp::array_t<float>& nodes, const wp::array_t<int>& order,
    const wp::array_t<float>& centres, const wp::array_t<int>& counts, const wp::array_t<int>& lists,
    const wp::array_t<float>& shift, wp::array_t<int>& indices, wp::array_t<int>& failed
) {
    const int N = points.shape[0], D = points.shape[1], count = N - 16 * block < 16 ? N - 16 * block : 16;
    const NodeList list = {
        lists.data + (long long)block * lists.shape[1], counts.data[block], centres.data + (long long)block * (D + 1),
        shift.data[0]
    };
    int rows[16];
    for (int lane = 0; lane < 16; ++lane) rows[lane] = order.data[16 * block + (lane < count ? lane : count - 1)];
    for (int at = 16 * (block + 1); at < 16 * (block + 2) && at < N; ++at) {  // the next block's, scattered in memory
        const char* point = (const char*)(points.data + (long long)order.data[at] * D);
        for (int byte = 0; byte < 4 * D; byte += 64) __builtin_prefetch(point + byte);
        __builtin_prefetch(indices.data + (long long)order.data[at] * K, 1);
    }
    const bool proven = search(K, points, nodes, rows, count, &list, indices.data, nullptr);
    failed.data[block] = list.count >= 0 && !proven;
}
