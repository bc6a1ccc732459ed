/* Replacement for the registers that a QEMU board lacks: PWM timer, ADC, encoder, CAN controller.
 *
 * A structure in memory that the drive shares with the co-simulation host (emulator/qemu). The drive reads registers
 * and sends commands: it stores one to `doorbell`, and the host has executed it before the drive's next instruction. No
 * polling is needed, and virtual time does not advance while the drive computes, as in the host executable. The layout
 * is the same on both sides: little endian, natural alignment, no pointers.
 *
 * When `timed` is set, instructions take time and a timer of the board defines the control period. The timer's handler
 * sends MAILBOX_TRIGGER before and MAILBOX_INTERRUPT_END after the control interrupt, and only these advance the
 * co-simulation: to the trigger, and to the end of the interrupt. Background and MAILBOX_NEXT see the state at that
 * time.
 */
#ifndef MAILBOX_H
#define MAILBOX_H

#include <stdint.h>

#include "hal_adc.h"
#include "hal_can.h"
#include "hal_encoder.h"
#include "hal_nvm.h"
#include "hal_pwm.h"

/* Changes with the structure, so that an image and a host with different layouts stop at the start. An image has arrays
 * for the phases that it is compiled for (hal.h), the host for the most. With the clock, which both compile in. */
#define MAILBOX_LAYOUT_OF(phases) (7u << 8 | (phases) | (uint32_t)(MAILBOX_PWM_CLOCK_HZ / 1000000 - 200) << 16)
#define MAILBOX_LAYOUT MAILBOX_LAYOUT_OF(HAL_PHASES_MAX)

/* Clock of the emulated PWM timer: 200 MHz, or what the build of both sides sets. */
#ifndef SALIENT_PWM_CLOCK_MHZ
#define SALIENT_PWM_CLOCK_MHZ 200
#endif
#define MAILBOX_PWM_CLOCK_HZ (SALIENT_PWM_CLOCK_MHZ * 1000000)

/* Exit codes of a drive that ends QEMU itself (sysexits.h). */
#define MAILBOX_EXIT_FAULT 70  /* an unexpected CPU exception */
#define MAILBOX_EXIT_LAYOUT 78 /* the host has another layout */

typedef enum {
    MAILBOX_STARTED = 1, /* drive_init succeeded; then as MAILBOX_NEXT */
    MAILBOX_REJECTED,    /* drive_init rejected the configuration; then as MAILBOX_NEXT */
    MAILBOX_NEXT,        /* the drive is idle: time may run to the next event */
    MAILBOX_PWM_START,   /* period_ticks */
    MAILBOX_PWM_OPEN_ALL,
    MAILBOX_PWM_CLEAR_BREAK,
    MAILBOX_CAN_RECEIVE,   /* returns frame and accepted: there was one */
    MAILBOX_CAN_TRANSMIT,  /* takes frame, returns accepted: a mailbox was free */
    MAILBOX_TRIGGER,       /* takes trigger, returns an event: MAILBOX_INTERRUPT or MAILBOX_EXIT */
    MAILBOX_INTERRUPT_END, /* takes elapsed_ticks, returns an event: MAILBOX_BACKGROUND or MAILBOX_EXIT */
    MAILBOX_CAN_REJOIN,    /* requests to leave bus-off */
    MAILBOX_NVM_READ,      /* takes nvm_page and nvm_word, returns nvm_value */
    MAILBOX_NVM_PROGRAM,   /* takes nvm_page, nvm_word and nvm_value, returns accepted */
    MAILBOX_NVM_ERASE,     /* takes nvm_page, returns accepted */
    MAILBOX_RANDOM,        /* returns random */
    MAILBOX_WATCHDOG_START,
    MAILBOX_WATCHDOG_KICK,
} mailbox_command_t;

/* Result of MAILBOX_NEXT. */
typedef enum {
    MAILBOX_INTERRUPT = 1, /* the timer requests the control interrupt */
    MAILBOX_BACKGROUND,    /* the processor has time for the background */
    MAILBOX_EXIT,          /* end of the run, with exit_code */
    MAILBOX_RESET,         /* the drive starts again; not when `timed` */
    MAILBOX_FLIP,          /* the drive flips a bit of its memory; not when `timed` */
} mailbox_event_t;

typedef struct {
    uint32_t doorbell; /* mailbox_command_t */

    /* Constant after start. */
    uint32_t layout; /* MAILBOX_LAYOUT */
    uint32_t control_rate_hz;
    uint32_t controller; /* drive_controller_t */
    uint32_t node;
    uint32_t telemetry_period_ms; /* 0: as the parameter's default */
    uint32_t canopen_node;        /* 0: the protocol of drive.dbc */
    uint32_t adc_bits;
    uint32_t encoder_bits;
    uint32_t timed; /* 1: instructions take time, 0: they take none */

    uint32_t event; /* mailbox_event_t */
    uint32_t exit_code;

    uint32_t time_us;
    hal_adc_sample_t adc;
    hal_encoder_sample_t encoder;
    uint32_t missed_triggers; /* the drive sets it to 0 */
    uint32_t break_causes;    /* HAL_PWM_BREAK_* */
    /* Execution time of the control interrupt, set by the bench. `timed`: delay that the bench inserts before the
     * interrupt; the drive stores the execution time at the end. */
    uint32_t elapsed_ticks;
    uint32_t trigger; /* `timed`: number of the trigger that is served, 1 is one period after the start; modulo 2^32 */

    uint32_t period_ticks;
    hal_pwm_compare_t compare;
    uint32_t compare_written; /* set to 1 by the drive: the host takes `compare` before the next command */

    uint32_t receive_waiting; /* frames */
    uint32_t receive_overflows;
    uint32_t can_error_state; /* hal_can_error_state_t; this and the next three as of the last event */
    uint32_t transmit_errors;
    uint32_t receive_errors;
    uint32_t transmitting; /* 1: a frame is in a mailbox */
    hal_can_frame_t frame;
    uint32_t accepted;

    uint32_t nvm_page;
    uint32_t nvm_word;
    uint32_t nvm_value[2]; /* lower half first */
    uint32_t random;
    uint32_t reset_cause; /* hal_reset_cause_t, of the last MAILBOX_RESET */

    uint32_t reference_us; /* of the second clock; this and the next two as of the last event */
    uint32_t registers_intact;
    uint16_t temperature_code[HAL_ADC_TEMPERATURES];

    uint32_t flip_object; /* of MAILBOX_FLIP: memory_object_t, and its bit */
    uint32_t flip_bit;
} mailbox_t;

#endif
