/* Memory of the program and registers of the peripherals, for the checks of the background (interrupts/self_test.h). A
 * port that has none of a kind leaves it out: its check then passes. */
#ifndef HAL_MEMORY_H
#define HAL_MEMORY_H

#include <stdbool.h>
#include <stdint.h>

#include "hal.h"

/* Pattern that the start of a program writes to all unused words of its stack. */
#define HAL_STACK_UNUSED UINT32_C(0x57A6CE11)

typedef struct {
    const uint32_t *code;  /* the program in flash: machine code and constants */
    uint32_t code_words;   /* 0: none */
    uint32_t code_crc;     /* CRC-32 of them (fixed/crc32.h), computed after linking */
    const uint32_t *stack; /* its last word, the guard; the stack grows towards it */
    uint32_t stack_words;  /* 0: none */
} hal_memory_t;

/* [background] */
void hal_memory(const hal_t *hal, hal_memory_t *memory);

/* True while the registers of the port's peripherals have the values that the port has written to them. [background] */
bool hal_registers_intact(const hal_t *hal);

#endif
