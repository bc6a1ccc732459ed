/* SPDX-License-Identifier: GPL-2.0-or-later */
#define _XOPEN_SOURCE 700 /* ucontext */

#include "world.h"

#include <stdio.h>
#include <stdlib.h>
#include <ucontext.h>

#include "hal_host.h"
#include "hal_time.h"
#include "host/bench.h"

#define RIG_STACK_BYTES (1024 * 1024)

static mailbox_t *mailbox;
static bench_t bench;
static hal_t host = {.board = &bench.rig.board}; /* the host port checks what may be called from where */
static ucontext_t drive_context, rig_context;
static bool refused;

/* Back to the drive, until its next MAILBOX_NEXT. */
static void give_event(mailbox_event_t event) {
    const board_t *board = &bench.rig.board;
    mailbox->event = event;
    mailbox->time_us = hal_time_us(&host);
    mailbox->receive_waiting = board->received_pushed - board->received_popped;
    mailbox->receive_overflows = board->receive_overflows;
    swapcontext(&rig_context, &drive_context);
}

static void control_interrupt(void *context) {
    (void)context;
    hal_adc_read(&host, &mailbox->adc);
    hal_encoder_read(&host, &mailbox->encoder);
    mailbox->missed_interrupts += hal_pwm_missed_interrupts(&host);
    give_event(MAILBOX_INTERRUPT);
}

static void background(void *context) {
    (void)context;
    give_event(MAILBOX_BACKGROUND);
}

static void run_rig(void) {
    if (refused) {
        bench_refused(&bench);
    } else {
        bench_run(&bench, &(rig_firmware_t){.control_interrupt = control_interrupt, .background = background});
    }
    mailbox->exit_code = (uint32_t)bench_close(&bench);
    mailbox->event = MAILBOX_EXIT;
}

static void start_rig(void) {
    getcontext(&rig_context);
    rig_context.uc_stack.ss_sp = malloc(RIG_STACK_BYTES);
    rig_context.uc_stack.ss_size = RIG_STACK_BYTES;
    rig_context.uc_link = &drive_context;
    if (!rig_context.uc_stack.ss_sp) {
        fputs("salient: no memory for the emulator's stack\n", stderr);
        abort();
    }
    makecontext(&rig_context, run_rig, 0);
    swapcontext(&drive_context, &rig_context);
}

bool world_open(mailbox_t *shared, const options_t *options) {
    mailbox = shared;
    if (!bench_open(&bench, options)) {
        return false;
    }
    mailbox->layout = MAILBOX_LAYOUT;
    mailbox->control_rate_hz = options->control_rate_hz;
    mailbox->controller = options->controller_index;
    mailbox->adc_bits = hal_adc_bits(&host);
    mailbox->encoder_bits = hal_encoder_bits(&host);
    return true;
}

void world_abandon(void) {
    bench_close(&bench);
}

void world_serve(void) {
    if (mailbox->compare_written) {
        mailbox->compare_written = 0;
        hal_pwm_write(&host, &mailbox->compare);
    }
    switch ((mailbox_command_t)mailbox->doorbell) {
    case MAILBOX_REFUSED:
        refused = true;
        start_rig();
        break;
    case MAILBOX_STARTED:
        start_rig();
        break;
    case MAILBOX_NEXT:
        swapcontext(&drive_context, &rig_context);
        break;
    case MAILBOX_PWM_START:
        hal_pwm_start(&host, (uint16_t)mailbox->period_ticks);
        break;
    case MAILBOX_PWM_OPEN_ALL:
        hal_pwm_open_all(&host);
        break;
    case MAILBOX_CAN_RECEIVE:
        mailbox->accepted = hal_can_receive(&host, &mailbox->frame);
        --mailbox->receive_waiting;
        break;
    case MAILBOX_CAN_TRANSMIT:
        mailbox->accepted = hal_can_transmit(&host, &mailbox->frame);
        break;
    default:
        fprintf(stderr, "salient: the drive sent command %u, which there is not\n", (unsigned)mailbox->doorbell);
        abort();
    }
}
