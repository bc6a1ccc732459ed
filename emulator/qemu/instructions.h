/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Instructions of each control interrupt, from the first of the handler to its return, both included: exact, and equal
 * on every computer. Exception entry and return by the hardware are not counted.
 */
#ifndef INSTRUCTIONS_H
#define INSTRUCTIONS_H

#include <stdbool.h>

struct qemu_plugin_tb;

/* Creates a file with a uint32_t, little endian, for each control interrupt. False, after one line on stderr, on
 * failure. */
bool instructions_open(const char *path);

/* Instruments a block that is being translated. */
void instructions_translate(struct qemu_plugin_tb *tb);

/* Closes the file; false, after one line on stderr, when a write has failed. */
bool instructions_close(void);

#endif
