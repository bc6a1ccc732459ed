#include "qemu/mps2_an386/timer.h"

#include "qemu/board.h"
#include "qemu/hal_qemu.h"

/* CMSDK timers, counting down. Arm DDI 0479, 4.3. */
typedef struct {
    uint32_t control;
    uint32_t value;
    uint32_t reload;
    uint32_t interrupt_clear;
} cmsdk_timer_t;

#define TRIGGER ((volatile cmsdk_timer_t *)0x40000000u)
#define COUNTER ((volatile cmsdk_timer_t *)0x40001000u)
#define COUNTER_CLOCK_HZ 25000000
#define CONTROL_ENABLE 1u
#define CONTROL_INTERRUPT 8u
#define TICKS_PER_COUNT (MAILBOX_PWM_CLOCK_HZ / COUNTER_CLOCK_HZ)
_Static_assert(TICKS_PER_COUNT *COUNTER_CLOCK_HZ == MAILBOX_PWM_CLOCK_HZ, "the clock is a multiple of the counter's");

static uint32_t period;        /* counts */
static uint32_t trigger_value; /* of the counter, at the trigger served last */
static uint32_t passed;        /* triggers after that one and before the control interrupt's end */

/* Counts since the trigger served last, modulo 2^32. */
static uint32_t elapsed(void) {
    return trigger_value - COUNTER->value;
}

void timer_start(uint32_t period_ticks) {
    period = 2u * period_ticks / TICKS_PER_COUNT;
    TRIGGER->value = period - 1u; /* the timer also counts 0 */
    TRIGGER->reload = period - 1u;
    COUNTER->value = UINT32_MAX;
    COUNTER->reload = UINT32_MAX;
    COUNTER->control = CONTROL_ENABLE;
    /* Read before the other timer starts, so that no trigger is later than its multiple of the period on the
     * counter. */
    trigger_value = COUNTER->value;
    TRIGGER->control = CONTROL_ENABLE | CONTROL_INTERRUPT;
}

uint32_t timer_elapsed_ticks(void) {
    return elapsed() * TICKS_PER_COUNT;
}

/* The counter identifies the trigger: one that occurs while interrupts are masked hides earlier pending ones. */
void timer_handler(void) {
    TRIGGER->interrupt_clear = 1;
    const uint32_t periods = elapsed() / period;
    if (periods <= passed) {
        return;
    }
    trigger_value -= periods * period;
    board.mailbox.trigger += periods;
    passed = 0;
    doorbell_ring(MAILBOX_TRIGGER);
    if (board.mailbox.event == MAILBOX_INTERRUPT) {
        while (timer_elapsed_ticks() < board.mailbox.elapsed_ticks) { /* delay set by the bench */
        }
        board_interrupt_pend();
        board.mailbox.elapsed_ticks = timer_elapsed_ticks();
        passed = board.mailbox.elapsed_ticks / TICKS_PER_COUNT / period;
        doorbell_ring(MAILBOX_INTERRUPT_END);
    }
    if (board.mailbox.event == MAILBOX_EXIT) { /* here, because the background may have no time left to check it */
        board_exit(board.mailbox.exit_code);
    }
}
