/* SPDX-License-Identifier: GPL-2.0-or-later
 *
 * The world behind the mailbox: the emulator's bench, stepped by the drive's commands.
 *
 * The rig calls a firmware and expects it to return; the drive runs in QEMU and expects its commands to return. Both
 * are satisfied by giving the rig a stack of its own: what the rig calls as control interrupt and background goes back
 * to the drive with an event, and the drive's next MAILBOX_NEXT lets the rig go on. One thread, no waiting.
 *
 * A drive that takes time (mailbox.h) says which trigger it serves and how long that took; the rig then does what it
 * does on the host when the bench says how long an interrupt takes.
 */
#ifndef WORLD_H
#define WORLD_H

#include <stdbool.h>

#include "host/options.h"
#include "qemu/mailbox.h"

/* Opens the bench and fills the mailbox, before the drive starts; timed: the processor takes time. Keeps both. False:
 * one line on stderr said why. */
bool world_open(mailbox_t *mailbox, const options_t *options, bool timed);

/* Closes the bench of a drive that ended before MAILBOX_EXIT. */
void world_abandon(void);

/* Does the command that the doorbell has. After MAILBOX_EXIT there is no world any more. */
void world_serve(void);

#endif
