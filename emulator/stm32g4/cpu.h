/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Cortex-M4 of the model: instructions by Unicorn, exceptions, NVIC, SysTick and sleep here.
 *
 * Interrupt lines are levels, as the peripherals have them: a line that is still high at the end of its handler pends
 * again. Priorities have four bits and the grouping of AIRCR; an exception of higher priority that comes before the
 * first instruction of a handler runs first (late arrival), and one that is pending at the end of a handler follows
 * without a return (tail-chaining). Interrupts are taken between blocks of instructions. The floating-point unit is
 * off: its instructions end the run, as does every fault.
 */
#ifndef STM32G4_CPU_H
#define STM32G4_CPU_H

#include <stdbool.h>
#include <stdint.h>

#define CPU_EXCEPTIONS 118 /* 16 of the processor, 102 interrupts */
#define CPU_IRQ(number) (16u + (number))

typedef struct {
    uint64_t instructions, blocks, exceptions, tail_chained;
    bool asleep;   /* in WFI */
    bool exited;   /* by BKPT, with exit_code */
    int exit_code; /* R0 at BKPT */
} cpu_t;

extern cpu_t cpu;

void cpu_open(void);

/* Loads the segments of an ELF file at their physical addresses; ends the program, after one line on stderr, when it is
 * none or is outside of flash. */
void cpu_load(const char *path);

/* Reset: stack pointer and program counter from the vector table at the start of flash. */
void cpu_reset(void);

/* Runs until the cycle, BKPT, or, with `to_sleep`, until the processor sleeps with nothing to wake it. */
void cpu_run(uint64_t end, bool to_sleep);

/* Runs the handlers of what is pending, and of what they pend, up to the return to the main program. */
void cpu_run_handlers(void);

/* A word of bank 1 has a double error from now on. */
void cpu_tear(uint32_t address);

/* The processor does not execute until the cycle (a stall of the flash). */
void cpu_stall(uint64_t to);

uint32_t cpu_program_counter(void);

/* Memory, for DMA; size in bytes. */
uint32_t cpu_memory_read(uint32_t address, unsigned size);
void cpu_memory_write(uint32_t address, uint32_t value, unsigned size);

/* Number of the exception whose handler executes; 0: none. */
unsigned cpu_exception(void);

#endif
