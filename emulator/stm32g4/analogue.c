/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Comparators (RM0440, 24) and the converters that give their thresholds (22). Hysteresis, blanking and the response
 * time are left out; the reference is 3.3 V.
 */
#include <string.h>

#include "stm32g4/part_pins.h"
#include "stm32g4/peripherals.h"

#define COMP 0x40010200u
#define COMPARATORS 7u
#define CSR_EN 1u
#define CSR_INPSEL (1u << 8)
#define CSR_POL (1u << 15)
#define CSR_VALUE (1u << 30)
#define CSR_LOCK (1u << 31)
#define DAC1 0x50000800u
#define DAC_STEP 0x400u
#define DACS 4u
#define DAC_CR 0x00u
#define DHR12R1 0x08u
#define DHR12R2 0x14u
#define DOR1 0x2Cu
#define MCR 0x3Cu
#define FULL_SCALE 4096.0
#define VREF_V 3.3
#define VREFINT_V 1.212

static double pin_V[GPIO_PINS];
static bool output[COMPARATORS];

void analog_set_pin(unsigned pin, double volts) {
    pin_V[pin] = volts;
}

static uint32_t dac_base(unsigned dac) {
    return DAC1 + dac * DAC_STEP;
}

static double dac_V(unsigned dac, unsigned channel) {
    const bool on = REG(dac_base(dac) + DAC_CR) >> 16 * channel & 1;
    return on ? REG(dac_base(dac) + DOR1 + 4 * channel) / FULL_SCALE * VREF_V : 0.0;
}

/* Table "COMPx inverting input assignment": codes 4 and 5. */
static double threshold_V(unsigned comparator, uint32_t select) {
    static const struct {
        uint8_t dac, channel;
    } sources[COMPARATORS][2] = {
        {{2, 0}, {0, 0}}, {{2, 1}, {0, 1}}, {{2, 0}, {0, 0}}, {{2, 1}, {0, 0}},
        {{3, 0}, {0, 1}}, {{3, 1}, {1, 0}}, {{3, 0}, {1, 0}},
    };
    if (select < 4) {
        return VREFINT_V * (select + 1) / 4.0;
    }
    if (select > 5) {
        soc_violation("COMP_C%uCSR: an inverting input at a pin is not modelled", comparator + 1);
    }
    return dac_V(sources[comparator][select - 4].dac, sources[comparator][select - 4].channel);
}

/* Pins of the inputs INP0 and INP1, found once. */
static int input_pin(unsigned comparator, bool second) {
    static int pins[COMPARATORS][2];
    static bool found;
    for (const pin_row_t *row = pins_first(); !found && row < pins_end(); ++row) {
        if (strncmp(row->peripheral, "COMP", 4) == 0 && strncmp(row->signal, "INP", 3) == 0 && row->signal[3] != 0) {
            pins[row->peripheral[4] - '1'][row->signal[3] - '0'] = (int)row->pin;
        }
    }
    found = true;
    return pins[comparator][second];
}

static double input_V(unsigned comparator, bool second) {
    const unsigned pin = (unsigned)input_pin(comparator, second);
    if (!gpio_is_analog(pin)) {
        soc_violation("COMP_C%uCSR: its input %s is not in analogue mode", comparator + 1, gpio_name(pin));
    }
    return pin_V[pin];
}

bool analog_comparator(unsigned comparator) {
    return output[comparator];
}

void analog_refresh(void) {
    for (unsigned i = 0; i < COMPARATORS; ++i) {
        const uint32_t csr = REG(COMP + 4 * i);
        const bool above = csr & CSR_EN && input_V(i, csr & CSR_INPSEL) > threshold_V(i, csr >> 4 & 7);
        output[i] = csr & CSR_EN && above != ((csr & CSR_POL) != 0);
    }
    timer_break_changed();
}

static uint32_t comparator_read(uint32_t address) {
    return (REG(address) & ~CSR_VALUE) | (output[(address - COMP) / 4] ? CSR_VALUE : 0);
}

static void comparator_write(uint32_t address, uint32_t value) {
    if (REG(address) & CSR_LOCK) {
        soc_violation("write of %s, value 0x%08X: it is locked", soc_name(address), value);
    }
    REG(address) = value & ~CSR_VALUE;
    analog_refresh();
}

static void dac_write(uint32_t address, uint32_t value) {
    const uint32_t base = address & ~(DAC_STEP - 1), offset = address - base;
    switch (offset) {
    case DAC_CR:
        if (value & 0x3FFE3FFEu) {
            soc_violation("write of %s, value 0x%08X: triggers, waves and DMA are not modelled", soc_name(address),
                          value);
        }
        break;
    case DHR12R1:
    case DHR12R2:
        if (value > 0xFFF) {
            soc_violation("write of %s, value 0x%X: 12 bits", soc_name(address), value);
        }
        REG(base + DOR1 + (offset == DHR12R2 ? 4 : 0)) = value;
        break;
    case MCR:
        break;
    default:
        soc_violation("write of %s, value 0x%08X: not modelled", soc_name(address), value);
    }
    REG(address) = value;
    analog_refresh();
}

void analog_attach(void) {
    soc_attach(COMP, 4 * COMPARATORS, 0x40021060u, 0, comparator_read, comparator_write);
    for (unsigned dac = 0; dac < DACS; ++dac) {
        soc_attach(dac_base(dac), 0x40, 0x4002104Cu, 16 + dac, NULL, dac_write);
    }
}

void analog_reset(void) {
    memset(output, 0, sizeof output);
}
