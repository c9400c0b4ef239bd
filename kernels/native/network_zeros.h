// Products of matrices most of whose numbers are zero: the outputs of a ReLU, and gradients before one.
//
// In trained networks about 80 % of the hidden values are zero, and half of the columns are zero in all rows of a tile
// (benchmarks/network_zeros.py). Leaving these columns out changes no sum: a product with zero adds zero, unless the
// other factor is not finite, so a layer with such weights is computed in full.
#pragma once
#include "network_panels.h"

enum {
    MOST_COLUMNS = 1024,                 // a wider matrix is read in full
    BLOCK_TILES = NETWORK_BLOCK / ROWS,  // tiles of a block of rows
};

// The columns of a tile of ROWS rows that are not zero, in ascending order.
struct NonzeroColumns {
    struct Column {
        unsigned left, right;  // where it is in the tile, and where its row is in the right factor
    };
    int count;
    Column at[MOST_COLUMNS];

    // Return whether leaving out the other columns saves more time than their numbers cost.
    bool worth_reading(int columns) const { return 8 * count <= 7 * columns; }
};

// Return a function that lists the columns of a tile. The matrix has panels of ``width`` words of 32 bits, ``apart``
// words apart, and ``tile`` points at the first word of the first row. The rows of the right factor are PANEL apart.
static inline auto columns_of() {
    return [](NonzeroColumns& columns, const void* tile, long long apart, int panels, auto width) {
        int count = 0;
        for (int q = 0; q < panels; ++q)
            for (int c = 0; c < width.value; c += 16) {
                vu any = {};
                for (int r = 0; r < ROWS; ++r) {
                    vu row;
                    __builtin_memcpy(&row, (const unsigned*)tile + q * apart + r * width.value + c, sizeof(row));
                    any |= row & 0x7fffffffu;
                }
                const unsigned set = bits(any != 0u);
                for (int j = 0; j < 16; ++j) {
                    columns.at[count].left = (unsigned)(q * apart) + c + j;
                    columns.at[count].right = (q * width.value + c + j) * PANEL;
                    count += set >> j & 1;
                }
            }
        columns.count = count;
    };
}

// Return whether a layer's sums may leave out zeros: its weights are finite, and its columns can be listed.
static inline bool may_leave_out(const wp::array_t<int>& finite, int layer, int columns) {
    int all = columns <= MOST_COLUMNS;
    for (int p = 0; p < finite.shape.dims[1]; ++p) all &= finite.data[(long long)layer * finite.shape.dims[1] + p];
    return all;
}

// The product of two numbers, as a type.
struct Numbers {
    typedef vn row;
    typedef vnu unaligned;
    __attribute__((always_inline)) static vn add(vn sum, float a, vn b) {
        FUSE_WITHIN_EXPRESSIONS
        return sum + a * b;
    }
};

// Return a function like ``accumulation`` for the listed columns of a tile.
static inline auto listed_accumulation() {
    return
        [](auto& sums, const auto* tile, auto width, const auto* right, const NonzeroColumns& columns, auto product) {
            typedef decltype(product) Product;
            constexpr int V = sizeof(sums[0]) / sizeof(vn);
            vn acc[ROWS][V];
#pragma clang loop unroll(full)
            for (int r = 0; r < ROWS; ++r)
#pragma clang loop unroll(full)
                for (int v = 0; v < V; ++v) acc[r][v] = sums[r][v];
            for (const auto *column = columns.at, *end = column + columns.count; column < end; ++column) {
                const auto *from = tile + column->left, *row = right + column->right;
                typename Product::row b[V];
#pragma clang loop unroll(full)
                for (int v = 0; v < V; ++v) b[v] = *(const typename Product::unaligned*)(row + v * LANES);
#pragma clang loop unroll(full)
                for (int r = 0; r < ROWS; ++r) {
                    const auto a = from[r * width.value];
#pragma clang loop unroll(full)
                    for (int v = 0; v < V; ++v) acc[r][v] = Product::add(acc[r][v], a, b[v]);
                }
            }
#pragma clang loop unroll(full)
            for (int r = 0; r < ROWS; ++r)
#pragma clang loop unroll(full)
                for (int v = 0; v < V; ++v) sums[r][v] = acc[r][v];
        };
}
