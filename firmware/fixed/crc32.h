/* CRC-32 (IEEE 802.3), four bits at a time: a table of 64 bytes. */
#ifndef FIXED_CRC32_H
#define FIXED_CRC32_H

#include <stdint.h>

/* CRC of `count` bytes that follow those with the CRC `crc`; 0: none precede. For "123456789" it is 0xCBF43926. */
uint32_t crc32_continue(uint32_t crc, const void *bytes, unsigned count);

#endif
