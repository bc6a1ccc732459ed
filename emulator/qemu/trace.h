/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * What the processor did in a run: how often each block of instructions was executed, in all and in control interrupts,
 * and how far down the stack was written to.
 */
#ifndef EXECUTION_H
#define EXECUTION_H

#include <stdbool.h>

struct qemu_plugin_tb;

/* Begins a text file, which will have these lines, addresses in hexadecimal, all else in decimal:
 *   block ADDRESS INSTRUCTIONS EXECUTED IN_INTERRUPTS IN_WORST
 *       instructions that follow each other; how often they ran, in control interrupts, in the first of the dearest
 *       interrupts; blocks may overlap
 *   stack thread ADDRESS
 *       the lowest byte that the background wrote to
 *   stack interrupt BYTES
 *       from the highest to the lowest word that one interrupt wrote to, at most
 * The stack, a text: the address that it ends at and the one that it begins below, "0x20000b70-0x20008000". Without a
 * store there ADDRESS is ffffffffffffffff, that of no byte, and BYTES is 0. False: one line on stderr said why. */
bool execution_open(const char *path, const char *stack);

/* Counts in a block that is being translated. */
void execution_translate(struct qemu_plugin_tb *tb);

/* Writes the file and ends it; false: one line on stderr said that it is not whole. */
bool execution_close(void);

#endif
