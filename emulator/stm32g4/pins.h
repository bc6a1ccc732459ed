/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Table of the part's pins: peripheral, signal, alternate function; triggers of the converters.
 */
#ifndef STM32G4_PINS_H
#define STM32G4_PINS_H

typedef struct {
    unsigned pin; /* as GPIO_PINS */
    const char *peripheral, *signal;
    int function; /* -1: analogue */
} pin_row_t;

const pin_row_t *pins_first(void);
const pin_row_t *pins_end(void);

/* Sources that trigger a converter: TRGO, TRGO2, or the compare event of a channel of a timer. */
#define ADC_TRIGGER(timer, kind) ((timer)*8u + (kind))
#define ADC_KIND_TRGO 0u
#define ADC_KIND_TRGO2 1u
#define ADC_KIND_CHANNEL 2u /* plus 0 to 3 */
#define ADC_TRIGGER_EXTI15 200u
#define ADC_TRIGGER_EXTI3 201u
#define ADC_TRIGGER_NONE 255u

#endif
