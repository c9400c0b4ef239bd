// Products of matrices of bfloat16 pairs by the tile registers of AMX (Intel, since Sapphire Rapids).
//
// Tiles 0 to 3 hold 32 x 32 sums in float32, tiles 4 and 5 hold 32 rows of 16 pairs of the left factor, tiles 6 and 7
// hold 16 rows of 32 pairs of the right one. A tile adds the products of 16 pairs in an order of its own,
// so sums over rows depend on how the rows are cut into 16 pairs.
#pragma once
#include "network_panels.h"

enum { SIDE = 16, PAIRS = PANEL / 2 };  // rows of a tile, and 32-bit columns; pairs of the columns of a panel

#if defined(__AMX_BF16__) && defined(__AVX512F__)
enum { HAS_TILES = 1 };

// The tile registers of this thread, from here to the end of the block.
struct Tiles {
    Tiles() {
        alignas(64) unsigned char shape[64] = {1};
        for (int tile = 0; tile < 8; ++tile) {
            shape[16 + 2 * tile] = 4 * SIDE;
            shape[48 + tile] = SIDE;
        }
        __builtin_ia32_tile_loadconfig(shape);
    }
    ~Tiles() { __builtin_ia32_tilerelease(); }

    void begin(const float* sums) const {
        __builtin_ia32_tileloadd64(0, sums, 4 * PANEL);
        __builtin_ia32_tileloadd64(1, sums + SIDE, 4 * PANEL);
        __builtin_ia32_tileloadd64(2, sums + SIDE * PANEL, 4 * PANEL);
        __builtin_ia32_tileloadd64(3, sums + SIDE * PANEL + SIDE, 4 * PANEL);
    }

    // Read 32 rows of 16 pairs, row by row.
    void read_left(const unsigned* left) const {
        __builtin_ia32_tileloadd64(4, left, 4 * SIDE);
        __builtin_ia32_tileloadd64(5, left + SIDE * SIDE, 4 * SIDE);
    }

    // Read 16 rows of 32 pairs, PANEL apart.
    void read_right(const unsigned* right) const {
        __builtin_ia32_tileloadd64(6, right, 4 * PANEL);
        __builtin_ia32_tileloadd64(7, right + SIDE, 4 * PANEL);
    }

    // Add the product of the factors that were read.
    void add() const {
        __builtin_ia32_tdpbf16ps(0, 4, 6);
        __builtin_ia32_tdpbf16ps(1, 4, 7);
        __builtin_ia32_tdpbf16ps(2, 5, 6);
        __builtin_ia32_tdpbf16ps(3, 5, 7);
    }

    void add(const unsigned* left, const unsigned* right) const {
        read_left(left);
        read_right(right);
        add();
    }

    void end(float* sums) const {
        __builtin_ia32_tilestored64(0, sums, 4 * PANEL);
        __builtin_ia32_tilestored64(1, sums + SIDE, 4 * PANEL);
        __builtin_ia32_tilestored64(2, sums + SIDE * PANEL, 4 * PANEL);
        __builtin_ia32_tilestored64(3, sums + SIDE * PANEL + SIDE, 4 * PANEL);
    }
};
#else
enum { HAS_TILES = 0 };

struct Tiles {
    void begin(const float*) const {}
    void add(const unsigned*, const unsigned*) const {}
    void end(float*) const {}
};
#endif
