/* memcpy and memset, which the compiler calls by itself, too: Debian's for RISC-V comes without a C library. */
#include <string.h>

void *memcpy(void *restrict to, const void *restrict from, size_t size) {
    unsigned char *target = to;
    const unsigned char *source = from;
    for (; size > 0; --size) {
        *target++ = *source++;
    }
    return to;
}

void *memset(void *to, int value, size_t size) {
    unsigned char *target = to;
    for (; size > 0; --size) {
        *target++ = (unsigned char)value;
    }
    return to;
}
