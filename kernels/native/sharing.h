// Sharing of a grid's chunks among threads that spin in native code, so that none of them has to be woken up.
//
// A job is an array of 64-bit numbers. STATE holds, from its top: the number of the job (24 bits), how many more
// helpers may join (8), the number of chunks (16), and the next chunk (16). Whoever raises STATE has taken a chunk, and
// with it the right to read the other numbers until it counts the chunk in DONE.
#pragma once

enum {
    STATE = 0,
    DONE = 8,    // number of chunks that are done
    AWAKE = 16,  // number of helpers that are looking for chunks
    ENTRY = 24,  // address of the compiled kernel
    BOUNDS,      // address of the chunks' launch bounds
    BOUNDS_SIZE,
    FIRSTS,     // address of the chunks' first grid indices, int
    ARGUMENTS,  // address of the kernel's arguments; the first of them is the chunk's first grid index
    ARGUMENTS_SIZE,
    CHUNKS,
    SEATS,  // how many helpers may join
    SPINS,  // number of looks in vain after which a thread gives up
};

enum { NEXT_BITS = 16, COUNT_BITS = 16, SEAT_BITS = 8 };
enum { SEAT_SHIFT = NEXT_BITS + COUNT_BITS, JOB_SHIFT = SEAT_SHIFT + SEAT_BITS };

typedef unsigned long long word;

// Wait for some ten nanoseconds.
static inline void pause_a_little() {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    __asm__ volatile("isb");
#endif
}

static inline void run_chunk(const word* job, unsigned chunk) {
    __attribute__((aligned(16))) char arguments[SHARED_ARGUMENTS];
    __builtin_memcpy(arguments, (const char*)job[ARGUMENTS], job[ARGUMENTS_SIZE]);
    __builtin_memcpy(arguments, (const int*)job[FIRSTS] + chunk, sizeof(int));
    typedef void (*Entry)(void*, void*);
    ((Entry)job[ENTRY])((char*)job[BOUNDS] + chunk * job[BOUNDS_SIZE], arguments);
}

// Take a chunk and run it; return whether there was one. ``own`` is the number of the job that the thread has joined.
static inline bool take_chunk(word* job, word& own) {
    word state = __atomic_load_n(job + STATE, __ATOMIC_SEQ_CST);
    for (;;) {
        const unsigned next = state & 0xffff, count = state >> NEXT_BITS & 0xffff;
        if (next >= count) return false;
        word then = state + 1;
        if (own != state >> JOB_SHIFT) {
            if (!(state >> SEAT_SHIFT & 0xff)) return false;
            then -= 1ull << SEAT_SHIFT;
        }
        if (__atomic_compare_exchange_n(job + STATE, &state, then, false, __ATOMIC_ACQ_REL, __ATOMIC_ACQUIRE)) {
            own = state >> JOB_SHIFT;
            run_chunk(job, next);
            __atomic_fetch_add(job + DONE, 1ull, __ATOMIC_RELEASE);
            return true;
        }
    }
}

// Run chunks of the offered job as long as there are any, then wait some microseconds for the others.
static inline void finish_chunks(const wp::array_t<wp::int64>& shared) {
    word* job = (word*)shared.data;
    for (word own = job[STATE] >> JOB_SHIFT; take_chunk(job, own);) {
    }
    for (word k = 0; k < 1000 && __atomic_load_n(job + DONE, __ATOMIC_ACQUIRE) != job[CHUNKS]; ++k) pause_a_little();
}

// Offer the chunks of a new job, and run them with the helpers if enough of these are awake. If not, the caller wakes
// some up before it finishes the job: a helper that woke up too early would sleep again.
static inline void share_chunks(const wp::array_t<wp::int64>& shared) {
    word* job = (word*)shared.data;
    const word own = ((job[STATE] >> JOB_SHIFT) + 1) & 0xffffff;
    __atomic_store_n(job + DONE, 0ull, __ATOMIC_RELAXED);
    const word state = own << JOB_SHIFT | job[SEATS] << SEAT_SHIFT | job[CHUNKS] << NEXT_BITS;
    __atomic_store_n(job + STATE, state, __ATOMIC_SEQ_CST);
    if (__atomic_load_n(job + AWAKE, __ATOMIC_SEQ_CST) >= job[SEATS]) finish_chunks(shared);
}

// Help with every job until none has come for a while.
static inline void serve_chunks(const wp::array_t<wp::int64>& shared) {
    word* job = (word*)shared.data;
    word own = ~0ull;
    __atomic_fetch_add(job + AWAKE, 1ull, __ATOMIC_SEQ_CST);
    for (word k = 0; k < job[SPINS]; ++k) {
        if (take_chunk(job, own))
            k = 0;
        else
            pause_a_little();
    }
    __atomic_fetch_sub(job + AWAKE, 1ull, __ATOMIC_SEQ_CST);
    while (take_chunk(job, own)) {
    }  // one that has just been offered
}
