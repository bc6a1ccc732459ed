/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Instructions of all control interrupts by the function that they are in, what it calls left out. What the compiler
 * inlined counts for the function that it is inlined in.
 */
#ifndef PROFILE_H
#define PROFILE_H

#include <stdbool.h>

struct qemu_plugin_tb;

/* Begins a file that will have a line "INSTRUCTIONS FUNCTION" for each function. False: one line on stderr said why. */
bool profile_open(const char *path);

/* Counts in a block that is being translated. */
void profile_translate(struct qemu_plugin_tb *tb);

/* Writes the file and ends it; false: one line on stderr said that it is not whole. */
bool profile_close(void);

#endif
