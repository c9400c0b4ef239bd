// Loops that reach a CPU's limits: fused multiply-adds in registers, and memory copies.
#pragma once
#include "simd.h"

static inline void multiply_add_chains(int index, int rounds, wp::array_t<float>& values) {
    FUSE_WITHIN_EXPRESSIONS
    const vf a = vf{} + 0.999f, b = vf{} + 0.001f;
    vf chain[ROOFLINE_CHAINS];
    for (int k = 0; k < ROOFLINE_CHAINS; ++k) chain[k] = vf{} + (float)(0.1 * (k + 1));
    for (int round = 0; round < rounds; ++round)
        for (int k = 0; k < ROOFLINE_CHAINS; ++k) chain[k] = chain[k] * a + b;
    vf sum = chain[0];
    for (int k = 1; k < ROOFLINE_CHAINS; ++k) sum = sum + chain[k];
    float total = 0.0f;
    for (int l = 0; l < 16; ++l) total += sum[l];
    values.data[index] = total;
}

static inline void copy_block(int index, const wp::array_t<float>& source, wp::array_t<float>& target) {
    const vf* from = (const vf*)(source.data + (long long)index * ROOFLINE_BLOCK);
    vf* to = (vf*)(target.data + (long long)index * ROOFLINE_BLOCK);
    // Bypass the cache: an ordinary store would first read the line, a third of the traffic.
    for (int i = 0; i < ROOFLINE_BLOCK / 16; ++i) __builtin_nontemporal_store(from[i], to + i);
}
