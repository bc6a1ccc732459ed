/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Execution trace of a run: executions of each block of instructions, in total and in control interrupts, and the
 * lowest stack address that was written.
 */
#ifndef QEMU_TRACE_H
#define QEMU_TRACE_H

#include <stdbool.h>

struct qemu_plugin_tb;

/* Creates a text file with these lines, addresses in hexadecimal, all other numbers in decimal:
 *   block ADDRESS INSTRUCTIONS EXECUTED IN_INTERRUPTS IN_LONGEST
 *       block of consecutive instructions; executions in total, in control interrupts, in the longest interrupt (the
 *       first of equally long ones); blocks may overlap
 *   stack thread ADDRESS
 *       lowest byte that the background wrote to
 *   stack interrupt BYTES
 *       maximum extent, from the highest to the lowest word, that one interrupt wrote to
 * `stack` is a text: lowest address of the stack and the address above its highest, "0x20000b70-0x20008000". Without a
 * store to the stack ADDRESS is ffffffffffffffff and BYTES is 0. False, after one line on stderr, on failure. */
bool trace_open(const char *path, const char *stack);

/* Instruments a block that is being translated. */
void trace_translate(struct qemu_plugin_tb *tb);

/* Writes and closes the file; false, after one line on stderr, when a write has failed. */
bool trace_close(void);

#endif
