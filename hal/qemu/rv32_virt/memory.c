/* memcpy and memset, which the compiler also calls implicitly: Debian's compiler for RISC-V has no C library. */
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
