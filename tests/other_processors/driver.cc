// Run the kernels of one module for another process, which lays out memory in a shared file.
//
// Arguments: the file and its size. Standard output first carries the address of the file in this process. For every
// index of an entry point on standard input, the entry point runs, and a byte on standard output says that it is done.
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <unistd.h>

#define ENTRY(name) extern "C" void name(void* bounds, void* arguments);
ENTRIES
#undef ENTRY

#define ENTRY(name) name,
static void (*const entries[])(void*, void*) = {ENTRIES};

// What Warp's compiled code expects of the process that loads it.
extern "C" int _wp_isfinite(double x) { return __builtin_isfinite(x); }
extern "C" int _wp_isnan(double x) { return __builtin_isnan(x); }
extern "C" int _wp_isinf(double x) { return __builtin_isinf(x); }
extern "C" void _wp_assert(const char*, const char*, unsigned) { abort(); }

int main(int count, char** words) {
    if (count != 3) return 2;
    const int file = open(words[1], O_RDWR);
    void* mapped = mmap(nullptr, strtoull(words[2], nullptr, 10), PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    if (file < 0 || mapped == MAP_FAILED) return 1;
    char* memory = static_cast<char*>(mapped);
    const uint64_t address = reinterpret_cast<uint64_t>(memory);
    if (write(1, &address, sizeof address) != sizeof address) return 1;
    uint32_t entry;
    while (read(0, &entry, sizeof entry) == sizeof entry) {
        entries[entry](memory, memory + ARGUMENTS);
        if (write(1, "", 1) != 1) return 1;
    }
}
