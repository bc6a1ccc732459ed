/* Start, interrupts and main program. */
#include <string.h>

#include "drive/drive.h"
#include "hal_memory.h"
#include "skeleton/board.h"

extern uint32_t data_start[], data_end[], data_load[], bss_start[], bss_end[], stack_end[]; /* of the linker script */

static hal_t board;
static drive_t drive;

/* FILL IN: in the vector table at the interrupt of the trigger, with the highest priority. A trigger that comes while
 * it runs is counted as missed, and not served afterwards. */
void control_handler(void) {
    drive_control_interrupt(&drive, &board);
}

/* FILL IN: in the vector table, with a priority between the control interrupt and the main program. */
void deferred_handler(void) {
    drive_deferred_interrupt(&drive, &board);
}

/* FILL IN: clocks, pins, timers, converters, CAN; interrupts stay masked. */
static void board_init(void) {}

/* FILL IN: enables both interrupts; what was triggered before is forgotten. */
static void board_interrupts_enable(void) {}

/* Far enough below the present frame for the frames of the calls here; the self-test looks for the pattern. */
__attribute__((noipa)) static void stack_paint(void) {
    const volatile uint32_t *const end = (uint32_t *)__builtin_frame_address(0) - 64;
    for (volatile uint32_t *word = stack_end; word < end; word++) {
        *word = HAL_STACK_UNUSED;
    }
}

/* After a reset, with the stack set up. FILL IN: the vector table, or the first instructions, in the section .first. */
void program_start(void) {
    stack_paint();
    (void)memcpy(data_start, data_load, (size_t)((char *)data_end - (char *)data_start));
    (void)memset(bss_start, 0, (size_t)((char *)bss_end - (char *)bss_start));
    board_init();
    const drive_config_t config = {.control_rate_hz = 40000, .controller = DRIVE_CONTROLLER_SALIENT};
    const bool started = drive_init(&drive, &board, &config);
    board_interrupts_enable();
    for (;;) {
        if (started) {
            drive_background(&drive, &board);
        }
    }
}
