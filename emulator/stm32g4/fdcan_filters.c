/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Acceptance filters of FDCAN1 in the message RAM (RM0440, 44.3.9).
 */
#include "stm32g4/peripherals.h"

#define FDCAN 0x40006400u
#define RAM 0x4000A400u
#define RXGFC (FDCAN + 0x80)
#define STANDARD_FILTERS 0x00u
#define EXTENDED_FILTERS 0x70u

/* 0, 1: FIFO; -1: rejected; -2: disabled, or priority alone. */
static int element_action(uint32_t configuration) {
    static const int8_t actions[8] = {-2, 0, 1, -1, -2, 0, 1, -2};
    return actions[configuration & 7];
}

static bool matches(uint32_t kind, uint32_t first, uint32_t second, uint32_t identifier) {
    switch (kind) {
    case 0:
        return identifier >= first && identifier <= second;
    case 1:
        return identifier == first || identifier == second;
    case 2:
        return (identifier & second) == (first & second);
    default:
        return identifier >= first && identifier <= second; /* range without the mask of XIDAM */
    }
}

int fdcan_destination(const fdcan_frame_t *frame) {
    const uint32_t rxgfc = REG(RXGFC);
    if (frame->remote && rxgfc >> (frame->extended ? 0 : 1) & 1) {
        return -1;
    }
    const unsigned count = frame->extended ? rxgfc >> 24 & 15 : rxgfc >> 16 & 31;
    for (unsigned i = 0; i < count; ++i) {
        uint32_t kind, configuration, first, second;
        if (frame->extended) {
            const uint32_t f0 = REG(RAM + EXTENDED_FILTERS + 8 * i), f1 = REG(RAM + EXTENDED_FILTERS + 8 * i + 4);
            kind = f1 >> 30, configuration = f0 >> 29, first = f0 & 0x1FFFFFFF, second = f1 & 0x1FFFFFFF;
        } else {
            const uint32_t f = REG(RAM + STANDARD_FILTERS + 4 * i);
            kind = f >> 30, configuration = f >> 27 & 7, first = f >> 16 & 0x7FF, second = f & 0x7FF;
        }
        const int action = element_action(configuration);
        const bool enabled = action >= -1 && !(kind == 3 && !frame->extended);
        if (enabled && matches(kind, first, second, frame->identifier)) {
            return action;
        }
    }
    const uint32_t unmatched = rxgfc >> (frame->extended ? 2 : 4) & 3;
    return unmatched < 2 ? (int)unmatched : -1;
}
