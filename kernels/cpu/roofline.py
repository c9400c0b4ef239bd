"""What a CPU can do at best: fused multiply-adds from registers, and copying memory: limits to hold times against."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

CHAINS = 12
"""Independent sums of a thread: enough to hide the latency of a multiply-add, few enough to stay in registers."""

LANES = 16
BLOCK = 1 << 18
"""Floats that one grid index copies: 1 MiB."""

_MULTIPLY_ADD = (
    """
#if !defined(__CUDA_ARCH__)
    #pragma clang fp contract(on)
    typedef float vf __attribute__((vector_size(64)));
    const vf a = (vf){} + 0.999f, b = (vf){} + 0.001f;
"""
    + "".join(f"    vf s{k} = (vf){{}} + {0.1 * (k + 1):.1f}f;\n" for k in range(CHAINS))
    + "    for (int round = 0; round < rounds; ++round) {\n"
    + "".join(f"        s{k} = s{k} * a + b;\n" for k in range(CHAINS))
    + "    }\n    vf sum = "
    + " + ".join(f"s{k}" for k in range(CHAINS))
    + """;
    float total = 0.0f;
    for (int l = 0; l < 16; ++l) total += sum[l];
    values.data[index] = total;
#endif
"""
)

_COPY = """
#if !defined(__CUDA_ARCH__)
    typedef float vf __attribute__((vector_size(64)));
    const vf* from = (const vf*)(source.data + (long long)index * 262144);
    vf* to = (vf*)(target.data + (long long)index * 262144);
    // Around the cache: an ordinary store would read the line first, and a third of the traffic would not be ours.
    for (int i = 0; i < 16384; ++i) __builtin_nontemporal_store(from[i], to + i);
#endif
"""


@wp.func_native(_MULTIPLY_ADD)
def chains(index: int, rounds: int, values: wp.array[float]): ...


@wp.func_native(_COPY)
def copy_block(index: int, source: wp.array[float], target: wp.array[float]): ...


@wp.kernel
def multiply_add(
    first: int,
    # In:
    rounds: int,
    # Out:
    values_out: wp.array[float],  # [C] written, so that no compiler drops the loop
):
    chains(first + wp.tid(), rounds, values_out)


@wp.kernel
def copy(
    first: int,
    # In:
    source_in: wp.array[float],  # [B * BLOCK] aligned to 64 bytes
    # Out:
    target_out: wp.array[float],  # [B * BLOCK] aligned to 64 bytes
):
    copy_block(first + wp.tid(), source_in, target_out)
