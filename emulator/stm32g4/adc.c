/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Converters ADC1 to ADC5 (RM0440, 21): start-up, calibration, injected and regular sequences with triggers, sampling
 * and conversion times. Twelve bits and fewer, single mode, without queue of contexts.
 */
#include <string.h>

#include "stm32g4/nvic.h"
#include "stm32g4/part_pins.h"
#include "stm32g4/peripherals.h"

#define CONVERTERS 5
#define ISR 0x00u
#define IER 0x04u
#define CR 0x08u
#define CFGR 0x0Cu
#define CFGR2 0x10u
#define SMPR1 0x14u
#define SQR1 0x30u
#define DR 0x40u
#define JSQR 0x4Cu
#define OFR1 0x60u
#define OFR4 0x6Cu
#define JDR1 0x80u
#define CCR_OFFSET 0x308u /* of the common registers, from the first converter's base */

#define ISR_ADRDY 0x001u
#define ISR_EOSMP 0x002u
#define ISR_EOC 0x004u
#define ISR_EOS 0x008u
#define ISR_OVR 0x010u
#define ISR_JEOC 0x020u
#define ISR_JEOS 0x040u
#define CR_ADEN 0x01u
#define CR_ADDIS 0x02u
#define CR_ADSTART 0x04u
#define CR_JADSTART 0x08u
#define CR_ADSTP 0x10u
#define CR_JADSTP 0x20u
#define CR_ADVREGEN (1u << 28)
#define CR_DEEPPWD (1u << 29)
#define CR_ADCAL (1u << 31)
#define CFGR_UNMODELLED 0x7FFFC000u /* watchdogs, discontinuous, automatic and delayed modes, alignment */
#define CFGR_JQDIS (1u << 31)
#define CFGR_CONT (1u << 13)

#define REGULATOR_NS 20000u     /* start of the voltage regulator, data sheet */
#define CALIBRATION_CLOCKS 116u /* data sheet */
#define AFTER_CALIBRATION 4u    /* clocks to ADEN */
#define START_CLOCKS 15u        /* power-up: one conversion */
#define CLOCK_MAX_HZ 60000000u

typedef enum { IDLE, CALIBRATING, STARTING } phase_t;

typedef struct {
    uint32_t base;
    unsigned irq, request;
    bool second_group; /* ADC3, ADC4, ADC5 */
    phase_t phase;
    uint64_t regulator_from, phase_ends, calibrated_at, sampled_at, conversion_ends;
    bool injected, regular; /* sequences under way */
    bool samples;           /* the input is still connected */
    bool ready_seen;        /* ADRDY was read */
    uint32_t held;          /* what it was at the end of the sampling time */
    unsigned injected_at, regular_at;
} adc_t;

static adc_t adcs[CONVERTERS] = {
    {.base = 0x50000000u, .irq = 18, .request = 5},
    {.base = 0x50000100u, .irq = 18, .request = 36},
    {.base = 0x50000400u, .irq = 47, .request = 37, .second_group = true},
    {.base = 0x50000500u, .irq = 61, .request = 38, .second_group = true},
    {.base = 0x50000600u, .irq = 62, .request = 39, .second_group = true},
};

static adc_input_t input;
static void *input_context;

#define ADC_REG(adc, offset) REG((adc)->base + (offset))

void adc_set_input(adc_input_t function, void *context) {
    input = function;
    input_context = context;
}

uint64_t adc_sampled_at(unsigned adc) {
    return adcs[adc].sampled_at;
}

/* --- Clock --- */

static uint32_t common(const adc_t *adc) {
    return REG((adc->second_group ? 0x50000400u : 0x50000000u) + CCR_OFFSET);
}

static uint32_t clock_hz(const adc_t *adc) {
    static const uint16_t prescalers[] = {1, 2, 4, 6, 8, 10, 12, 16, 32, 64, 128, 256};
    const uint32_t ccr = common(adc), mode = ccr >> 16 & 3, code = ccr >> 18 & 15;
    const uint32_t hz = mode ? soc.hclk_hz >> (mode - 1) : rcc_adc_hz(adc->second_group) / prescalers[code % 12];
    if (hz == 0 || hz > CLOCK_MAX_HZ) {
        soc_violation("%s: the converter's clock is %u Hz, must be up to %u Hz (RCC_CCIPR, CCR.CKMODE, CCR.PRESC)",
                      soc_name(adc->base + CR), hz, CLOCK_MAX_HZ);
    }
    return hz;
}

/* Half clocks to cycles of HCLK, rounded up. */
static uint64_t cycles(const adc_t *adc, uint64_t half_clocks) {
    if (soc.untimed) {
        return 0;
    }
    const uint32_t hz = clock_hz(adc);
    return (half_clocks * soc.hclk_hz + 2 * (uint64_t)hz - 1) / (2 * (uint64_t)hz);
}

/* --- Conversions --- */

static void lines(void) {
    for (unsigned i = 0; i < CONVERTERS; ++i) {
        bool level = false;
        for (unsigned k = 0; k < CONVERTERS; ++k) {
            level = level || (adcs[k].irq == adcs[i].irq && ADC_REG(&adcs[k], ISR) & ADC_REG(&adcs[k], IER));
        }
        nvic_line(16u + adcs[i].irq, level);
    }
}

static void flag(adc_t *adc, uint32_t flags) {
    ADC_REG(adc, ISR) |= flags;
    lines();
}

static uint64_t sampling_half_clocks(const adc_t *adc, unsigned channel) {
    static const uint16_t half[] = {5, 13, 25, 49, 95, 185, 495, 1281};
    const uint32_t word = ADC_REG(adc, SMPR1 + 4 * (channel / 10));
    const uint32_t code = word >> 3 * (channel % 10) & 7;
    return half[code] + (code == 0 && ADC_REG(adc, SMPR1) >> 31 ? 2u : 0u); /* SMPPLUS */
}

static unsigned bits(const adc_t *adc) {
    return 12 - 2 * (ADC_REG(adc, CFGR) >> 3 & 3);
}

static unsigned injected_channel(const adc_t *adc, unsigned rank) {
    static const uint8_t shift[] = {9, 15, 21, 27};
    return ADC_REG(adc, JSQR) >> shift[rank] & 31;
}

static unsigned regular_channel(const adc_t *adc, unsigned rank) {
    const unsigned place = rank + 1; /* SQR1 begins with the length */
    return ADC_REG(adc, SQR1 + 4 * (place / 5)) >> 6 * (place % 5) & 31;
}

static void begin(adc_t *adc, unsigned channel) {
    const uint64_t sampling = sampling_half_clocks(adc, channel);
    adc->conversion_ends = soc.now + cycles(adc, sampling + 2 * (uint64_t)bits(adc) + 1);
    adc->samples = true;
    soc_schedule(EVENT_ADC + (soc_event_t)(adc - adcs), soc.now + cycles(adc, sampling));
}

static uint32_t convert(adc_t *adc, unsigned channel) {
    const int pin = pins_of_converter((unsigned)(adc - adcs), channel);
    if (pin < 0 || !gpio_is_analog((unsigned)pin)) {
        soc_violation("ADC%u converts channel %u: %s", (unsigned)(adc - adcs) + 1, channel,
                      pin < 0 ? "no pin of the part" : "its pin is not in analogue mode");
    }
    const uint32_t value = input ? input(input_context, (unsigned)pin) : 0;
    return value >> (12 - bits(adc));
}

static void start_injected(adc_t *adc) {
    if (adc->injected || !(ADC_REG(adc, CR) & CR_JADSTART)) {
        return; /* a trigger during the sequence has no effect */
    }
    adc->injected = true;
    adc->injected_at = 0;
    adc->sampled_at = soc.now;
    begin(adc, injected_channel(adc, 0));
}

static void start_regular(adc_t *adc) {
    if (adc->regular || !(ADC_REG(adc, CR) & CR_ADSTART)) {
        return;
    }
    adc->regular = true;
    adc->regular_at = 0;
    if (!adc->injected) {
        begin(adc, regular_channel(adc, 0));
    }
}

static void injected_ends(adc_t *adc) {
    ADC_REG(adc, JDR1 + 4 * adc->injected_at) = adc->held;
    const bool last = adc->injected_at == (ADC_REG(adc, JSQR) & 3);
    ++adc->injected_at;
    if (!last) {
        flag(adc, ISR_JEOC);
        begin(adc, injected_channel(adc, adc->injected_at));
        return;
    }
    adc->injected = false;
    if (!(ADC_REG(adc, JSQR) >> 7 & 3)) {
        ADC_REG(adc, CR) &= ~CR_JADSTART; /* software start: one sequence */
    }
    flag(adc, ISR_JEOC | ISR_JEOS);
    if (adc->regular) {
        begin(adc, regular_channel(adc, adc->regular_at)); /* the interrupted conversion is repeated */
    }
}

static void regular_ends(adc_t *adc) {
    const uint32_t cfgr = ADC_REG(adc, CFGR);
    if (ADC_REG(adc, ISR) & ISR_EOC && !(cfgr & 1)) {
        flag(adc, ISR_OVR);
    }
    if (!(ADC_REG(adc, ISR) & ISR_OVR) || cfgr >> 12 & 1) {
        ADC_REG(adc, DR) = adc->held;
    }
    const bool last = adc->regular_at == (ADC_REG(adc, SQR1) & 15);
    adc->regular_at = last ? 0 : adc->regular_at + 1;
    adc->regular = !last || cfgr & CFGR_CONT;
    if (last && !(cfgr & CFGR_CONT) && !(cfgr >> 10 & 3)) {
        ADC_REG(adc, CR) &= ~CR_ADSTART;
    }
    flag(adc, ISR_EOC | (last ? ISR_EOS : 0));
    if (cfgr & 1) {
        dma_request(adc->request);
        ADC_REG(adc, ISR) &= ~ISR_EOC;
    }
    if (adc->regular) {
        begin(adc, regular_channel(adc, adc->regular_at));
    }
}

void adc_event(unsigned number) {
    adc_t *adc = &adcs[number];
    if (adc->phase == CALIBRATING) {
        adc->phase = IDLE;
        adc->calibrated_at = soc.now;
        ADC_REG(adc, CR) &= ~CR_ADCAL;
    } else if (adc->phase == STARTING) {
        adc->phase = IDLE;
        flag(adc, ISR_ADRDY);
    } else if (adc->samples && (adc->injected || adc->regular)) {
        adc->samples = false;
        adc->held = convert(adc, adc->injected ? injected_channel(adc, adc->injected_at)
                                               : regular_channel(adc, adc->regular_at));
        soc_schedule(EVENT_ADC + (soc_event_t)number, adc->conversion_ends);
    } else if (adc->injected) {
        injected_ends(adc);
    } else if (adc->regular) {
        regular_ends(adc);
    }
}

/* --- Triggers --- */

#define TRGO(timer) ADC_TRIGGER(timer, ADC_KIND_TRGO)
#define TRGO2(timer) ADC_TRIGGER(timer, ADC_KIND_TRGO2)
#define CC(timer, channel) ADC_TRIGGER(timer, ADC_KIND_CHANNEL + (channel)-1)
#define NONE ADC_TRIGGER_NONE

/* Tables "external triggers for injected (regular) channels", codes 0 to 14; of ADC1 and ADC2, of the others. */
static const uint8_t injected_triggers[2][15] = {
    {TRGO(TIM1), CC(TIM1, 4), TRGO(TIM2), CC(TIM2, 1), CC(TIM3, 4), TRGO(TIM4), ADC_TRIGGER_EXTI15, CC(TIM8, 4),
     TRGO2(TIM1), TRGO(TIM8), TRGO2(TIM8), CC(TIM3, 3), TRGO(TIM3), CC(TIM3, 1), TRGO(TIM6)},
    {TRGO(TIM1), CC(TIM1, 4), TRGO(TIM2), CC(TIM8, 2), CC(TIM4, 3), TRGO(TIM4), CC(TIM4, 4), CC(TIM8, 4), TRGO2(TIM1),
     TRGO(TIM8), TRGO2(TIM8), CC(TIM1, 3), TRGO(TIM3), ADC_TRIGGER_EXTI3, TRGO(TIM6)},
};
static const uint8_t regular_triggers[2][15] = {
    {CC(TIM1, 1), CC(TIM1, 2), CC(TIM1, 3), CC(TIM2, 2), TRGO(TIM3), CC(TIM4, 4), NONE, TRGO(TIM8), TRGO2(TIM8),
     TRGO(TIM1), TRGO2(TIM1), TRGO(TIM2), TRGO(TIM4), TRGO(TIM6), NONE},
    {CC(TIM3, 1), CC(TIM2, 3), CC(TIM1, 3), CC(TIM8, 1), TRGO(TIM3), NONE, CC(TIM4, 1), TRGO(TIM8), TRGO2(TIM8),
     TRGO(TIM1), TRGO2(TIM1), TRGO(TIM2), TRGO(TIM4), TRGO(TIM6), NONE},
};

static bool selected(const uint8_t table[15], uint32_t code, unsigned source) {
    return code < 15 ? table[code] == source : code == 30 && source == TRGO(TIM7);
}

void adc_trigger(unsigned source) {
    for (unsigned i = 0; i < CONVERTERS; ++i) {
        adc_t *adc = &adcs[i];
        const uint32_t control = ADC_REG(adc, CR), jsqr = ADC_REG(adc, JSQR), cfgr = ADC_REG(adc, CFGR);
        if (control & CR_JADSTART && jsqr >> 7 & 3 &&
            selected(injected_triggers[adc->second_group], jsqr >> 2 & 31, source)) {
            start_injected(adc);
        }
        if (control & CR_ADSTART && cfgr >> 10 & 3 &&
            selected(regular_triggers[adc->second_group], cfgr >> 5 & 31, source)) {
            start_regular(adc);
        }
    }
}

/* --- Registers --- */

static void refuse(const adc_t *adc, uint32_t offset, uint32_t value, const char *why) {
    soc_violation("write of %s, value 0x%08X: %s", soc_name(adc->base + offset), value, why);
}

static void power(adc_t *adc, uint32_t value) {
    const uint32_t old = ADC_REG(adc, CR);
    if (value & CR_ADVREGEN && value & CR_DEEPPWD) {
        refuse(adc, CR, value, "ADVREGEN needs DEEPPWD = 0");
    }
    if (old & CR_ADEN && (old ^ value) & (CR_ADVREGEN | CR_DEEPPWD)) {
        refuse(adc, CR, value, "the regulator changes while the converter is enabled");
    }
    if (value & CR_ADVREGEN && !(old & CR_ADVREGEN)) {
        adc->regulator_from = soc_ns(soc.now);
    }
    ADC_REG(adc, CR) = (old & ~(CR_ADVREGEN | CR_DEEPPWD | 1u << 30)) | (value & (CR_ADVREGEN | CR_DEEPPWD | 1u << 30));
}

static void need_regulator(const adc_t *adc, uint32_t value) {
    if (!(ADC_REG(adc, CR) & CR_ADVREGEN) || (!soc.untimed && soc_ns(soc.now) < adc->regulator_from + REGULATOR_NS)) {
        refuse(adc, CR, value, "the voltage regulator (ADVREGEN) has not run for 20 us");
    }
}

static void calibrate(adc_t *adc, uint32_t value) {
    need_regulator(adc, value);
    if (ADC_REG(adc, CR) & CR_ADEN) {
        refuse(adc, CR, value, "ADCAL while the converter is enabled");
    }
    ADC_REG(adc, CR) |= CR_ADCAL;
    adc->phase = CALIBRATING;
    soc_schedule(EVENT_ADC + (soc_event_t)(adc - adcs), soc.now + cycles(adc, 2 * CALIBRATION_CLOCKS));
}

static void enable(adc_t *adc, uint32_t value) {
    need_regulator(adc, value);
    if (ADC_REG(adc, CR) & CR_ADCAL || adc->calibrated_at == SOC_NEVER) {
        refuse(adc, CR, value, "ADEN before the calibration has ended");
    }
    if (soc.now < adc->calibrated_at + cycles(adc, 2 * AFTER_CALIBRATION)) {
        refuse(adc, CR, value, "ADEN within 4 clocks of the converter after ADCAL");
    }
    ADC_REG(adc, CR) |= CR_ADEN;
    adc->phase = STARTING;
    adc->ready_seen = false;
    soc_schedule(EVENT_ADC + (soc_event_t)(adc - adcs), soc.now + cycles(adc, 2 * START_CLOCKS));
}

static void start(adc_t *adc, uint32_t value) {
    if (!(ADC_REG(adc, CR) & CR_ADEN) || adc->phase == STARTING || !adc->ready_seen) {
        refuse(adc, CR, value, "a start before the converter is ready (ADRDY), or without having read that");
    }
    clock_hz(adc);
    const uint32_t rises = value & ~ADC_REG(adc, CR);
    ADC_REG(adc, CR) |= value & (CR_ADSTART | CR_JADSTART);
    if (rises & CR_JADSTART && !(ADC_REG(adc, JSQR) >> 7 & 3)) {
        start_injected(adc);
    }
    if (rises & CR_ADSTART && !(ADC_REG(adc, CFGR) >> 10 & 3)) {
        start_regular(adc);
    }
}

static void control_write(adc_t *adc, uint32_t value) {
    if (adc->phase == CALIBRATING) {
        refuse(adc, CR, value, "the calibration runs");
    }
    power(adc, value);
    if (value & CR_ADCAL) {
        calibrate(adc, value);
    }
    if (value & CR_ADEN && !(ADC_REG(adc, CR) & CR_ADEN)) {
        enable(adc, value);
    }
    if (value & (CR_JADSTP | CR_ADSTP)) {
        adc->injected = adc->injected && !(value & CR_JADSTP);
        adc->regular = adc->regular && !(value & CR_ADSTP);
        ADC_REG(adc, CR) &= ~((value & CR_JADSTP ? CR_JADSTART : 0) | (value & CR_ADSTP ? CR_ADSTART : 0));
    } else if (value & (CR_ADSTART | CR_JADSTART) & ~ADC_REG(adc, CR)) {
        start(adc, value);
    }
    if (value & CR_ADDIS) {
        if (ADC_REG(adc, CR) & (CR_ADSTART | CR_JADSTART)) {
            refuse(adc, CR, value, "ADDIS while conversions are started");
        }
        ADC_REG(adc, CR) &= ~CR_ADEN;
    }
}

static void check_idle(const adc_t *adc, uint32_t offset, uint32_t value, uint32_t started) {
    if (ADC_REG(adc, CR) & started) {
        refuse(adc, offset, value, "while conversions are started");
    }
}

static void adc_write(uint32_t address, uint32_t value) {
    adc_t *adc = &adcs[0];
    for (unsigned i = 0; i < CONVERTERS; ++i) {
        adc = (address & ~0xFFu) == adcs[i].base ? &adcs[i] : adc;
    }
    const uint32_t offset = address - adc->base;
    switch (offset) {
    case ISR:
        ADC_REG(adc, ISR) &= ~value;
        lines();
        return;
    case IER:
        REG(address) = value;
        lines();
        return;
    case CR:
        control_write(adc, value);
        return;
    case CFGR:
        check_idle(adc, offset, value, CR_ADSTART | CR_JADSTART);
        if (value & CFGR_UNMODELLED || !(value & CFGR_JQDIS)) {
            refuse(adc, offset, value, "watchdogs, discontinuous and automatic modes and the queue are not modelled");
        }
        break;
    case JSQR:
        check_idle(adc, offset, value, CR_JADSTART);
        if (value >> 8 & 1 && (value >> 2 & 31) != 6) {
            refuse(adc, offset, value, "the falling edge of a timer's pulse, of a length that no manual gives");
        }
        break;
    case CFGR2:
        if (value) {
            refuse(adc, offset, value, "oversampling and gain are not modelled");
        }
        break;
    default:
        if (offset >= OFR1 && offset <= OFR4 && value >> 31) {
            refuse(adc, offset, value, "offsets are not modelled");
        }
        if (offset >= SMPR1 && offset < SQR1) {
            check_idle(adc, offset, value, CR_ADSTART | CR_JADSTART);
        } else if (offset >= SQR1 && offset < DR) {
            check_idle(adc, offset, value, CR_ADSTART);
        }
    }
    REG(address) = value;
}

static uint32_t adc_read(uint32_t address) {
    for (unsigned i = 0; i < CONVERTERS && (address & 0xFF) == ISR; ++i) {
        adcs[i].ready_seen = adcs[i].ready_seen || (address == adcs[i].base && REG(address) & ISR_ADRDY);
    }
    if ((address & 0xFF) == DR) {
        REG(address - DR + ISR) &= ~ISR_EOC;
        lines();
    } else if ((address & 0xFC) >= JDR1 && (address & 0xFC) < JDR1 + 16) {
        REG((address & ~0xFFu) + ISR) &= ~ISR_JEOC;
        lines();
    }
    return REG(address);
}

static void common_write(uint32_t address, uint32_t value) {
    const unsigned first = address >= 0x50000400u ? 2 : 0, last = address >= 0x50000400u ? 4 : 1;
    for (unsigned i = first; i <= last; ++i) {
        if (ADC_REG(&adcs[i], CR) & CR_ADEN && (value ^ REG(address)) & 0x3F0000) {
            soc_violation("write of %s, value 0x%X: the clock changes while a converter is enabled", soc_name(address),
                          value);
        }
    }
    if (value & 0xEF1F) {
        soc_violation("write of %s, value 0x%X: dual modes are not modelled", soc_name(address), value);
    }
    REG(address) = value;
}

void adc_attach(void) {
    for (unsigned i = 0; i < CONVERTERS; ++i) {
        soc_attach(adcs[i].base, 0x100, 0x4002104Cu, adcs[i].second_group ? 14 : 13, adc_read, adc_write);
    }
    soc_attach(0x50000300u, 0x10, 0x4002104Cu, 13, NULL, common_write);
    soc_attach(0x50000700u, 0x10, 0x4002104Cu, 14, NULL, common_write);
}

void adc_reset(void) {
    for (unsigned i = 0; i < CONVERTERS; ++i) {
        adcs[i].phase = IDLE;
        adcs[i].injected = adcs[i].regular = false;
        adcs[i].calibrated_at = SOC_NEVER;
    }
    lines();
}
