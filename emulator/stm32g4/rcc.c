/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Reset and clock control, power control (RM0440, 6 and 7): clock tree, ready flags after the oscillators' start, and
 * the rules between frequency, voltage range and wait states of the flash.
 */
#include "stm32g4/flash.h"
#include "stm32g4/peripherals.h"

#define RCC 0x40021000u
#define CR (RCC + 0x00)
#define ICSCR (RCC + 0x04)
#define CFGR (RCC + 0x08)
#define PLLCFGR (RCC + 0x0C)
#define AHB1RSTR (RCC + 0x28)
#define APB2RSTR (RCC + 0x40)
#define CCIPR (RCC + 0x88)
#define BDCR (RCC + 0x90)
#define CSR (RCC + 0x94)
#define CRRCR (RCC + 0x98)
#define PWR_CR1 0x40007000u
#define PWR_SR2 0x40007014u
#define PWR_CR5 0x40007080u
#define FLASH_ACR 0x40022000u
#define ACR_DCRST (1u << 12)

#define CSR_RESET_FLAGS 0xFE000000u
#define CSR_RMVF (1u << 23)
#define CSR_BORRSTF (1u << 27)

#define HSI_HZ 16000000u
#define HSE_HZ 24000000u /* crystal X3 of the NUCLEO-G474RE */
#define LSI_HZ 32000u
#define LSE_HZ 32768u
#define MHZ 1000000u

typedef enum { HSE, PLL, LSI, LSE, HSI48, OSCILLATORS } oscillator_t;

/* Times of start, from the data sheet: typical; LSE: shortened from 2 s, which a run would spend in waiting. */
static const uint32_t start_ns[OSCILLATORS] = {
    [HSE] = 2000000, [PLL] = 40000, [LSI] = 130000, [LSE] = 10000000, [HSI48] = 2500};

static uint32_t reset_flags;
static uint64_t ready_ns[OSCILLATORS]; /* SOC_NEVER: off */
static uint64_t halved_from_ns;        /* the system clock was selected */
static bool access_seen;               /* PWR_CR1.DBP was read as one */

static bool ready(oscillator_t oscillator) {
    return soc_ns(soc.now) >= ready_ns[oscillator];
}

static void run(oscillator_t oscillator, bool on) {
    if (!on) {
        ready_ns[oscillator] = SOC_NEVER;
    } else if (ready_ns[oscillator] == SOC_NEVER) {
        ready_ns[oscillator] = soc_ns(soc.now) + (soc.untimed ? 0 : start_ns[oscillator]);
    }
}

/* --- Frequencies --- */

static uint32_t pll_input_hz(void) {
    const uint32_t source = REG(PLLCFGR) & 3;
    return source == 2 ? HSI_HZ : source == 3 ? HSE_HZ : 0;
}

/* Frequency of the VCO; its ranges are checked where it is started. */
static uint32_t vco_hz(void) {
    const uint32_t m = (REG(PLLCFGR) >> 4 & 15) + 1, n = REG(PLLCFGR) >> 8 & 127;
    return (uint32_t)((uint64_t)pll_input_hz() * n / m);
}

static uint32_t pll_r_hz(void) {
    return vco_hz() / (2 * ((REG(PLLCFGR) >> 25 & 3) + 1));
}

static uint32_t pll_q_hz(void) {
    return REG(PLLCFGR) >> 20 & 1 && ready(PLL) ? vco_hz() / (2 * ((REG(PLLCFGR) >> 21 & 3) + 1)) : 0;
}

static uint32_t pll_p_hz(void) {
    const uint32_t divider = REG(PLLCFGR) >> 27;
    if (!(REG(PLLCFGR) >> 16 & 1) || !ready(PLL)) {
        return 0;
    }
    return vco_hz() / (divider ? divider : REG(PLLCFGR) >> 17 & 1 ? 17 : 7);
}

static uint32_t sysclk_hz(void) {
    switch (REG(CFGR) & 3) {
    case 1:
        return HSI_HZ;
    case 2:
        return HSE_HZ;
    case 3:
        return pll_r_hz();
    default:
        soc_violation("RCC_CFGR.SW = 0: reserved");
    }
}

static uint32_t prescaled(uint32_t hz, uint32_t code, unsigned first) {
    static const uint16_t dividers[] = {2, 4, 8, 16, 64, 128, 256, 512};
    return code < first ? hz : hz / dividers[code - first];
}

static uint32_t timer_hz(uint32_t hclk, uint32_t code) {
    return code < 4 ? hclk : 2 * prescaled(hclk, code, 4);
}

/* Range of the core's voltage, and the greatest HCLK by wait states (5.3.3, table 29). The last one bounds the
 * output of the PLL, too (data sheet, characteristics of the PLL). */
typedef struct {
    const char *name;
    unsigned count;
    uint32_t mhz[5];
} voltage_range_t;

static const voltage_range_t *voltage_range(void) {
    static const voltage_range_t low = {"range 2", 3, {12, 24, 26}},
                                 normal = {"normal mode of range 1", 5, {30, 60, 90, 120, 150}},
                                 boost = {"boost mode", 5, {34, 68, 102, 136, 170}};
    const bool range_1 = (REG(PWR_CR1) >> 9 & 3) == 1;
    return !range_1 ? &low : REG(PWR_CR5) >> 8 & 1 ? &normal : &boost;
}

static uint32_t most_mhz(const voltage_range_t *range) {
    return range->mhz[range->count - 1];
}

static void check_speed(uint32_t hz) {
    const voltage_range_t *range = voltage_range();
    const unsigned states = flash_wait_states();
    if (hz > most_mhz(range) * MHZ) {
        soc_violation("HCLK %u Hz: at most %u MHz in %s (PWR_CR1.VOS, PWR_CR5.R1MODE)", hz, most_mhz(range),
                      range->name);
    }
    const uint32_t allowed_mhz = states < range->count ? range->mhz[states] : most_mhz(range);
    if (hz > allowed_mhz * MHZ) {
        soc_violation("HCLK %u Hz with %u wait states: FLASH_ACR.LATENCY allows %u MHz in %s", hz, states, allowed_mhz,
                      range->name);
    }
}

/* Output R may be enabled before the PLL runs. */
static void check_pll_output(void) {
    const voltage_range_t *range = voltage_range();
    if (REG(CR) >> 24 & 1 && REG(PLLCFGR) >> 24 & 1 && pll_r_hz() > most_mhz(range) * MHZ) {
        soc_violation("RCC_PLLCFGR.PLLREN with %u Hz: at most %u MHz in %s", pll_r_hz(), most_mhz(range), range->name);
    }
}

static void clocks_changed(void) {
    const uint32_t cfgr = REG(CFGR), hclk = prescaled(sysclk_hz(), cfgr >> 4 & 15, 8);
    check_speed(hclk);
    if (hclk != soc.hclk_hz) {
        soc_set_hclk(hclk);
    }
    soc.pclk1_hz = prescaled(hclk, cfgr >> 8 & 7, 4);
    soc.pclk2_hz = prescaled(hclk, cfgr >> 11 & 7, 4);
    soc.timer1_hz = timer_hz(hclk, cfgr >> 8 & 7);
    soc.timer2_hz = timer_hz(hclk, cfgr >> 11 & 7);
}

/* The transition of 7.2.7 from a slow system clock to one above 80 MHz: half of it comes first, for 1 us. */
static void check_transition(uint32_t old_select, uint32_t old_hz) {
    const uint32_t select = REG(CFGR) & 3, hz = prescaled(sysclk_hz(), REG(CFGR) >> 4 & 15, 8);
    const uint64_t now = soc_ns(soc.now);
    const bool whole = hz == sysclk_hz(), fast = sysclk_hz() > 80 * MHZ;
    if (fast && whole && old_hz != hz && (select != old_select || now < halved_from_ns + 1000)) {
        soc_violation("HCLK from %u to %u Hz: above 80 MHz half the frequency comes first, for 1 us (RCC_CFGR.HPRE)",
                      old_hz, hz);
    }
    if (select != old_select) {
        halved_from_ns = now;
    }
}

/* --- Kernel clocks --- */

uint32_t rcc_fdcan_hz(void) {
    switch (REG(CCIPR) >> 24 & 3) {
    case 0:
        return ready(HSE) ? HSE_HZ : 0;
    case 1:
        return pll_q_hz();
    case 2:
        return soc.pclk1_hz;
    default:
        return 0;
    }
}

uint32_t rcc_lptim1_hz(void) {
    switch (REG(CCIPR) >> 18 & 3) {
    case 0:
        return soc.pclk1_hz;
    case 1:
        return ready(LSI) ? LSI_HZ : 0;
    case 2:
        return HSI_HZ;
    default:
        return ready(LSE) ? LSE_HZ : 0;
    }
}

bool rcc_lptim1_has_lse(void) {
    return (REG(CCIPR) >> 18 & 3) == 3;
}

uint32_t rcc_adc_hz(bool converters_345) {
    const uint32_t select = REG(CCIPR) >> (converters_345 ? 30 : 28) & 3;
    return select == 1 ? pll_p_hz() : select == 2 ? sysclk_hz() : 0;
}

bool rcc_hsi48_ready(void) {
    const uint32_t select = REG(CCIPR) >> 26 & 3;
    return select == 0 ? ready(HSI48) : select == 2 && pll_q_hz() > 0;
}

bool rcc_lsi_runs(void) {
    return ready(LSI);
}

void rcc_run_lsi(void) {
    run(LSI, true);
}

/* --- Registers --- */

static uint32_t with_bit(uint32_t value, unsigned bit, bool set) {
    return set ? value | 1u << bit : value & ~(1u << bit);
}

static uint32_t rcc_read(uint32_t address) {
    const uint32_t value = REG(address);
    switch (address) {
    case CR:
        return with_bit(with_bit(value, 17, ready(HSE)), 25, ready(PLL)) | (value >> 8 & 1) << 10;
    case CFGR:
        return (value & ~0xCu) | (value & 3) << 2;
    case BDCR:
        return with_bit(value, 1, ready(LSE));
    case CSR:
        return with_bit(value, 1, ready(LSI));
    case CRRCR:
        return with_bit(value, 1, ready(HSI48));
    default:
        return value;
    }
}

static void start_pll(void) {
    const uint32_t input = pll_input_hz(), m = (REG(PLLCFGR) >> 4 & 15) + 1, n = REG(PLLCFGR) >> 8 & 127;
    if (input == 0 || ((REG(PLLCFGR) & 3) == 3 && !ready(HSE))) {
        soc_violation("RCC_CR.PLLON with RCC_PLLCFGR = 0x%08X: its source does not run", REG(PLLCFGR));
    }
    if (n < 8 || input / m < 2660000u || input / m > 16 * MHZ || vco_hz() < 96 * MHZ || vco_hz() > 344 * MHZ) {
        soc_violation("RCC_CR.PLLON with RCC_PLLCFGR = 0x%08X: input %u Hz must be 2.66 to 16 MHz, VCO %u Hz 96 to 344 "
                      "MHz",
                      REG(PLLCFGR), input / m, vco_hz());
    }
}

static void cr_write(uint32_t value) {
    const uint32_t old = REG(CR);
    if (!(value >> 24 & 1) && old >> 24 & 1 && (REG(CFGR) & 3) == 3) {
        soc_violation("RCC_CR = 0x%08X: the PLL is the system clock", value);
    }
    REG(CR) = (value & ~0x02020400u);
    if (value >> 24 & 1 && !(old >> 24 & 1)) {
        start_pll();
    }
    run(HSE, value >> 16 & 1);
    run(PLL, value >> 24 & 1);
    check_pll_output();
}

static void cfgr_write(uint32_t value) {
    const uint32_t select = value & 3, old_select = REG(CFGR) & 3, old_hz = soc.hclk_hz;
    if ((select == 3 && (!ready(PLL) || !(REG(PLLCFGR) >> 24 & 1))) || (select == 2 && !ready(HSE))) {
        soc_violation("RCC_CFGR = 0x%08X: the source of the system clock is not ready, or PLLREN is 0", value);
    }
    REG(CFGR) = value;
    check_transition(old_select, old_hz);
    clocks_changed();
}

static void bdcr_write(uint32_t value) {
    if (!(REG(PWR_CR1) >> 8 & 1)) {
        soc_violation("write of RCC_BDCR, value 0x%X: PWR_CR1.DBP is 0, the backup domain is protected", value);
    }
    if (!access_seen) {
        soc_violation("write of RCC_BDCR, value 0x%X: PWR_CR1.DBP has not been read back, and is on another bus",
                      value);
    }
    REG(BDCR) = value & 0x0301833D;
    run(LSE, value & 1);
}

static void rcc_write(uint32_t address, uint32_t value) {
    switch (address) {
    case CR:
        cr_write(value);
        break;
    case CFGR:
        cfgr_write(value);
        break;
    case PLLCFGR:
        if (REG(CR) >> 24 & 1 && (value ^ REG(PLLCFGR)) & ~0x01110000u) {
            soc_violation("write of RCC_PLLCFGR, value 0x%08X: the PLL runs", value);
        }
        REG(PLLCFGR) = value;
        check_pll_output();
        break;
    case BDCR:
        bdcr_write(value);
        break;
    case CSR:
        reset_flags = value & CSR_RMVF ? 0 : reset_flags;
        REG(CSR) = (value & 1) | (value & CSR_RMVF ? 0 : REG(CSR) & CSR_RESET_FLAGS);
        run(LSI, value & 1);
        break;
    case CRRCR:
        REG(CRRCR) = value & 1;
        run(HSI48, value & 1);
        break;
    default:
        if (address >= AHB1RSTR && address <= APB2RSTR && value) {
            soc_violation("write of %s, value 0x%08X: resets of peripherals are not modelled", soc_name(address),
                          value);
        }
        REG(address) = value;
    }
}

static uint32_t pwr_read(uint32_t address) {
    access_seen = access_seen || (address == PWR_CR1 && REG(PWR_CR1) >> 8 & 1);
    return REG(address);
}

static void pwr_write(uint32_t address, uint32_t value) {
    REG(address) = value;
    access_seen = access_seen && REG(PWR_CR1) >> 8 & 1;
    if (address == PWR_CR1 || address == PWR_CR5) {
        clocks_changed();
        check_pll_output();
    }
}

static void acr_write(uint32_t address, uint32_t value) {
    if (value >> 2 & REG(address) & 0x600) {
        soc_violation("write of FLASH_ACR, value 0x%X: a cache is emptied while it is enabled", value);
    }
    if (value & ACR_DCRST) {
        flash_cache_emptied();
    }
    REG(address) = value;
    check_speed(soc.hclk_hz);
}

void rcc_attach(void) {
    soc_attach(RCC, 0x400, 0, 0, rcc_read, rcc_write);
    soc_attach(0x40007000u, 0x400, RCC + 0x58, 28, pwr_read, pwr_write);
    soc_attach(FLASH_ACR, 4, RCC + 0x48, 8, 0, acr_write);
}

void rcc_reset(uint32_t cause) {
    const bool lse = ready_ns[LSE] != SOC_NEVER && ready_ns[LSE] != 0 && !(cause & 1u << 27);
    const uint64_t lse_ns = ready_ns[LSE];
    for (unsigned i = 0; i < OSCILLATORS; ++i) {
        ready_ns[i] = SOC_NEVER;
    }
    ready_ns[LSE] = lse ? lse_ns : SOC_NEVER;
    REG(BDCR) = lse ? 1 : 0;
    reset_flags = (cause & CSR_BORRSTF ? 0 : reset_flags) | (cause & CSR_RESET_FLAGS); /* until RMVF, or power-on */
    REG(CSR) = reset_flags;
    halved_from_ns = 0;
    access_seen = false;
    clocks_changed();
}
