/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * Co-simulation with a drive that runs in QEMU: the emulator's rig, stepped by the drive's commands in the mailbox.
 *
 * The rig calls a firmware and expects it to return; the drive runs in QEMU and expects its commands to return. The rig
 * therefore has a separate stack: its calls of control interrupt and background return to the drive with an event, and
 * the drive's next MAILBOX_NEXT resumes the rig. One thread, no waiting.
 *
 * A drive whose instructions take time (mailbox.h) reports the trigger that it serves and the interrupt's execution
 * time; the rig then behaves as on the host with the bench variable interrupt_time_us.
 */
#ifndef QEMU_COSIMULATION_H
#define QEMU_COSIMULATION_H

#include <stdbool.h>

#include "host/options.h"
#include "qemu/mailbox.h"

/* Opens the simulation and fills the mailbox, before the drive starts; timed: instructions take time. Keeps both.
 * False, after one line on stderr, on failure. */
bool cosimulation_open(mailbox_t *of_image, const options_t *options, bool timed);

/* Closes the simulation of a drive that ended before MAILBOX_EXIT. */
void cosimulation_abandon(void);

/* Executes the command in the doorbell. Not to be called after MAILBOX_EXIT. */
void cosimulation_serve(void);

#endif
