/* The hal_* functions on the mailbox, for any board of QEMU; the critical section and the time on the
 * processor are the board's. */
#ifndef HAL_QEMU_H
#define HAL_QEMU_H

#include "hal.h"
#include "qemu/mailbox.h"

struct hal {
    mailbox_t mailbox;
};

/* The one board there is; the linker places it in the memory shared with the co-simulation host. */
extern hal_t board;

/* Stores a command to the doorbell. Whatever of the mailbox the compiler held in registers is read again after it. */
void doorbell_ring(mailbox_command_t command);

#endif
