/* Start and end of a program on the bare Cortex-M4, and its one interrupt. */
#ifndef STARTUP_H
#define STARTUP_H

#include <stdint.h>
#include <stdnoreturn.h>

/* The program; it does not return. Called from reset, in thread mode, with variables initialised. */
noreturn void program(void);

/* The control interrupt's work. Called in handler mode, at the top priority, when interrupt_pend asked for it. */
void program_interrupt(void);

/* Lets interrupt_pend act. */
void interrupt_enable(void);

/* Asks for the control interrupt, as the timer would. Unless interrupts are kept out it is over when this returns. */
void interrupt_pend(void);

/* Ends QEMU with an exit code, by semihosting. */
noreturn void semihosting_exit(uint32_t code);

#endif
