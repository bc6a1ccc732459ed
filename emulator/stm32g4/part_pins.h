/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Table of the part's pins: peripheral, signal, alternate function; triggers of the converters.
 */
#ifndef STM32G4_PART_PINS_H
#define STM32G4_PART_PINS_H

#include <stdbool.h>

typedef struct {
    unsigned pin; /* as GPIO_PINS */
    const char *peripheral, *signal;
    int function; /* -1: analogue */
} pin_row_t;

const pin_row_t *pins_first(void);
const pin_row_t *pins_end(void);

/* Inputs of a timer, and the pins that lead to one of them. */
typedef enum { PIN_CH1, PIN_CH2, PIN_ETR, PIN_BKIN, PIN_BKIN2, PIN_KINDS } pin_kind_t;
#define PIN_LIST_MAX 10
typedef struct {
    unsigned count;
    const pin_row_t *row[PIN_LIST_MAX];
} pin_list_t;
const pin_list_t *pins_of_timer(unsigned timer, pin_kind_t kind);

/* Timer (from 0: TIM1) and channel of a pin with an alternate function; false: none. */
bool pins_channel(unsigned pin, unsigned function, unsigned *timer, unsigned *channel, bool *complementary);

/* Pin of a channel of a converter, from 0; -1: none. */
int pins_of_converter(unsigned converter, unsigned channel);

/* A pin is configured for a signal of a peripheral. */
bool pins_lead(const char *peripheral, const char *signal);

/* Sources that trigger a converter: TRGO, TRGO2, or the compare event of a channel of a timer. */
#define ADC_TRIGGER(timer, kind) ((timer)*8u + (kind))
#define ADC_KIND_TRGO 0u
#define ADC_KIND_TRGO2 1u
#define ADC_KIND_CHANNEL 2u /* plus 0 to 3 */
#define ADC_TRIGGER_EXTI15 200u
#define ADC_TRIGGER_EXTI3 201u
#define ADC_TRIGGER_NONE 255u

#endif
