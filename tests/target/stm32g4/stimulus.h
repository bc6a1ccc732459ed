/* The first stimulus port, whose characters the model prints. */
#ifndef STIMULUS_H
#define STIMULUS_H

#include <stdint.h>

static inline void stimulus_character(char character) {
    *(volatile uint8_t *)0xE0000000u = (uint8_t)character;
}

/* In decimal. */
static inline void stimulus_number(uint32_t number) {
    char text[10];
    unsigned n = 0;
    do {
        text[n++] = (char)('0' + number % 10);
        number /= 10;
    } while (number);
    while (n) {
        stimulus_character(text[--n]);
    }
}

#endif
