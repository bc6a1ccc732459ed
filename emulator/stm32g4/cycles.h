/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Time of a block of instructions in cycles: a budget per class of instructions (Cortex-M4 TRM, table 3-1), with the
 * pipeline refill of taken branches and a part of the flash's wait states. It is an estimate: the core has more cases,
 * and the prefetch buffer and the caches of the flash are a mean.
 */
#ifndef STM32G4_CYCLES_H
#define STM32G4_CYCLES_H

#include <stdbool.h>
#include <stdint.h>

/* Instructions in `size` bytes of Thumb code. */
unsigned cycles_instructions(const uint8_t *code, uint32_t size);

/* An instruction of coprocessor 10 or 11, the floating-point unit, is in it. */
bool cycles_floating(const uint8_t *code, uint32_t size);

/* Cycles of the block; wait_states: of the flash, 0 for code in RAM. */
unsigned cycles_of(const uint8_t *code, uint32_t size, unsigned wait_states);

#endif
