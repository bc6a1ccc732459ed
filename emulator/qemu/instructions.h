/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Instructions of each control interrupt, from the handler's first to its return, both included: exact, and the same on
 * every computer. The hardware's work on exception entry and return is no instruction.
 */
#ifndef INSTRUCTIONS_H
#define INSTRUCTIONS_H

#include <stdbool.h>

struct qemu_plugin_tb;

/* Begins a file with a uint32_t, little endian, for each control interrupt. False, after one line on stderr, on
 * failure. */
bool instructions_open(const char *path);

/* Counts in a block that is being translated. */
void instructions_translate(struct qemu_plugin_tb *tb);

/* Ends the file; false, after one line on stderr, when a write has failed. */
bool instructions_close(void);

#endif
