/* SPDX-License-Identifier: GPL-2.0-or-later */
#include "stm32g4/part_pins.h"

#include <stdlib.h>
#include <string.h>

#include "stm32g4/peripherals.h"

#define FUNCTIONS 16
#define CONVERTERS 5
#define CHANNELS 20

static const pin_row_t pin_rows[] = {
#include "stm32g4/pins.inc"
};

/* Index of the table: what is asked at each event must not compare texts. */
static struct {
    bool made;
    pin_list_t list[TIMERS][PIN_KINDS];
    struct {
        bool known, complementary;
        uint8_t timer, channel;
    } channel[GPIO_PINS][FUNCTIONS];
} made;

const pin_row_t *pins_first(void) {
    return pin_rows;
}

const pin_row_t *pins_end(void) {
    return pin_rows + sizeof pin_rows / sizeof pin_rows[0];
}

static void add(const pin_row_t *row) {
    static const char *const names[PIN_KINDS] = {"CH1", "CH2", "ETR", "BKIN", "BKIN2"};
    const unsigned timer = (unsigned)(row->peripheral[3] - '1');
    for (unsigned kind = 0; kind < PIN_KINDS; ++kind) {
        pin_list_t *list = &made.list[timer][kind];
        if (strcmp(row->signal, names[kind]) == 0 && list->count < PIN_LIST_MAX) {
            list->row[list->count++] = row;
        }
    }
    if (strncmp(row->signal, "CH", 2) == 0) {
        made.channel[row->pin][row->function].known = true;
        made.channel[row->pin][row->function].timer = (uint8_t)timer;
        made.channel[row->pin][row->function].channel = (uint8_t)(row->signal[2] - '1');
        made.channel[row->pin][row->function].complementary = row->signal[3] == 'N';
    }
}

static void make(void) {
    if (made.made) {
        return;
    }
    for (const pin_row_t *row = pins_first(); row < pins_end(); ++row) {
        if (strncmp(row->peripheral, "TIM", 3) == 0) {
            add(row);
        }
    }
    made.made = true;
}

const pin_list_t *pins_of_timer(unsigned timer, pin_kind_t kind) {
    make();
    return &made.list[timer][kind];
}

bool pins_channel(unsigned pin, unsigned function, unsigned *timer, unsigned *channel, bool *complementary) {
    make();
    *timer = made.channel[pin][function].timer;
    *channel = made.channel[pin][function].channel;
    *complementary = made.channel[pin][function].complementary;
    return made.channel[pin][function].known;
}

bool pins_lead(const char *peripheral, const char *signal) {
    for (const pin_row_t *row = pins_first(); row < pins_end(); ++row) {
        if (strcmp(row->peripheral, peripheral) == 0 && strcmp(row->signal, signal) == 0 &&
            gpio_function(row->pin) == row->function) {
            return true;
        }
    }
    return false;
}

int pins_of_converter(unsigned converter, unsigned channel) {
    static int pins[CONVERTERS][CHANNELS];
    static bool found;
    if (!found) {
        memset(pins, 0xFF, sizeof pins);
        for (const pin_row_t *row = pins_first(); row < pins_end(); ++row) {
            if (strncmp(row->peripheral, "ADC", 3) == 0 && strncmp(row->signal, "IN", 2) == 0 &&
                row->signal[2] != 'N') {
                pins[row->peripheral[3] - '1'][strtoul(row->signal + 2, NULL, 10)] = (int)row->pin;
            }
        }
        found = true;
    }
    return channel < CHANNELS ? pins[converter][channel] : -1;
}
