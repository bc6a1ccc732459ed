/* Program of race.c on the boards of QEMU: two frames carry the counts, as uint16, little endian. */
#include <string.h>

#include "drive/drive.h"
#include "qemu/board.h"
#include "qemu/hal_qemu.h"
#include "race.h"

#define FRAME_ID 0x7A0 /* the first four counts; the next identifier has the others */

/* Symbols of the linker script. */
extern uint32_t bss_start[], bss_end[];

static drive_t drive;

bool race_is_timed(void) {
    return board.mailbox.timed;
}

void race_request(void) {
    board_interrupt_pend();
}

void race_round(void) {
    static uint32_t sequence;
    race_delay(race_random(&sequence));
}

void race_report(hal_t *hal, const uint16_t counts[RACE_COUNTS]) {
    for (uint32_t part = 0; part < 2; part++) {
        hal_can_frame_t frame = {.identifier = FRAME_ID + part, .length = sizeof frame.data};
        memcpy(frame.data, counts + 4 * part, sizeof frame.data);
        hal_can_transmit(hal, &frame);
    }
}

__attribute__((used)) void program_interrupt(void) { /* called by the handler, in assembly */
    drive_control_interrupt(&drive, &board);
}

__attribute__((used)) void program_deferred(void) { /* likewise */
    drive_deferred_interrupt(&drive, &board);
}

noreturn void program_start(void) {
    memset(bss_start, 0, (size_t)((char *)bss_end - (char *)bss_start)); /* there are no other variables */
    const drive_config_t config = {.control_rate_hz = board.mailbox.control_rate_hz};
    const bool started = drive_init(&drive, &board, &config);
    board_interrupt_enable();
    doorbell_ring(started ? MAILBOX_STARTED : MAILBOX_REJECTED);
    while (board.mailbox.event != MAILBOX_EXIT) {
        if (board.mailbox.event == MAILBOX_INTERRUPT && !board.mailbox.timed) {
            board_interrupt_pend();
        } else {
            drive_background(&drive, &board);
        }
        doorbell_ring(MAILBOX_NEXT);
    }
    board_exit(board.mailbox.exit_code);
}
