/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * General-purpose ports A to D (RM0440, 9), their wires, and external interrupts of pins (15).
 *
 * The level of a pin: what drives it from outside, else its own output (port or timer), else a wire to another pin,
 * else its pull resistor, else low.
 */
#include <stdio.h>
#include <string.h>

#include "stm32g4/nvic.h"
#include "stm32g4/part_pins.h"
#include "stm32g4/peripherals.h"

#define GPIO 0x48000000u
#define PORT_BYTES 0x400u
#define MODER 0x00u
#define OTYPER 0x04u
#define PUPDR 0x0Cu
#define IDR 0x10u
#define ODR 0x14u
#define BSRR 0x18u
#define LCKR 0x1Cu
#define AFRL 0x20u
#define BRR 0x28u
#define EXTI 0x40010400u
#define IMR1 (EXTI + 0x00)
#define RTSR1 (EXTI + 0x08)
#define FTSR1 (EXTI + 0x0C)
#define SWIER1 (EXTI + 0x10)
#define PR1 (EXTI + 0x14)
#define EXTICR1 0x40010008u
#define PORTS 4
#define WIRES_MAX 32
#define MODE_OUTPUT 1u
#define MODE_FUNCTION 2u
#define MODE_ANALOG 3u

static struct {
    bool driven[GPIO_PINS], outside[GPIO_PINS], level[GPIO_PINS];
    unsigned wires;
    struct {
        unsigned from, to;
    } wire[WIRES_MAX];
    bool refreshing;
} gpio;

static uint32_t *port(unsigned pin, uint32_t offset) {
    return soc_word(GPIO + pin / 16 * PORT_BYTES + offset);
}

static uint32_t mode(unsigned pin) {
    return *port(pin, MODER) >> 2 * (pin % 16) & 3;
}

int gpio_function(unsigned pin) {
    if (mode(pin) != MODE_FUNCTION) {
        return -1;
    }
    return (int)(*port(pin, AFRL + 4 * (pin % 16 / 8)) >> 4 * (pin % 8) & 15);
}

bool gpio_is_analog(unsigned pin) {
    return mode(pin) == MODE_ANALOG;
}

const char *gpio_name(unsigned pin) {
    static char name[8];
    snprintf(name, sizeof name, "P%c%u", 'A' + pin / 16, pin % 16);
    return name;
}

/* --- Levels --- */

/* Level that the pin itself drives; false: it drives none. */
static bool own(unsigned pin, bool *level) {
    switch (mode(pin)) {
    case MODE_OUTPUT:
        *level = *port(pin, ODR) >> (pin % 16) & 1;
        return !(*port(pin, OTYPER) >> (pin % 16) & 1) || !*level; /* open drain: low only */
    case MODE_FUNCTION:
        return timer_output(pin, (unsigned)gpio_function(pin), level);
    default:
        return false;
    }
}

static bool present(unsigned pin) {
    bool level = false;
    if (gpio.driven[pin]) {
        return gpio.outside[pin];
    }
    if (own(pin, &level)) {
        return level;
    }
    for (unsigned i = 0; i < gpio.wires; ++i) {
        const unsigned other = gpio.wire[i].from == pin ? gpio.wire[i].to : gpio.wire[i].from;
        if ((gpio.wire[i].from == pin || gpio.wire[i].to == pin) && own(other, &level)) {
            return level;
        }
    }
    return (*port(pin, PUPDR) >> 2 * (pin % 16) & 3) == 1;
}

static void exti_line(unsigned line) {
    static const uint8_t irq[] = {6, 7, 8, 9, 10, 23, 23, 23, 23, 23, 40, 40, 40, 40, 40, 40};
    uint32_t shared = 0;
    for (unsigned i = 0; i < 16; ++i) {
        shared |= irq[i] == irq[line] ? 1u << i : 0;
    }
    nvic_line(16u + irq[line], REG(PR1) & REG(IMR1) & shared);
}

static void exti_edge(unsigned pin, bool level) {
    const unsigned line = pin % 16, selected = REG(EXTICR1 + line / 4 * 4) >> 4 * (line % 4) & 15;
    if (selected == pin / 16 && REG(level ? RTSR1 : FTSR1) >> line & 1) {
        REG(PR1) |= 1u << line;
        exti_line(line);
        if (line == 15) {
            adc_trigger(ADC_TRIGGER_EXTI15);
        } else if (line == 3) {
            adc_trigger(ADC_TRIGGER_EXTI3);
        }
    }
}

void gpio_refresh(void) {
    if (gpio.refreshing) {
        return; /* the loop below sees the change */
    }
    gpio.refreshing = true;
    bool again = true;
    for (unsigned round = 0; again && round < 8; ++round) {
        again = false;
        for (unsigned pin = 0; pin < GPIO_PINS; ++pin) {
            const bool level = present(pin);
            if (level != gpio.level[pin]) {
                gpio.level[pin] = level;
                again = true;
                exti_edge(pin, level);
                timer_input(pin, level);
            }
        }
    }
    gpio.refreshing = false;
    timer_break_changed();
}

bool gpio_level(unsigned pin) {
    return present(pin);
}

void gpio_connect(unsigned from, unsigned to) {
    if (gpio.wires < WIRES_MAX) {
        gpio.wire[gpio.wires].from = from;
        gpio.wire[gpio.wires++].to = to;
    }
}

void gpio_drive(unsigned pin, bool level) {
    gpio.driven[pin] = true;
    gpio.outside[pin] = level;
    if (level != gpio.level[pin] && !gpio.refreshing) {
        gpio.level[pin] = level;
        exti_edge(pin, level);
        timer_input(pin, level);
        timer_break_changed();
    }
}

void gpio_release(unsigned pin) {
    gpio.driven[pin] = false;
    gpio_refresh();
}

/* --- Registers --- */

static uint32_t gpio_read(uint32_t address) {
    if ((address & (PORT_BYTES - 1)) != IDR) {
        return REG(address);
    }
    const unsigned first = (address - GPIO) / PORT_BYTES * 16;
    uint32_t value = 0;
    for (unsigned i = 0; i < 16; ++i) {
        value |= mode(first + i) != MODE_ANALOG && present(first + i) ? 1u << i : 0;
    }
    return value;
}

/* A pin that becomes an alternate function has one: the number is written first. */
static void check_functions(uint32_t base, uint32_t value) {
    for (unsigned i = 0; i < 16; ++i) {
        const unsigned pin = (base - GPIO) / PORT_BYTES * 16 + i,
                       number = *port(pin, AFRL + 4 * (i / 8)) >> 4 * (i % 8) & 15;
        if ((value >> 2 * i & 3) != MODE_FUNCTION || mode(pin) == MODE_FUNCTION) {
            continue;
        }
        const pin_row_t *row = pins_first();
        while (row < pins_end() && !(row->pin == pin && row->function == (int)number)) {
            ++row;
        }
        if (row == pins_end()) {
            soc_violation("write of %s, value 0x%08X: %s has no alternate function %u", soc_name(base), value,
                          gpio_name(pin), number);
        }
    }
}

static void gpio_write(uint32_t address, uint32_t value) {
    const uint32_t base = address & ~(PORT_BYTES - 1);
    switch (address - base) {
    case MODER:
        check_functions(base, value);
        REG(address) = value;
        break;
    case BSRR:
        REG(base + ODR) = ((REG(base + ODR) & ~(value >> 16)) | (value & 0xFFFF)) & 0xFFFF;
        break;
    case BRR:
        REG(base + ODR) &= ~value & 0xFFFF;
        break;
    case LCKR:
        soc_violation("write of %s, value 0x%08X: the lock of a port is not modelled", soc_name(address), value);
    default:
        REG(address) = value;
    }
    gpio_refresh();
}

static void exti_write(uint32_t address, uint32_t value) {
    switch (address) {
    case PR1:
        REG(PR1) &= ~value;
        break;
    case SWIER1:
        REG(PR1) |= value;
        break;
    default:
        REG(address) = value;
    }
    for (unsigned line = 0; line < 16; ++line) {
        exti_line(line);
    }
}

void gpio_attach(void) {
    for (unsigned i = 0; i < PORTS; ++i) {
        soc_attach(GPIO + i * PORT_BYTES, PORT_BYTES, 0x4002104Cu, i, gpio_read, gpio_write);
    }
    soc_attach(EXTI, 0x18, 0, 0, NULL, exti_write);
    soc_attach(0x40010000u, 0x30, 0x40021060u, 0, NULL, NULL); /* SYSCFG */
}

void gpio_reset(void) {
    for (unsigned line = 0; line < 16; ++line) {
        exti_line(line);
    }
    for (unsigned pin = 0; pin < GPIO_PINS; ++pin) {
        gpio.level[pin] = present(pin);
    }
}
