/* SPDX-License-Identifier: GPL-2.0-or-later */
#include "stm32g4/nvic.h"

#include <stdio.h>
#include <string.h>

#include "stm32g4/cpu.h"
#include "stm32g4/soc.h"

#define WORDS ((CPU_EXCEPTIONS + 63) / 64)
#define NMI 2u
#define HARD_FAULT 3u
#define PENDSV 14u
#define SYSTICK 15u
#define NO_PRIORITY 256
#define STIMULUS_PORTS 6u

static struct {
    uint64_t pending[WORDS], enabled[WORDS], active[WORDS], level[WORDS];
    uint64_t fell[WORDS]; /* the request has ended since the last read of a peripheral */
    int16_t priority[CPU_EXCEPTIONS];
    uint8_t group_shift; /* PRIGROUP */
    uint32_t vectors, scr, ccr, demcr, dwt_control;
    uint64_t cycle_counter_from;
    uint32_t systick_control, systick_reload;
    uint64_t systick_from; /* cycle at which it had the reload value */
    bool systick_counted;
} nvic;

static nvic_stimulus_t stimulus;

void nvic_set_stimulus(nvic_stimulus_t function) {
    stimulus = function;
}

static bool get(const uint64_t *bits, unsigned n) {
    return bits[n / 64] >> (n % 64) & 1;
}

static void put(uint64_t *bits, unsigned n, bool value) {
    const uint64_t bit = UINT64_C(1) << (n % 64);
    bits[n / 64] = value ? bits[n / 64] | bit : bits[n / 64] & ~bit;
}

void nvic_reset(void) {
    uint64_t level[WORDS];
    memcpy(level, nvic.level, sizeof level);
    memset(&nvic, 0, sizeof nvic);
    nvic.vectors = FLASH_BASE;
    nvic.enabled[0] = 1u << NMI | 1u << HARD_FAULT | 1u << 11 | 1u << PENDSV | 1u << SYSTICK;
    nvic.priority[NMI] = -2;
    nvic.priority[HARD_FAULT] = -1;
    nvic.ccr = 0x200;
    soc_schedule(EVENT_SYSTICK, SOC_NEVER);
}

bool nvic_any(void) {
    return (nvic.pending[0] & nvic.enabled[0]) | (nvic.pending[1] & nvic.enabled[1]);
}

/* Priority for pre-emption: the group bits. */
static int group(int priority) {
    return priority < 0 ? priority : priority >> (nvic.group_shift + 1);
}

static int running(void) {
    int best = NO_PRIORITY;
    for (unsigned word = 0; word < WORDS; ++word) {
        for (uint64_t bits = nvic.active[word]; bits; bits &= bits - 1) {
            const int priority = group(nvic.priority[word * 64 + (unsigned)__builtin_ctzll(bits)]);
            best = priority < best ? priority : best;
        }
    }
    return best;
}

unsigned nvic_candidate(bool primask, uint32_t basepri) {
    int limit = running();
    if (primask && limit > 0) {
        limit = 0;
    }
    basepri &= 0xF0;
    if (basepri && group((int)basepri) < limit) {
        limit = group((int)basepri);
    }
    int best = NO_PRIORITY;
    unsigned found = 0;
    for (unsigned word = 0; word < WORDS; ++word) {
        for (uint64_t bits = nvic.pending[word] & nvic.enabled[word]; bits; bits &= bits - 1) {
            const unsigned n = word * 64 + (unsigned)__builtin_ctzll(bits);
            if (group(nvic.priority[n]) < limit && nvic.priority[n] < best) {
                best = nvic.priority[n];
                found = n;
            }
        }
    }
    return found;
}

void nvic_enter(unsigned exception) {
    put(nvic.pending, exception, false);
    put(nvic.active, exception, true);
}

void nvic_leave(unsigned exception) {
    if (!get(nvic.active, exception)) {
        soc_violation("return from exception %u, which is not active", exception);
    }
    if (get(nvic.fell, exception)) {
        soc_violation("return from exception %u, whose request has ended by the last access to a peripheral: the store "
                      "may still be on its way, and the exception comes again",
                      exception);
    }
    put(nvic.active, exception, false);
    if (get(nvic.level, exception)) {
        put(nvic.pending, exception, true);
    }
}

void nvic_settle(void) {
    memset(nvic.fell, 0, sizeof nvic.fell);
}

void nvic_line(unsigned exception, bool level) {
    if (level && !get(nvic.level, exception)) {
        put(nvic.pending, exception, true);
    }
    if (level || get(nvic.level, exception)) {
        put(nvic.fell, exception, !level);
    }
    put(nvic.level, exception, level);
}

void nvic_pend(unsigned exception) {
    put(nvic.pending, exception, true);
}

bool nvic_is_active(unsigned exception) {
    return get(nvic.active, exception);
}

uint32_t nvic_vectors(void) {
    return nvic.vectors;
}

/* --- SysTick --- */

static uint64_t systick_period(void) {
    return ((uint64_t)nvic.systick_reload + 1) * (nvic.systick_control & 4 ? 1 : 8);
}

static void systick_schedule(void) {
    const bool on = nvic.systick_control & 1 && nvic.systick_reload;
    soc_schedule(EVENT_SYSTICK, on ? nvic.systick_from + systick_period() : SOC_NEVER);
}

void nvic_systick_event(void) {
    nvic.systick_from += systick_period();
    nvic.systick_counted = true;
    if (nvic.systick_control & 2) {
        nvic_pend(SYSTICK);
    }
    systick_schedule();
}

static uint32_t systick_read(uint32_t offset) {
    switch (offset) {
    case 0xE010: {
        const uint32_t value = nvic.systick_control | (nvic.systick_counted ? 1u << 16 : 0);
        nvic.systick_counted = false;
        return value;
    }
    case 0xE014:
        return nvic.systick_reload;
    case 0xE018:
        if (!(nvic.systick_control & 1)) {
            return 0;
        }
        return nvic.systick_reload - (uint32_t)((soc.now - nvic.systick_from) / (nvic.systick_control & 4 ? 1 : 8));
    default:
        soc_violation("read of the unmodelled register 0x%08X", 0xE0000000u + offset);
    }
}

static void systick_write(uint32_t offset, uint32_t value) {
    switch (offset) {
    case 0xE010:
        if (value & 1 && !(nvic.systick_control & 1)) {
            nvic.systick_from = soc.now;
        }
        nvic.systick_control = value & 7;
        break;
    case 0xE014:
        nvic.systick_reload = value & 0xFFFFFF;
        break;
    case 0xE018:
        nvic.systick_from = soc.now;
        nvic.systick_counted = false;
        break;
    default:
        soc_violation("write of the unmodelled register 0x%08X", 0xE0000000u + offset);
    }
    systick_schedule();
}

/* --- Registers --- */

static uint32_t bits_read(const uint64_t *bits, uint32_t word) {
    uint32_t value = 0;
    for (unsigned i = 0; i < 32; ++i) {
        const unsigned n = CPU_IRQ(word * 32 + i);
        value |= n < CPU_EXCEPTIONS && get(bits, n) ? 1u << i : 0;
    }
    return value;
}

static void bits_write(uint32_t offset, uint32_t value) {
    const uint32_t kind = offset & 0xFF80, word = (offset & 0x7C) / 4;
    for (unsigned i = 0; i < 32; ++i) {
        const unsigned n = CPU_IRQ(word * 32 + i);
        if (!(value >> i & 1)) {
            continue;
        }
        if (n >= CPU_EXCEPTIONS) {
            soc_violation("NVIC: interrupt %u does not exist", n - 16);
        }
        switch (kind) {
        case 0xE100:
        case 0xE180:
            put(nvic.enabled, n, kind == 0xE100);
            break;
        case 0xE200:
            put(nvic.pending, n, true);
            break;
        default:
            put(nvic.pending, n, get(nvic.level, n));
            break;
        }
    }
}

static uint32_t priorities_read(unsigned first, unsigned size) {
    uint32_t value = 0;
    for (unsigned i = 0; i < size; ++i) {
        const int priority = first + i < CPU_EXCEPTIONS ? nvic.priority[first + i] : 0;
        value |= (uint32_t)(priority & 0xFF) << 8 * i;
    }
    return value;
}

static void priorities_write(unsigned first, uint32_t value, unsigned size) {
    for (unsigned i = 0; i < size && first + i < CPU_EXCEPTIONS; ++i) {
        const uint8_t priority = (uint8_t)(value >> 8 * i);
        if (priority & 0x0F) {
            soc_violation("priority 0x%02X of exception %u: only the upper four bits exist", priority, first + i);
        }
        if (first + i > HARD_FAULT) {
            nvic.priority[first + i] = priority;
        }
    }
}

uint32_t nvic_read(uint32_t offset, unsigned size) {
    if (offset >= 0xE400 && offset < 0xE400 + 240) {
        return priorities_read(CPU_IRQ(offset - 0xE400), size);
    }
    if (offset >= 0xED18 && offset < 0xED24) {
        return priorities_read(4 + offset - 0xED18, size);
    }
    if (size != 4) {
        soc_violation("read of %u bytes of the processor's register 0x%08X", size, 0xE0000000u + offset);
    }
    switch (offset & 0xFF80) {
    case 0xE100:
    case 0xE180:
        return bits_read(nvic.enabled, (offset & 0x7C) / 4);
    case 0xE200:
    case 0xE280:
        return bits_read(nvic.pending, (offset & 0x7C) / 4);
    case 0xE300:
        return bits_read(nvic.active, (offset & 0x7C) / 4);
    default:
        break;
    }
    switch (offset) {
    case 0x0000:
        return 1; /* stimulus port 0 accepts a byte */
    case 0x1000:
        return nvic.dwt_control;
    case 0x1004:
        return nvic.dwt_control & 1 ? (uint32_t)(soc.now - nvic.cycle_counter_from) : 0;
    case 0xED00:
        return 0x410FC241;
    case 0xED04:
        return cpu_exception() | (get(nvic.pending, PENDSV) ? 1u << 28 : 0) |
               (get(nvic.pending, SYSTICK) ? 1u << 26 : 0);
    case 0xED08:
        return nvic.vectors;
    case 0xED0C:
        return 0xFA050000u | (uint32_t)nvic.group_shift << 8;
    case 0xED10:
        return nvic.scr;
    case 0xED14:
        return nvic.ccr;
    case 0xED24:
    case 0xED28:
    case 0xED2C:
    case 0xED88:
        return 0; /* no fault is pending; the floating-point unit is off */
    case 0xEDFC:
        return nvic.demcr;
    default:
        return systick_read(offset);
    }
}

static void application_reset(uint32_t value) {
    if (value >> 16 != 0x05FA) {
        soc_violation("AIRCR = 0x%08X without its key 0x05FA", value);
    }
    nvic.group_shift = value >> 8 & 7;
    if (value & 4) {
        soc_request_reset(1u << 28); /* SFTRSTF */
    }
}

static void control_write(uint32_t offset, uint32_t value) {
    switch (offset) {
    case 0x1000:
        nvic.dwt_control = value & 1;
        break;
    case 0x1004:
        nvic.cycle_counter_from = soc.now - value;
        break;
    case 0xED04:
        if (value & 1u << 31) {
            nvic_pend(NMI);
        }
        if (value & 3u << 27) {
            put(nvic.pending, PENDSV, value >> 28 & 1);
        }
        if (value & 3u << 25) {
            put(nvic.pending, SYSTICK, value >> 26 & 1);
        }
        break;
    case 0xED08:
        nvic.vectors = value & ~0x1FFu;
        break;
    case 0xED0C:
        application_reset(value);
        break;
    case 0xED10:
        if (value & ~0x10u) {
            soc_violation("SCR = 0x%X: only SEVONPEND is modelled", value);
        }
        nvic.scr = value;
        break;
    case 0xED14:
        nvic.ccr = value;
        break;
    case 0xED24: /* a fault ends the run, enabled or not */
    case 0xED28: /* write one to clear, nothing is set */
    case 0xED2C:
        break;
    case 0xEDFC:
        nvic.demcr = value;
        break;
    case 0xED88:
        soc_violation("CPACR = 0x%08X: the floating-point unit is not modelled", value);
    default:
        systick_write(offset, value);
    }
}

void nvic_write(uint32_t offset, uint32_t value, unsigned size) {
    if (offset == 0) {
        for (unsigned i = 0; i < (size == 1 ? 1u : size); ++i) {
            putchar((int)(value >> 8 * i & 0xFF));
        }
        return;
    }
    if (offset < 4 * STIMULUS_PORTS && size == 4 && stimulus) {
        stimulus(offset / 4, value);
        return;
    }
    if (offset >= 0xE400 && offset < 0xE400 + 240) {
        priorities_write(CPU_IRQ(offset - 0xE400), value, size);
        return;
    }
    if (offset >= 0xED18 && offset < 0xED24) {
        priorities_write(4 + offset - 0xED18, value, size);
        return;
    }
    if (size != 4) {
        soc_violation("write of %u bytes to the processor's register 0x%08X", size, 0xE0000000u + offset);
    }
    if (offset >= 0xE100 && offset < 0xE300) {
        bits_write(offset, value);
        return;
    }
    control_write(offset, value);
}
