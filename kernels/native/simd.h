// Vectors of 16 floats for CPU kernels. Clang's vector types compile for every CPU: one AVX-512 register, two AVX2
// ones, four NEON ones.
#pragma once

typedef float vf __attribute__((vector_size(64)));
typedef double vd __attribute__((vector_size(128)));
typedef int vi __attribute__((vector_size(64)));
typedef unsigned vu __attribute__((vector_size(64)));
typedef short vs __attribute__((vector_size(64)));
typedef bool vb __attribute__((ext_vector_type(16)));
typedef bool vb32 __attribute__((ext_vector_type(32)));

// Attribute for functions that loop up to one of their arguments, such as a number of columns: inlined calls unroll the
// loop.
#define ALWAYS_INLINE __attribute__((always_inline)) static inline

// First statement of every function that computes. Multiplications and additions are fused within an expression only,
// so that the same source rounds alike everywhere.
#define FUSE_WITHIN_EXPRESSIONS _Pragma("clang fp contract(on)")

// Instead of it: nothing is fused, as in the portable form.
#define NO_FUSING _Pragma("clang fp contract(off)")

// 0, 1, ... 15.
static inline vf lane_numbers() { return vf{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}; }

// Return one bit for each lane of a comparison's result.
static inline unsigned bits(vi mask) { return __builtin_bit_cast(unsigned short, __builtin_convertvector(mask, vb)); }

ALWAYS_INLINE vi finite(vf v) { return __builtin_elementwise_abs(v) < __builtin_inff(); }

// Load the first n floats, with zeros behind them.
static inline vf load(const float* from, int n) {
    vf v = {};
    if (n == 16)
        __builtin_memcpy(&v, from, 64);
    else
        for (int k = 0; k < n; ++k) v[k] = from[k];
    return v;
}

// Store the first n lanes.
static inline void store(float* to, vf v, int n) {
    if (n == 16)
        __builtin_memcpy(to, &v, 64);
    else
        for (int k = 0; k < n; ++k) to[k] = v[k];
}

// Return 2^e for e in [-8, 0]; smaller e give garbage, which the caller masks. A magic number splits off the nearest
// integer; a polynomial on [-1/2, 1/2], of relative error 9e-8, does the rest.
static inline vf exp2v(vf e) {
    FUSE_WITHIN_EXPRESSIONS
    vf t = e + 12582912.0f;
    vf f = e - (t - 12582912.0f);
    vf r = f * 0.00132647f + 0.00967151f;
    r = r * f + 0.05550734f;
    r = r * f + 0.24022242f;
    r = r * f + 0.69314698f;
    r = r * f + 1.0f;
    return (vf)((vu)r + ((vu)t << 23));
}
