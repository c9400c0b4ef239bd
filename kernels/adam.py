"""Adam (Kingma and Ba 2015, algorithm 1) over many tensors in one launch, and a look for values that are not finite.

Tensors are named by address: a launch reads a table with one row a tensor and a list of chunks, so that 30 tensors cost
one launch, and each value is read once and written once. The forms in SIMD (CPU) take a chunk a grid index; the plain
one takes an element a grid index, the last chunk of a tensor being padded, and serves any device.
"""

from __future__ import annotations

import warp as wp

from .cpu.simd import SIMD

wp.set_module_options({"enable_backward": False})

CHUNK = 4096
"""Elements of a chunk."""
LARGEST = wp.constant(1.0e19)
"""A gradient beyond this counts as this: its square would overflow, and the value never move again."""
_CHUNK = wp.constant(CHUNK)

_STEP = """
        vf g = load(gradient + at, n), m = load(average + at, n), v = load(square + at, n);
        const vi finite = __builtin_elementwise_abs(g) < __builtin_inff();  // what is not is the caller's to find
        g = (finite & (g > LARGEST)) ? ZERO + LARGEST : g;
        g = (finite & (g < -LARGEST)) ? ZERO - LARGEST : g;
        m = m + one_beta1 * (g - m);
        v = beta2 * v + one_beta2 * (g * g);
        vf p = load(value + at, n);
        p = p - size * m / (__builtin_elementwise_sqrt(v) * inverse_root + eps);
        store(average + at, m, n);
        store(square + at, v, n);
        store(value + at, p, n);
"""

_ADAM = f"""
#if !defined(__CUDA_ARCH__)
    {SIMD}
    const float LARGEST = {float(LARGEST)!r}f;
    const long long tensor = chunks.data[2 * chunk], begin = chunks.data[2 * chunk + 1];
    float* value = (float*)addresses.data[4 * tensor];
    const float* gradient = (const float*)addresses.data[4 * tensor + 1];
    float* average = (float*)addresses.data[4 * tensor + 2];
    float* square = (float*)addresses.data[4 * tensor + 3];
    const float size = factors.data[2 * tensor], inverse_root = factors.data[2 * tensor + 1];
    const long long end = begin + {CHUNK} < sizes.data[tensor] ? begin + {CHUNK} : sizes.data[tensor];
    long long at = begin;
    for (; at + 16 <= end; at += 16) {{
        const int n = 16;
        {_STEP}
    }}
    if (at < end) {{
        const int n = (int)(end - at);
        {_STEP}
    }}
#endif
"""

_FINITE = f"""
#if !defined(__CUDA_ARCH__)
    const long long tensor = chunks.data[2 * chunk], begin = chunks.data[2 * chunk + 1];
    const unsigned* value = (const unsigned*)addresses.data[tensor];
    const long long end = begin + {CHUNK} < sizes.data[tensor] ? begin + {CHUNK} : sizes.data[tensor];
    unsigned largest = 0;  // of magnitudes as integers: an infinity or a NaN exceeds every finite one
    for (long long at = begin; at < end; ++at) {{
        const unsigned magnitude = value[at] & 0x7fffffffu;
        largest = magnitude > largest ? magnitude : largest;
    }}
    return largest >= 0x7f800000u;
#else
    return 0;
#endif
"""


@wp.func_native(_ADAM)
def _adam_chunk(
    chunk: int,
    addresses: wp.array2d[wp.int64],
    factors: wp.array2d[float],
    sizes: wp.array[wp.int64],
    chunks: wp.array2d[wp.int64],
    one_beta1: float,
    beta2: float,
    one_beta2: float,
    eps: float,
): ...


@wp.func_native(_FINITE)
def _chunk_is_bad(
    chunk: int,
    addresses: wp.array[wp.int64],
    sizes: wp.array[wp.int64],
    chunks: wp.array2d[wp.int64],
) -> int: ...


@wp.kernel
def adam_chunks(
    first: int,
    # In:
    addresses_in: wp.array2d[wp.int64],  # [T, 4] of values, gradients, first and second moments
    factors_in: wp.array2d[float],  # [T, 2] rate / (1 - beta1^t), 1 / sqrt(1 - beta2^t)
    sizes_in: wp.array[wp.int64],  # [T] elements
    chunks_in: wp.array2d[wp.int64],  # [C, 2] tensor, first element
    one_beta1: float,  # 1 - beta1
    beta2: float,
    one_beta2: float,  # 1 - beta2
    eps: float,
):
    """One step; values and moments are changed in place. Grid: C. CPU only."""
    _adam_chunk(first + wp.tid(), addresses_in, factors_in, sizes_in, chunks_in, one_beta1, beta2, one_beta2, eps)


@wp.kernel
def adam(
    first: int,
    # In:
    addresses_in: wp.array2d[wp.int64],  # [T, 4] of values, gradients, first and second moments
    factors_in: wp.array2d[float],  # [T, 2] rate / (1 - beta1^t), 1 / sqrt(1 - beta2^t)
    sizes_in: wp.array[wp.int64],  # [T] elements
    chunks_in: wp.array2d[wp.int64],  # [C, 2] tensor, first element
    one_beta1: float,  # 1 - beta1
    beta2: float,
    one_beta2: float,  # 1 - beta2
    eps: float,
):
    """As ``adam_chunks``. Grid: C x CHUNK."""
    i = first + wp.tid()
    chunk = i // _CHUNK
    tensor = int(chunks_in[chunk, 0])
    at = int(chunks_in[chunk, 1]) + i - chunk * _CHUNK
    size = int(sizes_in[tensor])
    if at >= size:
        return
    values = wp.array(ptr=wp.uint64(addresses_in[tensor, 0]), shape=(size,), dtype=float)
    gradients = wp.array(ptr=wp.uint64(addresses_in[tensor, 1]), shape=(size,), dtype=float)
    averages = wp.array(ptr=wp.uint64(addresses_in[tensor, 2]), shape=(size,), dtype=float)
    squares = wp.array(ptr=wp.uint64(addresses_in[tensor, 3]), shape=(size,), dtype=float)
    g = gradients[at]
    if wp.isfinite(g):  # what is not is the caller's to find
        g = wp.clamp(g, -LARGEST, LARGEST)
    m = averages[at] + one_beta1 * (g - averages[at])
    v = beta2 * squares[at] + one_beta2 * (g * g)
    averages[at] = m
    squares[at] = v
    values[at] = values[at] - factors_in[tensor, 0] * m / (wp.sqrt(v) * factors_in[tensor, 1] + eps)


@wp.kernel
def find_bad_chunks(
    first: int,
    # In:
    addresses_in: wp.array[wp.int64],  # [T]
    sizes_in: wp.array[wp.int64],  # [T] elements
    chunks_in: wp.array2d[wp.int64],  # [C, 2] tensor, first element
    # Out:
    bad_out: wp.array[int],  # [C] 1 where a value of the chunk is not finite, else 0
):
    """Grid: C. CPU only."""
    i = first + wp.tid()
    bad_out[i] = _chunk_is_bad(i, addresses_in, sizes_in, chunks_in)
