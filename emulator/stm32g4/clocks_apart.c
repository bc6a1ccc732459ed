/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Peripherals with clocks of their own: independent watchdog (RM0440, 42), low-power timer (34), random numbers (26).
 */
#include <stddef.h>

#include "stm32g4/cpu.h"
#include "stm32g4/nvic.h"
#include "stm32g4/peripherals.h"

#define IWDG 0x40003000u
#define KR (IWDG + 0x00)
#define PR (IWDG + 0x04)
#define RLR (IWDG + 0x08)
#define WINR (IWDG + 0x10)
#define LSI_HZ 32000u
#define CSR_IWDGRSTF (1u << 29)
#define LPTIM1 0x40007C00u
#define LPTIM_ISR (LPTIM1 + 0x00)
#define LPTIM_ICR (LPTIM1 + 0x04)
#define LPTIM_CFGR (LPTIM1 + 0x0C)
#define LPTIM_CR (LPTIM1 + 0x10)
#define LPTIM_CMP (LPTIM1 + 0x14)
#define LPTIM_ARR (LPTIM1 + 0x18)
#define LPTIM_CNT (LPTIM1 + 0x1C)
#define LPTIM_ENABLE 1u
#define LPTIM_CNTSTRT 4u
#define RNG 0x50060800u
#define RNG_CR (RNG + 0x00)
#define RNG_SR (RNG + 0x04)
#define RNG_DR (RNG + 0x08)
#define RNGEN 4u
#define RNG_SEIS 0x40u
#define RNG_ERROR 0x44u /* SEIS, SECS */
#define PIPELINE_WORDS 12u
#define RANDOM_NS 4000u /* about 200 cycles of 48 MHz for a number */
#define NS_PER_S 1e9

static struct {
    bool runs, unlocked;
    uint32_t reload; /* of the last refresh */
    uint64_t expires_ns;
    bool counts;
    uint64_t counts_from; /* cycles of its clock at its start */
    apart_lse_t lse;
    void *lse_context;
    apart_random_t random;
    void *random_context;
    uint64_t state;
    uint64_t number_ready_ns; /* RNG_DR has the next number */
    unsigned stale;           /* words of the pipeline that a seed error has left */
} apart;

/* --- Independent watchdog --- */

static void refresh(void) {
    apart.reload = REG(RLR);
    const uint64_t prescaler = 4u << (REG(PR) > 6 ? 6 : REG(PR));
    apart.expires_ns = soc_ns(soc.now) + (apart.reload + 1) * prescaler * UINT64_C(1000000000) / LSI_HZ;
    soc_schedule(EVENT_IWDG, soc_cycle_of_ns(apart.expires_ns));
}

uint64_t apart_watchdog_expires_ns(void) {
    return apart.runs ? apart.expires_ns : SOC_NEVER;
}

void apart_watchdog_event(void) {
    if (soc_ns(soc.now) < apart.expires_ns) { /* HCLK has changed since */
        soc_schedule(EVENT_IWDG, soc_cycle_of_ns(apart.expires_ns));
        return;
    }
    soc_request_reset(CSR_IWDGRSTF);
}

static void iwdg_write(uint32_t address, uint32_t value) {
    if (address == KR) {
        apart.unlocked = value == 0x5555;
        if (value == 0xCCCC) {
            apart.runs = true;
            rcc_run_lsi();
            refresh();
        } else if (value == 0xAAAA && apart.runs) {
            refresh();
        } else if (value != 0x5555 && value != 0xAAAA) {
            soc_violation("write of IWDG_KR, value 0x%X: no key", value);
        }
        return;
    }
    if (!apart.unlocked) {
        soc_violation("write of %s, value 0x%X: IWDG_KR = 0x5555 comes first", soc_name(address), value);
    }
    if (address == WINR && value != 0xFFF) {
        soc_violation("write of IWDG_WINR, value 0x%X: the window is not modelled", value);
    }
    REG(address) = value;
}

/* --- Low-power timer: the counter alone --- */

/* Cycles of the timer's clock; LSE is the board's crystal, where a bench has one. */
static uint64_t lptim_cycles(void) {
    if (rcc_lptim1_has_lse() && apart.lse) {
        return apart.lse(apart.lse_context);
    }
    return (uint64_t)((double)soc_ns(soc.now) * rcc_lptim1_hz() / NS_PER_S);
}

static uint64_t lptim_count(void) {
    const unsigned prescaler = REG(LPTIM_CFGR) >> 9 & 7;
    return apart.counts ? (lptim_cycles() - apart.counts_from) >> prescaler : 0;
}

void apart_set_lse(apart_lse_t lse, void *context) {
    apart.lse = lse;
    apart.lse_context = context;
}

static bool random_ready(void) {
    return REG(RNG_CR) & RNGEN && !(REG(RNG_SR) & RNG_SEIS) &&
           (soc.untimed || soc_ns(soc.now) >= apart.number_ready_ns);
}

static void next_random(void) {
    apart.number_ready_ns = soc_ns(soc.now) + RANDOM_NS;
}

void apart_seed_error(void) {
    REG(RNG_SR) |= RNG_ERROR;
    apart.stale = PIPELINE_WORDS;
}

static uint32_t apart_read(uint32_t address) {
    switch (address) {
    case LPTIM_CNT:
        return (uint32_t)(lptim_count() % ((uint64_t)REG(LPTIM_ARR) + 1));
    case RNG_SR:
        if (REG(RNG_CR) & RNGEN && !rcc_hsi48_ready()) {
            soc_violation("read of RNG_SR: its 48 MHz clock does not run (RCC_CRRCR, RCC_CCIPR.CLK48SEL)");
        }
        return REG(RNG_SR) | random_ready();
    case RNG_DR:
        if (!(REG(RNG_CR) & RNGEN)) {
            soc_violation("read of RNG_DR: RNG_CR.RNGEN is 0");
        }
        if (!random_ready()) {
            soc_violation("read of RNG_DR: RNG_SR.DRDY is 0, it reads as zero");
        }
        next_random();
        if (apart.stale > 0) {
            --apart.stale;
            return APART_STALE;
        }
        if (apart.random) {
            return apart.random(apart.random_context);
        }
        apart.state = apart.state * UINT64_C(6364136223846793005) + UINT64_C(1442695040888963407);
        return (uint32_t)(apart.state >> 32);
    default:
        return REG(address);
    }
}

static void lptim_write(uint32_t address, uint32_t value) {
    const bool enabled = REG(LPTIM_CR) & LPTIM_ENABLE;
    switch (address) {
    case LPTIM_ICR:
        REG(LPTIM_ISR) &= ~value;
        return;
    case LPTIM_CFGR:
        if (enabled || value & ~0xE00u) {
            soc_violation("write of LPTIM1_CFGR, value 0x%X: %s", value,
                          enabled ? "the timer is enabled" : "only the prescaler is modelled");
        }
        break;
    case LPTIM_CR:
        if (value & ~(LPTIM_ENABLE | LPTIM_CNTSTRT) || (value & LPTIM_CNTSTRT && !enabled)) {
            soc_violation("write of LPTIM1_CR, value 0x%X: ENABLE, then CNTSTRT; no other is modelled", value);
        }
        if (value & LPTIM_CNTSTRT && !apart.counts) {
            if (rcc_lptim1_hz() == 0) {
                soc_violation("write of LPTIM1_CR, value 0x%X: its clock does not run (RCC_CCIPR.LPTIM1SEL)", value);
            }
            apart.counts = true;
            apart.counts_from = lptim_cycles();
        }
        if (!(value & LPTIM_ENABLE)) {
            apart.counts = false;
        }
        value &= LPTIM_ENABLE;
        break;
    case LPTIM_ARR:
    case LPTIM_CMP:
        if (!enabled) {
            soc_violation("write of %s, value 0x%X: the timer is not enabled", soc_name(address), value);
        }
        REG(LPTIM_ISR) |= address == LPTIM_ARR ? 0x10u : 0x08u;
        break;
    default:
        soc_violation("write of %s, value 0x%X: not modelled", soc_name(address), value);
    }
    REG(address) = value;
}

static void rng_write(uint32_t address, uint32_t value) {
    if (address == RNG_CR && value & RNGEN && !rcc_hsi48_ready()) {
        soc_violation("write of RNG_CR, value 0x%X: its 48 MHz clock does not run (RCC_CRRCR, RCC_CCIPR.CLK48SEL)",
                      value);
    }
    if (address == RNG_CR && value & RNGEN && !(REG(RNG_CR) & RNGEN)) {
        next_random();
    }
    if (address == RNG_SR) { /* zeros clear; SECS tells the present state */
        value = value & REG(RNG_SR) & RNG_SEIS ? RNG_ERROR : 0;
    }
    REG(address) = value;
}

void apart_set_random(apart_random_t random, void *context) {
    apart.random = random;
    apart.random_context = context;
}

void apart_attach(void) {
    soc_attach(IWDG, 0x14, 0, 0, NULL, iwdg_write);
    soc_attach(LPTIM1, 0x24, 0x40021058u, 31, apart_read, lptim_write);
    soc_attach(RNG, 0x0C, 0x4002104Cu, 26, apart_read, rng_write);
}

void apart_reset(void) {
    apart.runs = apart.unlocked = apart.counts = false;
    apart.stale = 0;
}
