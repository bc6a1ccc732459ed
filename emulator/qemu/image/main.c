/* One drive on a QEMU board: the firmware of the host executable, with its interrupts as real exceptions. */
#include <string.h>

#include "drive/drive.h"
#include "hal_memory.h"
#include "host/memory_flip.h"
#include "qemu/board.h"
#include "qemu/hal_qemu.h"

/* Symbols of the linker script. */
extern uint32_t data_start[], data_end[], data_load[], bss_start[], bss_end[], stack_end[];

static drive_t drive;

__attribute__((used)) void program_interrupt(void) { /* called by the handler, in assembly */
    drive_control_interrupt(&drive, &board);
}

__attribute__((used)) void program_deferred(void) { /* likewise */
    drive_deferred_interrupt(&drive, &board);
}

static void flip(memory_object_t object, uint32_t bit) {
    hal_memory_t memory;
    hal_memory(&board, &memory);
    switch (object) {
    case MEMORY_CODE:
        ((volatile uint8_t *)(uintptr_t)memory.code)[bit % (4u * memory.code_words)] ^= 1u;
        break;
    case MEMORY_STACK_GUARD:
        *(volatile uint32_t *)(uintptr_t)memory.stack ^= UINT32_C(1) << bit;
        break;
    default:
        memory_flip(&drive, object, bit);
    }
}

static noreturn void run(void) {
    const mailbox_t *mailbox = &board.mailbox;
    if (mailbox->layout != MAILBOX_LAYOUT) {
        board_exit(MAILBOX_EXIT_LAYOUT);
    }
    const drive_config_t config = {
        .control_rate_hz = mailbox->control_rate_hz,
        .controller = (drive_controller_t)mailbox->controller,
        .node = mailbox->node,
        .telemetry_period_ms = mailbox->telemetry_period_ms,
        .canopen_node = mailbox->canopen_node,
    };
    const bool started = drive_init(&drive, &board, &config);
    board_interrupt_enable();
    doorbell_ring(started ? MAILBOX_STARTED : MAILBOX_REJECTED);
    for (;;) {
        switch ((mailbox_event_t)mailbox->event) {
        case MAILBOX_INTERRUPT:
            board_interrupt_pend();
            break;
        case MAILBOX_BACKGROUND:
            drive_background(&drive, &board);
            break;
        case MAILBOX_FLIP:
            flip((memory_object_t)mailbox->flip_object, mailbox->flip_bit);
            break;
        case MAILBOX_RESET:
            board_restart();
        case MAILBOX_EXIT:
            board_exit(mailbox->exit_code);
        }
        doorbell_ring(MAILBOX_NEXT);
    }
}

/* Far enough below the present frame for the frames of the calls here. The plugin's trace knows it by its name. */
__attribute__((noipa)) void stack_paint(void) {
    volatile uint32_t *const end = (uint32_t *)__builtin_frame_address(0) - 64;
    for (volatile uint32_t *word = stack_end; word < end; word++) {
        *word = HAL_STACK_UNUSED;
    }
}

noreturn void program_start(void) {
    stack_paint();
    memcpy(data_start, data_load, (size_t)((char *)data_end - (char *)data_start));
    memset(bss_start, 0, (size_t)((char *)bss_end - (char *)bss_start));
    run();
}
