/* The port to QEMU's board mps2-an386, a Cortex-M4: the hal_* functions on the mailbox. */
#ifndef HAL_MPS2_AN386_H
#define HAL_MPS2_AN386_H

#include "hal.h"
#include "mps2_an386/mailbox.h"

struct hal {
    mailbox_t mailbox;
};

/* The one board there is; the linker places it at MAILBOX_ADDRESS. */
extern hal_t board;

/* Stores a command to the doorbell. Whatever of the mailbox the compiler held in registers is read again after it. */
void doorbell_ring(mailbox_command_t command);

#endif
