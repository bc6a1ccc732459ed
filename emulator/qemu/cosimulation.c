/* SPDX-License-Identifier: GPL-2.0-or-later */
#define _XOPEN_SOURCE 700 /* ucontext */

#include "qemu/cosimulation.h"

#include <assert.h>
#include <inttypes.h>
#include <setjmp.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <ucontext.h>

#include "hal_interrupt.h"
#include "hal_nvm.h"
#include "hal_random.h"
#include "hal_time.h"
#include "hal_watchdog.h"
#include "host/hal_host.h"
#include "host/simulation.h"
#include "plant/pwm_timer.h"

/* An image has them all. */
#define FLIP_OBJECTS ((1u << MEMORY_OBJECTS) - 1u)
#define RIG_STACK_BYTES (1024 * 1024)

static uint8_t *shared; /* the image's mailbox: that below, with its arrays of phases */
static mailbox_t copy_of_shared, *const mailbox = &copy_of_shared;
static simulation_t simulation;
static hal_t host = {.board = &simulation.rigs[0].board}; /* the host port checks the calling context */
static bool rejected, started;

/* Contexts in which drive and rig wait for each other. setcontext starts the rig on a separate stack; later switches
 * are jumps, which need no system call, unlike swapcontext. */
static ucontext_t rig_context;
static jmp_buf drive_context, rig_jump;

static void resume_drive(void) {
    if (_setjmp(rig_jump) == 0) {
        _longjmp(drive_context, 1);
    }
}

/* --- Mailbox of an image that is compiled for fewer phases --- */

#define IMAGE_PHASES 4 /* phases of an image for a machine of no more */
#define PER_PHASE sizeof(uint16_t)

static_assert(sizeof mailbox->compare.upper == HAL_PHASES_MAX * PER_PHASE &&
                  sizeof mailbox->temperature_code == 2 * HAL_PHASES_MAX * PER_PHASE,
              "arrays of phases have elements of one size");

/* Where the arrays of phases begin; nothing is padded behind them. */
static const size_t phase_arrays[] = {
    offsetof(mailbox_t, adc.phase_current_counts),
    offsetof(mailbox_t, compare.upper),
    offsetof(mailbox_t, compare.lower),
    offsetof(mailbox_t, temperature_code) + HAL_ADC_WINDING *PER_PHASE,
    offsetof(mailbox_t, temperature_code) + HAL_ADC_INVERTER *PER_PHASE,
};

/* Copies the mailbox from (or to) the image, but for the elements of phases that the image does not have. */
static void exchange(bool to_image) {
    const bool fewer = simulation.image.machine.phases <= IMAGE_PHASES;
    const size_t left_out = fewer ? (HAL_PHASES_MAX - IMAGE_PHASES) * PER_PHASE : 0;
    uint8_t *own = (uint8_t *)mailbox, *of_image = shared;
    const uint8_t *const end = own + sizeof *mailbox;
    for (unsigned i = 0; own < end; i++) {
        const bool last = i == sizeof phase_arrays / sizeof phase_arrays[0];
        const uint8_t *const next =
            last ? end : (uint8_t *)mailbox + phase_arrays[i] + HAL_PHASES_MAX * PER_PHASE - left_out;
        const size_t size = (size_t)(next - own);
        memcpy(to_image ? of_image : own, to_image ? own : of_image, size);
        of_image += size;
        own += size + (last ? 0 : left_out);
    }
}

/* --- Events --- */

/* Registers as of now. */
static void update_registers(void) {
    const board_t *board = &simulation.rigs[0].board;
    mailbox->time_us = hal_time_us(&host);
    mailbox->receive_waiting = board->received_pushed - board->received_popped;
    mailbox->receive_overflows = board->receive_overflows;
    hal_can_status_t status;
    board_can_status(board, &status);
    mailbox->can_error_state = status.state;
    mailbox->transmit_errors = status.transmit_errors;
    mailbox->receive_errors = status.receive_errors;
    mailbox->transmitting = status.transmitting;
    mailbox->reference_us = board_reference_us(board);
    mailbox->registers_intact = board_registers_intact(board);
    memcpy(mailbox->temperature_code, board->temperature_code, sizeof mailbox->temperature_code);
}

/* Back to the drive, until its next MAILBOX_NEXT. */
static void deliver_event(mailbox_event_t event) {
    mailbox->event = event;
    update_registers();
    resume_drive();
}

static void control_interrupt(void *context) {
    (void)context;
    hal_adc_read(&host, &mailbox->adc);
    hal_encoder_read(&host, &mailbox->encoder);
    mailbox->break_causes = hal_pwm_break(&host);
    mailbox->missed_triggers += hal_interrupt_missed_triggers(&host);
    mailbox->elapsed_ticks = hal_interrupt_elapsed_ticks(&host);
    deliver_event(MAILBOX_INTERRUPT);
}

static void background(void *context) {
    (void)context;
    deliver_event(MAILBOX_BACKGROUND);
}

static void restart(void *context) {
    (void)context;
    mailbox->missed_triggers = 0;
    mailbox->reset_cause = hal_reset_cause(&host);
    deliver_event(MAILBOX_RESET); /* until MAILBOX_STARTED */
}

static void flip(void *context, memory_object_t object, uint32_t bit) {
    (void)context;
    mailbox->flip_object = object;
    mailbox->flip_bit = bit;
    deliver_event(MAILBOX_FLIP);
}

static void run_rig(void) {
    if (rejected) {
        simulation_rejected(&simulation);
    } else {
        simulation_run(&simulation, &(rig_firmware_t){.control_interrupt = control_interrupt,
                                                      .background = background,
                                                      .restart = mailbox->timed ? NULL : restart,
                                                      .flip = flip,
                                                      .flip_objects = mailbox->timed ? 0 : FLIP_OBJECTS});
    }
    mailbox->exit_code = (uint32_t)simulation_close(&simulation);
    mailbox->event = MAILBOX_EXIT;
    resume_drive(); /* does not return */
}

/* Resumes the rig, from its start or from its last call of the drive. */
static void resume_rig(void) {
    if (_setjmp(drive_context) != 0) {
        return; /* the rig called the drive again */
    }
    if (started) {
        _longjmp(rig_jump, 1);
    }
    started = true;
    getcontext(&rig_context);
    rig_context.uc_stack.ss_sp = malloc(RIG_STACK_BYTES);
    rig_context.uc_stack.ss_size = RIG_STACK_BYTES;
    if (!rig_context.uc_stack.ss_sp) {
        fputs("salient: no memory for the emulator's stack\n", stderr);
        abort();
    }
    makecontext(&rig_context, run_rig, 0);
    setcontext(&rig_context);
}

/* Runs to the trigger that the drive serves; those before it are missed. */
static void run_to_trigger(void) {
    rig_t *rig = &simulation.rigs[0];
    const uint64_t period_ns = pwm_timer_ns(UINT64_C(2) * rig->board.period_ticks);
    /* The trigger number wraps after 71 minutes at 1 MHz. */
    const uint32_t ahead = mailbox->trigger - (uint32_t)(rig->board.time_ns / period_ns);
    const uint64_t trigger_ns = (rig->board.time_ns / period_ns + ahead) * period_ns;
    rig_busy_until(rig, trigger_ns);
    resume_rig();
    if (mailbox->event == MAILBOX_INTERRUPT && rig->board.time_ns != trigger_ns) {
        fprintf(stderr, "salient: the drive serves the trigger at %" PRIu64 " ns, the rig that at %" PRIu64 " ns\n",
                trigger_ns, rig->board.time_ns);
        abort();
    }
}

bool cosimulation_open(mailbox_t *of_image, const options_t *options, bool timed) {
    shared = (uint8_t *)of_image;
    if (options->drives > 1) {
        fprintf(stderr, "salient: --drives %" PRIu32 ": only one with an image\n", options->drives);
        return false;
    }
    if (!simulation_open(&simulation, options)) {
        return false;
    }
    mailbox->layout =
        MAILBOX_LAYOUT_OF(simulation.image.machine.phases <= IMAGE_PHASES ? IMAGE_PHASES : HAL_PHASES_MAX);
    mailbox->control_rate_hz = options->control_rate_hz;
    mailbox->controller = options->controller_index;
    mailbox->node = options->node;
    mailbox->telemetry_period_ms = options->telemetry_period_ms;
    mailbox->canopen_node = options->protocol_index == OPTIONS_PROTOCOL_CANOPEN ? options->node + 1u : 0;
    mailbox->adc_bits = hal_adc_bits(&host);
    mailbox->encoder_bits = hal_encoder_bits(&host);
    mailbox->timed = timed;
    update_registers();
    exchange(true);
    return true;
}

void cosimulation_abandon(void) {
    simulation_close(&simulation);
}

/* The commands with which time may run on; false: another one. */
static bool serve_time(mailbox_command_t command) {
    switch (command) {
    case MAILBOX_REJECTED:
        rejected = true;
        resume_rig();
        return true;
    case MAILBOX_STARTED:
    case MAILBOX_NEXT:
        if (!mailbox->timed) {
            resume_rig();
        } else if (!started) {
            mailbox->event = MAILBOX_BACKGROUND;
        }
        return true;
    case MAILBOX_TRIGGER:
        run_to_trigger();
        return true;
    case MAILBOX_INTERRUPT_END:
        /* The drive's counter rounds down: an interrupt that ends at a trigger has missed it. */
        simulation.rigs[0].board.interrupt_took_ns = pwm_timer_ns(mailbox->elapsed_ticks) + 1;
        resume_rig();
        return true;
    default:
        return false;
    }
}

/* The commands that a function of the HAL serves; false: another one. */
static bool serve_hal(mailbox_command_t command) {
    switch (command) {
    case MAILBOX_PWM_START:
        hal_pwm_start(&host, (uint16_t)mailbox->period_ticks);
        return true;
    case MAILBOX_PWM_OPEN_ALL:
        hal_pwm_open_all(&host);
        return true;
    case MAILBOX_PWM_CLEAR_BREAK:
        hal_pwm_clear_break(&host);
        return true;
    case MAILBOX_CAN_RECEIVE:
        mailbox->accepted = hal_can_receive(&host, &mailbox->frame);
        --mailbox->receive_waiting;
        return true;
    case MAILBOX_CAN_REJOIN:
        hal_can_rejoin(&host);
        return true;
    case MAILBOX_CAN_TRANSMIT:
        mailbox->accepted = hal_can_transmit(&host, &mailbox->frame);
        return true;
    case MAILBOX_NVM_READ: {
        const uint64_t value = hal_nvm_read(&host, mailbox->nvm_page, mailbox->nvm_word);
        mailbox->nvm_value[0] = (uint32_t)value;
        mailbox->nvm_value[1] = (uint32_t)(value >> 32);
        return true;
    }
    case MAILBOX_NVM_PROGRAM:
        mailbox->accepted = hal_nvm_program(&host, mailbox->nvm_page, mailbox->nvm_word,
                                            (uint64_t)mailbox->nvm_value[1] << 32 | mailbox->nvm_value[0]);
        return true;
    case MAILBOX_NVM_ERASE:
        mailbox->accepted = hal_nvm_erase(&host, mailbox->nvm_page);
        return true;
    case MAILBOX_RANDOM:
        mailbox->random = hal_random_u32(&host);
        return true;
    case MAILBOX_WATCHDOG_START:
        hal_watchdog_start(&host);
        return true;
    case MAILBOX_WATCHDOG_KICK:
        hal_watchdog_kick(&host);
        return true;
    default:
        return false;
    }
}

void cosimulation_serve(void) {
    exchange(false);
    if (mailbox->compare_written) {
        mailbox->compare_written = 0;
        hal_pwm_write(&host, &mailbox->compare);
    }
    const mailbox_command_t command = (mailbox_command_t)mailbox->doorbell;
    if (!serve_time(command) && !serve_hal(command)) {
        fprintf(stderr, "salient: the drive sent the unknown command %u\n", (unsigned)command);
        abort();
    }
    exchange(true);
}
