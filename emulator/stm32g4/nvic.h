/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * NVIC, system control block, SysTick, and of the debug blocks the cycle counter and the stimulus ports: bytes of the
 * first go to standard output, words of the others to a bench. ARMv7-M ARM, B1.5, B3.2 to B3.4.
 */
#ifndef STM32G4_NVIC_H
#define STM32G4_NVIC_H

#include <stdbool.h>
#include <stdint.h>

/* State after reset. */
void nvic_reset(void);

/* An exception is pending and enabled, whatever its priority. */
bool nvic_any(void);

/* The exception to take, 0 none; primask, basepri: registers of the processor. */
unsigned nvic_candidate(bool primask, uint32_t basepri);

/* The exception becomes active, or ends (pending again while its line is high). */
void nvic_enter(unsigned exception);
void nvic_leave(unsigned exception);

void nvic_line(unsigned exception, bool level);

/* A peripheral has been read: stores of before have arrived, and the requests that they have ended are gone. */
void nvic_settle(void);
void nvic_pend(unsigned exception);
bool nvic_is_active(unsigned exception);

/* Address of the vector table. */
uint32_t nvic_vectors(void);

/* Registers of 0xE0000000 to 0xE00FFFFF; offset from there. */
uint32_t nvic_read(uint32_t offset, unsigned size);
void nvic_write(uint32_t offset, uint32_t value, unsigned size);

/* Words that a program writes to a stimulus port from 1 on, for a bench. */
typedef void (*nvic_stimulus_t)(unsigned port, uint32_t value);
void nvic_set_stimulus(nvic_stimulus_t function);

/* EVENT_SYSTICK. */
void nvic_systick_event(void);

#endif
