// A block of 256 CUDA threads as fibres on one CPU thread, so that a native body can be tested without a GPU.
//
// A fibre runs until a barrier or an exchange that others have not reached yet. In which order fibres get their turn
// is drawn from a seed: a body that misses a barrier gives other results for other seeds.
#pragma once
#include <setjmp.h>
#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <memory>
#include <random>
#include <vector>

namespace wp {
struct vec2 { float c[2]; };
struct vec3 { float c[3]; };
struct vec2i { int c[2]; };
struct Shape { int dims[4]; };
template <typename T> struct array_t { T* data; Shape shape; };
}  // namespace wp

struct float4 { float x, y, z, w; };
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }

namespace shim {
constexpr int THREADS = 256, STACK = 1 << 16;

struct Barrier {
    int arrived = 0;
    long generation = 0;
};
// A fibre is entered by setcontext and then left and resumed by _longjmp, since swapcontext costs two system calls.
struct Fibre {
    ucontext_t context;
    jmp_buf resume;
    bool entered = false;
    long turn = 0;  // exchanges so far: two buffers take turns, nobody can be two ahead
    bool done = false;
};
struct Block {
    Fibre fibres[THREADS];
    Barrier all, warps[8];
    unsigned values[2][THREADS];
    jmp_buf turn_over;
    int current = 0;
    long events = 0;
    void (*enter)(void*) = nullptr;
    void* argument = nullptr;
};
inline Block* block = nullptr;

// The stacks of all fibres, kept from block to block: new memory costs more than most blocks take to run.
inline char* stacks() {
    static const std::unique_ptr<char[]> all(new char[THREADS * STACK]);
    return all.get();
}

inline void wait(Barrier& barrier, int size) {
    const long generation = barrier.generation;
    if (++barrier.arrived == size) {
        barrier.arrived = 0;
        ++barrier.generation;
        ++block->events;
    }
    while (barrier.generation == generation) {
        Fibre& own = block->fibres[block->current];
        if (!_setjmp(own.resume)) _longjmp(block->turn_over, 1);
    }
}

// What every thread of the group gave; valid until the group's exchange after the next.
inline const unsigned* exchange(unsigned value, Barrier& barrier, int size) {
    const int me = block->current;
    unsigned* values = block->values[block->fibres[me].turn++ & 1];
    values[me] = value;
    wait(barrier, size);
    return values + me / size * size;
}

inline const unsigned* warp_exchange(unsigned mask, unsigned value) {
    if (mask != 0xffffffffu) std::fprintf(stderr, "cuda_shim: only full masks\n"), std::abort();
    return exchange(value, block->warps[block->current / 32], 32);
}

inline void start() {
    block->enter(block->argument);
    block->fibres[block->current].done = true;
    ++block->events;
    _longjmp(block->turn_over, 1);
}

// Runs a fibre until it waits or ends.
inline void resume(Fibre& fibre) {
    if (_setjmp(block->turn_over)) return;
    if (fibre.entered) _longjmp(fibre.resume, 1);
    fibre.entered = true;
    setcontext(&fibre.context);
}

// Runs body() on all threads of one block; false: they wait for each other for ever.
template <typename Body> bool run_block(Body body, std::mt19937& random) {
    auto state = std::make_unique<Block>();
    block = state.get();
    block->enter = [](void* at) { (*(Body*)at)(); };
    block->argument = &body;
    int order[THREADS];
    for (int i = 0; i < THREADS; ++i) {
        Fibre& fibre = block->fibres[i];
        order[i] = i;
        getcontext(&fibre.context);
        fibre.context.uc_stack.ss_sp = stacks() + i * STACK;
        fibre.context.uc_stack.ss_size = STACK;
        fibre.context.uc_link = nullptr;
        makecontext(&fibre.context, start, 0);
    }
    for (int left = THREADS; left > 0;) {
        std::shuffle(order, order + THREADS, random);
        const long before = block->events;
        left = 0;
        for (int i : order) {
            if (block->fibres[i].done) continue;
            block->current = i;
            resume(block->fibres[i]);
            left += !block->fibres[i].done;
        }
        if (left > 0 && block->events == before) return false;
    }
    return true;
}
struct Index {
    int x;
};
}  // namespace shim

#define __CUDA_ARCH__ 900
#define __device__
#define __shared__ static
#define threadIdx (shim::Index{shim::block->current})

inline void __syncthreads() { shim::wait(shim::block->all, shim::THREADS); }
inline int __syncthreads_count(bool value) {
    const unsigned* values = shim::exchange(value, shim::block->all, shim::THREADS);
    int count = 0;
    for (int i = 0; i < shim::THREADS; ++i) count += values[i] != 0;
    return count;
}
inline unsigned __ballot_sync(unsigned mask, unsigned value) {
    const unsigned* values = shim::warp_exchange(mask, value);
    unsigned bits = 0u;
    for (int i = 0; i < 32; ++i) bits |= unsigned(values[i] != 0) << i;
    return bits;
}
inline bool __any_sync(unsigned mask, bool value) { return __ballot_sync(mask, value) != 0; }
template <typename T> T __shfl_xor_sync(unsigned mask, T value, int step) {
    static_assert(sizeof(T) == 4, "four bytes");
    unsigned bits;
    std::memcpy(&bits, &value, 4);
    const int lane = shim::block->current & 31;
    bits = shim::warp_exchange(mask, bits)[lane ^ step];
    std::memcpy(&value, &bits, 4);
    return value;
}
inline int __ffs(unsigned bits) { return __builtin_ffs((int)bits); }
inline int __clz(unsigned bits) { return bits ? __builtin_clz(bits) : 32; }
inline float __fdividef(float a, float b) { return a / b; }
