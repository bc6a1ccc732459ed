/* One drive on the Cortex-M4: the same firmware as on the host, its interrupt a real exception. */
#include "control/machine_tables.h"
#include "drive/drive.h"
#include "mps2_an386/hal_mps2_an386.h"
#include "mps2_an386/startup.h"

#define EXIT_LAYOUT 78 /* sysexits.h: configuration error */

static drive_t drive;

void program_interrupt(void) {
    drive_control_interrupt(&drive);
}

noreturn void program(void) {
    const mailbox_t *mailbox = &board.mailbox;
    if (mailbox->layout != MAILBOX_LAYOUT) {
        semihosting_exit(EXIT_LAYOUT);
    }
    const drive_config_t config = {
        .control_rate_hz = mailbox->control_rate_hz,
        .controller = (drive_controller_t)mailbox->controller,
    };
    const bool started = drive_init(&drive, &board, &machine_tables, &config);
    interrupt_enable();
    doorbell_ring(started ? MAILBOX_STARTED : MAILBOX_REFUSED);
    for (;;) {
        switch ((mailbox_event_t)mailbox->event) {
        case MAILBOX_INTERRUPT:
            interrupt_pend();
            break;
        case MAILBOX_BACKGROUND:
            drive_background(&drive);
            break;
        case MAILBOX_EXIT:
            semihosting_exit(mailbox->exit_code);
        }
        doorbell_ring(MAILBOX_NEXT);
    }
}
