"""Native snippets for CPU kernels: vectors of 16 floats and what the bodies that use them share.

To be put at the start of a ``@wp.func_native`` body, inside ``#if !defined(__CUDA_ARCH__)``. Clang's vector types
compile for every CPU: one AVX-512 register, two AVX2 ones, four NEON ones. ``SIMD`` defines

- ``vf``, ``vi``, ``vu``, ``vs``: 16 floats, ints, unsigned ints, and 32 shorts; ``LANE`` (0, 1, ... 15) and ``ZERO``;
- ``bits(mask)``: one bit a lane; ``load`` and ``store`` of the first n lanes; ``exp2v``.

``LANE_SUMS`` adds ``lane_sums(v)``: the sums over the lanes of 16 vectors, in one vector.
"""

from __future__ import annotations

SIMD = """
    // Multiply and add are fused within an expression, and only there: the same source rounds alike everywhere.
    #pragma clang fp contract(on)
    typedef float vf __attribute__((vector_size(64)));
    typedef int vi __attribute__((vector_size(64)));
    typedef unsigned vu __attribute__((vector_size(64)));
    typedef short vs __attribute__((vector_size(64)));
    typedef bool vb __attribute__((ext_vector_type(16)));
    typedef bool vb32 __attribute__((ext_vector_type(32)));
    const vf LANE = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    const vf ZERO = {};

    auto bits = [](vi mask) -> unsigned {
        return __builtin_bit_cast(unsigned short, __builtin_convertvector(mask, vb));
    };
    auto load = [](const float* from, int n) -> vf {
        vf v = {};
        if (n == 16) __builtin_memcpy(&v, from, 64);
        else for (int k = 0; k < n; ++k) v[k] = from[k];
        return v;
    };
    auto store = [](float* to, vf v, int n) {
        if (n == 16) __builtin_memcpy(to, &v, 64);
        else for (int k = 0; k < n; ++k) to[k] = v[k];
    };
    // 2^e for e in [-8, 0] (garbage below, masked by the caller): nearest integer by the magic number, then a
    // polynomial on [-1/2, 1/2] of relative error 9e-8.
    auto exp2v = [](vf e) -> vf {
        vf t = e + 12582912.0f;
        vf f = e - (t - 12582912.0f);
        vf r = f * 0.00132647f + 0.00967151f;
        r = r * f + 0.05550734f;
        r = r * f + 0.24022242f;
        r = r * f + 0.69314698f;
        r = r * f + 1.0f;
        return (vf)((vu)r + ((vu)t << 23));
    };
"""

LANE_SUMS = """
    // The sums of 16 vectors' lanes in one vector: halves are folded together pair by pair, four times.
    auto fold8 = [](vf a, vf b) -> vf {
        return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23)
            + __builtin_shufflevector(a, b, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
    };
    auto fold4 = [](vf a, vf b) -> vf {
        return __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27)
            + __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31);
    };
    auto fold2 = [](vf a, vf b) -> vf {
        return __builtin_shufflevector(a, b, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29)
            + __builtin_shufflevector(a, b, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
    };
    auto fold1 = [](vf a, vf b) -> vf {
        return __builtin_shufflevector(a, b, 0, 2, 16, 18, 4, 6, 20, 22, 8, 10, 24, 26, 12, 14, 28, 30)
            + __builtin_shufflevector(a, b, 1, 3, 17, 19, 5, 7, 21, 23, 9, 11, 25, 27, 13, 15, 29, 31);
    };
    auto lane_sums = [&](const vf* v) -> vf {
        vf part[4];  // the k-th holds 0 + k, 4 + k, ... so that the sums come out in order
        for (int k = 0; k < 4; ++k) part[k] = fold4(fold8(v[k], v[4 + k]), fold8(v[8 + k], v[12 + k]));
        return fold1(fold2(part[0], part[1]), fold2(part[2], part[3]));
    };
"""
