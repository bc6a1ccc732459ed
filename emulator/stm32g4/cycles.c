/* SPDX-License-Identifier: GPL-2.0-or-later */
#include "stm32g4/cycles.h"

#include <stdbool.h>

#define REFILL 2       /* of the pipeline after a branch that is taken: 1 to 3 */
#define DIVISION 7     /* 2 to 12 by operands */
#define LINE_BYTES 16  /* of the flash's caches: 8 lines of data, 32 of instructions */
#define MISSES_PART 16 /* a sixteenth of the fetched lines misses the cache */

static bool is_wide(uint16_t first) {
    return (first >> 11) >= 0x1D;
}

static unsigned bits_in(uint32_t list) {
    return (unsigned)__builtin_popcount(list);
}

/* 16-bit instructions, ARMv7-M ARM A5.2. */
static unsigned narrow(uint16_t op) {
    const unsigned top = op >> 12;
    if (top == 0xD && (op >> 8 & 15) < 14) {
        return 1 + REFILL / 2; /* a conditional branch is taken half of the time */
    }
    if (top == 0xE || (op >> 8) == 0x47) {
        return 1 + REFILL; /* B, BX, BLX */
    }
    if ((op & 0xFE00) == 0xB400) {
        return 1 + bits_in(op & 0x1FF); /* PUSH */
    }
    if ((op & 0xFE00) == 0xBC00) {
        return 1 + bits_in(op & 0x1FF) + (op & 0x100 ? REFILL : 0); /* POP */
    }
    if (top == 0xC) {
        return 1 + bits_in(op & 0xFF); /* LDM, STM */
    }
    if ((op & 0xF500) == 0xB100) {
        return 1 + REFILL / 2; /* CBZ, CBNZ */
    }
    return (top >= 5 && top <= 9) || (op >> 11) == 9 ? 2 : 1; /* loads and stores */
}

/* 32-bit instructions, A5.3. */
static unsigned wide(uint16_t first, uint16_t second) {
    if ((first & 0xFE40) == 0xE800) {
        return 1 + bits_in(second) + (second & 0x8000 && first & 0x10 ? REFILL : 0); /* LDM, STM */
    }
    if ((first & 0xFE40) == 0xE840) {
        return (first & 0xFFF0) == 0xE8D0 ? 2 + REFILL : 3; /* table branch; LDRD, STRD, exclusive */
    }
    if ((first & 0xF800) == 0xF000 && second & 0x8000) {
        if ((second & 0x5000) == 0x0000 && (first & 0x380) == 0x380) {
            return 2; /* MSR, MRS, hints, barriers */
        }
        return (second & 0x5000) == 0x0000 ? 1 + REFILL / 2 : 1 + REFILL;
    }
    if ((first & 0xFE00) == 0xF800) {
        return (first & 0x10) && (second >> 12) == 15 ? 2 + REFILL : 2; /* loads, stores; LDR PC */
    }
    if ((first & 0xFF80) == 0xFB80) {
        return (first & 0xFFD0) == 0xFB90 ? DIVISION : 1; /* SDIV, UDIV; long multiplications */
    }
    return 1;
}

unsigned cycles_instructions(const uint8_t *code, uint32_t size) {
    unsigned count = 0;
    for (uint32_t at = 0; at + 1 < size; ++count) {
        at += is_wide((uint16_t)(code[at] | code[at + 1] << 8)) ? 4 : 2;
    }
    return count;
}

bool cycles_floating(const uint8_t *code, uint32_t size) {
    for (uint32_t at = 0; at + 3 < size;) {
        const uint16_t first = (uint16_t)(code[at] | code[at + 1] << 8);
        const uint16_t second = (uint16_t)(code[at + 2] | code[at + 3] << 8);
        if ((first & 0xEC00) == 0xEC00 && is_wide(first) && (second & 0x0E00) == 0x0A00) {
            return true;
        }
        at += is_wide(first) ? 4 : 2;
    }
    return false;
}

unsigned cycles_of(const uint8_t *code, uint32_t size, unsigned wait_states) {
    unsigned sum = 0;
    for (uint32_t at = 0; at + 1 < size;) {
        const uint16_t first = (uint16_t)(code[at] | code[at + 1] << 8);
        if (is_wide(first) && at + 3 < size) {
            sum += wide(first, (uint16_t)(code[at + 2] | code[at + 3] << 8));
            at += 4;
        } else {
            sum += narrow(first);
            at += 2;
        }
    }
    const unsigned lines = size / LINE_BYTES + 1;
    return sum + (lines * wait_states + MISSES_PART / 2) / MISSES_PART;
}
