/* Functions of a QEMU board for the program of the drive (emulator/qemu/image/main.c). A board implements these, the
 * critical section of hal_time.h, hal_interrupt_elapsed_ticks, hal_interrupt_request_deferred and the exception
 * vectors, and has a linker script memory.ld.
 *
 * The instruction counter recognises the ends of both interrupts by symbols: control_handler is the first instruction
 * of the control interrupt's handler, control_handler_return the start of its epilogue, which has no jump before the
 * return and lies within one page; deferred_handler and deferred_handler_return likewise.
 */
#ifndef BOARD_H
#define BOARD_H

#include <stdint.h>
#include <stdnoreturn.h>

/* Entry point of the program after reset: the stack is set up, variables are not initialised. */
noreturn void program_start(void);

/* Bodies of the control interrupt and of the deferred interrupt; the handlers call them in interrupt context. */
void program_interrupt(void);
void program_deferred(void);

/* Enables both interrupts and, with instruction timing, starts the timer; the period is in the mailbox. */
void board_interrupt_enable(void);

/* Requests the control interrupt in place of the timer, and returns after it; not in a critical section. From the
 * background it returns after the deferred interrupt that the control interrupt has requested. */
void board_interrupt_pend(void);

/* Starts the program again, with an empty stack; in the background. */
noreturn void board_restart(void);

/* Ends QEMU with an exit code, 0..255. */
noreturn void board_exit(uint32_t code);

#endif
