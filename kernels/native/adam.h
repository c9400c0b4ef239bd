// Adam on one chunk of a tensor: 16 elements in one vector.
#pragma once
#include "simd.h"

// Elements of a tensor that one grid index updates. A row of `chunks` gives the tensor and the first element.
struct Chunk {
    long long tensor, begin, end;

    Chunk(int chunk, const wp::array_t<wp::int64>& sizes, const wp::array_t<wp::int64>& chunks) {
        tensor = chunks.data[2 * chunk];
        begin = chunks.data[2 * chunk + 1];
        end = begin + ADAM_CHUNK < sizes.data[tensor] ? begin + ADAM_CHUNK : sizes.data[tensor];
    }
};

static inline void adam_chunk(
    int chunk, const wp::array_t<wp::int64>& addresses, const wp::array_t<float>& factors,
    const wp::array_t<wp::int64>& sizes, const wp::array_t<wp::int64>& chunks, float one_beta1, float beta2,
    float one_beta2, float eps
) {
    FUSE_WITHIN_EXPRESSIONS
    const Chunk own = Chunk(chunk, sizes, chunks);
    float* value = (float*)addresses.data[4 * own.tensor];
    const float* gradient = (const float*)addresses.data[4 * own.tensor + 1];
    float* average = (float*)addresses.data[4 * own.tensor + 2];
    float* square = (float*)addresses.data[4 * own.tensor + 3];
    const float size = factors.data[2 * own.tensor], inverse_root = factors.data[2 * own.tensor + 1];
    const float limit = ADAM_GRADIENT_MAX;

    auto step = [&](long long at, int n) __attribute__((always_inline)) {
        vf g = load(gradient + at, n), m = load(average + at, n), v = load(square + at, n);
        const vi finite = __builtin_elementwise_abs(g) < __builtin_inff();  // NaN is kept: the caller searches for it
        g = (finite & (g > limit)) ? vf{} + limit : g;
        g = (finite & (g < -limit)) ? vf{} - limit : g;
        m = m + one_beta1 * (g - m);
        v = beta2 * v + one_beta2 * (g * g);
        vf p = load(value + at, n);
        p = p - size * m / (__builtin_elementwise_sqrt(v) * inverse_root + eps);
        store(average + at, m, n);
        store(square + at, v, n);
        store(value + at, p, n);
    };
    long long at = own.begin;
    for (; at + 16 <= own.end; at += 16) step(at, 16);
    if (at < own.end) step(at, (int)(own.end - at));
}

// Write 1 if a value of the chunk is infinite or NaN, else 0. As integers, such magnitudes exceed all finite ones.
static inline void find_non_finite_in_chunk(
    int chunk, const wp::array_t<wp::int64>& addresses, const wp::array_t<wp::int64>& sizes,
    const wp::array_t<wp::int64>& chunks, wp::array_t<int>& found
) {
    const Chunk own = Chunk(chunk, sizes, chunks);
    const unsigned* value = (const unsigned*)addresses.data[own.tensor];
    unsigned largest = 0;
    for (long long at = own.begin; at < own.end; ++at) {
        const unsigned magnitude = value[at] & 0x7fffffffu;
        largest = magnitude > largest ? magnitude : largest;
    }
    found.data[chunk] = largest >= 0x7f800000u;
}
