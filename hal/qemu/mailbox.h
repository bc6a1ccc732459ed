/* What stands in for the registers that a board of QEMU has not: PWM timer, converter, encoder, CAN controller.
 *
 * A structure in memory that drive and world share. The drive reads registers and sends commands: it stores one to
 * `doorbell`, and before the drive's next instruction the world has done it. So the world needs no polling and time
 * stands still while the drive computes, as in the host executable. The layout is the same on both sides: little
 * endian, natural alignment, no pointers.
 *
 * When `timed` is set the processor takes time instead, and has a timer of the board for the control period. The
 * timer's handler sends MAILBOX_TRIGGER before and MAILBOX_INTERRUPT_END behind the control interrupt, and only these
 * move the world: to the trigger, and to the interrupt's end. Background and MAILBOX_NEXT take the world as it was left
 * there.
 */
#ifndef MAILBOX_H
#define MAILBOX_H

#include <stdint.h>

#include "hal_adc.h"
#include "hal_can.h"
#include "hal_encoder.h"
#include "hal_pwm.h"

/* Changes with the structure, so that an image and a world that do not fit each other stop at the start. */
#define MAILBOX_LAYOUT 3

/* Exit codes of a drive that ends by itself (sysexits.h). */
#define MAILBOX_EXIT_FAULT 70  /* an exception of the processor that is not expected */
#define MAILBOX_EXIT_LAYOUT 78 /* the world has another layout */

typedef enum {
    MAILBOX_STARTED = 1, /* drive_init was done; then as MAILBOX_NEXT */
    MAILBOX_REFUSED,     /* drive_init has refused; then as MAILBOX_NEXT */
    MAILBOX_NEXT,        /* all is done that was due: time may run to the next event */
    MAILBOX_PWM_START,   /* period_ticks */
    MAILBOX_PWM_OPEN_ALL,
    MAILBOX_CAN_RECEIVE,   /* gives frame and accepted: there was one */
    MAILBOX_CAN_TRANSMIT,  /* takes frame, gives accepted: a mailbox was free */
    MAILBOX_TRIGGER,       /* takes trigger, gives an event: MAILBOX_INTERRUPT or MAILBOX_EXIT */
    MAILBOX_INTERRUPT_END, /* takes elapsed_ticks, gives an event: MAILBOX_BACKGROUND or MAILBOX_EXIT */
} mailbox_command_t;

/* What MAILBOX_NEXT gives back. */
typedef enum {
    MAILBOX_INTERRUPT = 1, /* the timer asks for the control interrupt */
    MAILBOX_BACKGROUND,    /* the processor has time for the background */
    MAILBOX_EXIT,          /* over: end with exit_code */
} mailbox_event_t;

typedef struct {
    uint32_t doorbell; /* mailbox_command_t */

    /* Constant from the start on. */
    uint32_t layout; /* MAILBOX_LAYOUT */
    uint32_t control_rate_hz;
    uint32_t controller; /* drive_controller_t */
    uint32_t adc_bits;
    uint32_t encoder_bits;
    uint32_t timed; /* 1: the processor takes time, 0: it takes none */

    uint32_t event; /* mailbox_event_t */
    uint32_t exit_code;

    uint32_t time_us;
    hal_adc_sample_t adc;
    hal_encoder_sample_t encoder;
    uint32_t missed_interrupts; /* the drive sets it to 0 */
    /* That the control interrupt takes, from the bench. `timed`: so long the bench holds the processor in front of it;
     * at its end the drive puts what it took. */
    uint32_t elapsed_ticks;
    uint32_t trigger; /* `timed`: number of the trigger that is served, 1 is a period behind the start; modulo 2^32 */

    uint32_t period_ticks;
    hal_pwm_compare_t compare;
    uint32_t compare_written; /* the drive sets it to 1: the world takes `compare` before the next command */

    uint32_t receive_waiting; /* frames */
    uint32_t receive_overflows;
    hal_can_frame_t frame;
    uint32_t accepted;
} mailbox_t;

#endif
