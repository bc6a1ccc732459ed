/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Execution trace of a run: executions of each block of instructions, in total and in control interrupts, and the
 * lowest stack address that was written.
 */
#ifndef QEMU_TRACE_H
#define QEMU_TRACE_H

#include <stdbool.h>

struct qemu_plugin_tb;

/* Begins a text file, which will have these lines, addresses in hexadecimal, all else in decimal:
 *   block ADDRESS INSTRUCTIONS EXECUTED IN_INTERRUPTS IN_WORST
 *       instructions that follow each other; how often they ran, in control interrupts, in the first of the longest
 *       interrupts; blocks may overlap
 *   stack thread ADDRESS
 *       the lowest byte that the background wrote to
 *   stack interrupt BYTES
 *       from the highest to the lowest word that one interrupt wrote to, at most
 * The stack, a text: the address that it ends at and the one that it begins below, "0x20000b70-0x20008000". Without a
 * store there ADDRESS is ffffffffffffffff, that of no byte, and BYTES is 0. False, after one line on stderr, on
 * failure. */
bool trace_open(const char *path, const char *stack);

/* Counts in a block that is being translated. */
void trace_translate(struct qemu_plugin_tb *tb);

/* Writes the file and ends it; false, after one line on stderr, when a write has failed. */
bool trace_close(void);

#endif
