/* Functions of a QEMU board for the drive's program (emulator/qemu/image/main.c). A board has these, the critical
 * section of hal_time.h, hal_interrupt_elapsed_ticks, the processor's vectors or their like, and a linker script
 * memory.ld.
 *
 * Who counts instructions knows the control interrupt's ends by their names: control_handler is the handler's first
 * instruction; at control_handler_return it begins its end, which has no jump before the return and lies within a page.
 */
#ifndef BOARD_H
#define BOARD_H

#include <stdint.h>
#include <stdnoreturn.h>

/* The program: the processor's reset leads here, with a stack and without variables. */
noreturn void program_start(void);

/* The control interrupt's work: the handler calls it, in the processor's interrupt context. */
void program_interrupt(void);

/* Lets board_interrupt_pend act, and starts the timer on a processor that takes time. The period is in the mailbox. */
void board_interrupt_enable(void);

/* Asks for the control interrupt, as the timer would; not in a critical section. It is over when this returns. */
void board_interrupt_pend(void);

/* Ends QEMU with an exit code, 0..255. */
noreturn void board_exit(uint32_t code);

#endif
