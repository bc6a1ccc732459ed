/* The hal_* functions on the mailbox, for any QEMU board; the board implements critical section and execution time. */
#ifndef HAL_QEMU_H
#define HAL_QEMU_H

#include "hal.h"
#include "qemu/mailbox.h"

struct hal {
    mailbox_t mailbox;
};

/* The board; the linker places it in the memory shared with the co-simulation host. */
extern hal_t board;

/* Stores a command to the doorbell. The compiler keeps no part of the mailbox in registers across the call. */
void doorbell_ring(mailbox_command_t command);

#endif
