/* SPDX-License-Identifier: GPL-2.0-or-later */
#define _XOPEN_SOURCE 700 /* ucontext */

#include "qemu/cosimulation.h"

#include <inttypes.h>
#include <setjmp.h>
#include <stdio.h>
#include <stdlib.h>
#include <ucontext.h>

#include "host/hal_host.h"
#include "hal_time.h"
#include "host/simulation.h"

#define RIG_STACK_BYTES (1024 * 1024)

static mailbox_t *mailbox;
static bench_t bench;
static hal_t host = {.board = &bench.rig.board}; /* the host port checks what may be called from where */
static bool refused, started;

/* Where drive and rig wait for each other. setcontext starts the rig on a stack of its own; from then on jumps do,
 * which need no call of the kernel, as swapcontext does. */
static ucontext_t rig_context;
static jmp_buf drive_waits, rig_waits;

static void let_drive_go_on(void) {
    if (_setjmp(rig_waits) == 0) {
        _longjmp(drive_waits, 1);
    }
}

/* Back to the drive, until its next MAILBOX_NEXT. */
static void give_event(mailbox_event_t event) {
    const board_t *board = &bench.rig.board;
    mailbox->event = event;
    mailbox->time_us = hal_time_us(&host);
    mailbox->receive_waiting = board->received_pushed - board->received_popped;
    mailbox->receive_overflows = board->receive_overflows;
    let_drive_go_on();
}

static void control_interrupt(void *context) {
    (void)context;
    hal_adc_read(&host, &mailbox->adc);
    hal_encoder_read(&host, &mailbox->encoder);
    mailbox->missed_interrupts += hal_pwm_missed_interrupts(&host);
    mailbox->elapsed_ticks = hal_pwm_elapsed_ticks(&host);
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
    let_drive_go_on(); /* for ever */
}

/* Lets the rig go on, from its start or from where it called the drive. */
static void let_rig_go_on(void) {
    if (_setjmp(drive_waits) != 0) {
        return; /* it called the drive again */
    }
    if (started) {
        _longjmp(rig_waits, 1);
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

/* To the trigger that the drive serves; those that it did not are lost. */
static void run_to_trigger(void) {
    rig_t *rig = &bench.rig;
    const uint64_t period_ns = UINT64_C(2) * HAL_PWM_TICK_NS * rig->board.period_ticks;
    /* Its number goes round after 71 minutes at 1 MHz. */
    const uint32_t ahead = mailbox->trigger - (uint32_t)(rig->board.time_ns / period_ns);
    const uint64_t trigger_ns = (rig->board.time_ns / period_ns + ahead) * period_ns;
    rig_busy_until(rig, trigger_ns);
    let_rig_go_on();
    if (mailbox->event == MAILBOX_INTERRUPT && rig->board.time_ns != trigger_ns) {
        fprintf(stderr, "salient: the drive serves the trigger at %" PRIu64 " ns, the bench that at %" PRIu64 " ns\n",
                trigger_ns, rig->board.time_ns);
        abort();
    }
}

bool world_open(mailbox_t *shared, const options_t *options, bool timed) {
    mailbox = shared;
    if (!bench_open(&bench, options)) {
        return false;
    }
    mailbox->layout = MAILBOX_LAYOUT;
    mailbox->control_rate_hz = options->control_rate_hz;
    mailbox->controller = options->controller_index;
    mailbox->adc_bits = hal_adc_bits(&host);
    mailbox->encoder_bits = hal_encoder_bits(&host);
    mailbox->timed = timed;
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
        let_rig_go_on();
        break;
    case MAILBOX_STARTED:
    case MAILBOX_NEXT:
        if (!mailbox->timed) {
            let_rig_go_on();
        } else if (!started) {
            mailbox->event = MAILBOX_BACKGROUND;
        }
        break;
    case MAILBOX_TRIGGER:
        run_to_trigger();
        break;
    case MAILBOX_INTERRUPT_END:
        /* The drive's counter rounds down: what ends as a trigger comes has lost it. */
        bench.rig.board.interrupt_took_ns = (uint64_t)mailbox->elapsed_ticks * HAL_PWM_TICK_NS + 1;
        let_rig_go_on();
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
