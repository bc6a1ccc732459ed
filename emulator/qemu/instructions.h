/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Instructions of each control interrupt and of each deferred interrupt, from the first of the handler to its return,
 * both included: exact, and equal on every computer. Exception entry and return by the hardware are not counted, nor
 * are the instructions of control interrupts that pre-empt a deferred one; another handler's are (with
 * instruction timing the timer's, about 60 for each trigger).
 */
#ifndef INSTRUCTIONS_H
#define INSTRUCTIONS_H

#include <stdbool.h>

struct qemu_plugin_tb;

/* Creates files with a uint32_t, little endian, for each interrupt: `control` for each control interrupt, `deferred`
 * for each deferred one; NULL: no file. False, after one line on stderr, on failure. */
bool instructions_open(const char *control, const char *deferred);

/* Instruments a block that is being translated. */
void instructions_translate(struct qemu_plugin_tb *tb);

/* Closes the files; false, after one line on stderr, when a write has failed. */
bool instructions_close(void);

#endif
