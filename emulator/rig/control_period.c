#include "rig/control_period.h"

#include "plant/pwm_timer.h"
#include "rig/bus_events.h"
#include "rig/heat.h"

void control_period_schedule_hold(rig_t *rig) {
    const uint64_t control_ns = rig->scheduler.due_ns[EVENT_CONTROL];
    const uint64_t delay_ns = (uint64_t)(rig->sensors.errors.current_delay_ns + 0.5);
    const uint64_t before_ns = delay_ns < rig->period_ns ? delay_ns : rig->period_ns;
    const bool ahead = before_ns > 0 && control_ns - rig->board.time_ns >= before_ns;
    rig->scheduler.due_ns[EVENT_CURRENT_HOLD] = ahead ? control_ns - before_ns : SCHEDULER_NEVER;
    rig->sensors.currents_held = false;
}

void control_period_set_length(rig_t *rig) {
    rig->period_ns = UINT64_C(2) * rig->board.period_ticks * PWM_TIMER_TICK_NS;
}

void control_period_begin(rig_t *rig) {
    rig->scheduler.due_ns[EVENT_WATCHDOG] = rig->board.watchdog_ns;
    if (rig->board.period_ticks > 0) {
        control_period_set_length(rig);
        rig->scheduler.due_ns[EVENT_CONTROL] = rig->board.time_ns + rig->period_ns;
        control_period_schedule_hold(rig);
    }
}

static void call(rig_t *rig, board_context_t context, void (*function)(void *)) {
    rig->board.context = context;
    function(rig->firmware.context);
}

static void call_control(rig_t *rig) {
    const rig_observer_t *observer = &rig->observer;
    if (observer->before_interrupt) {
        observer->before_interrupt(observer->context);
    }
    call(rig, BOARD_INTERRUPT, rig->firmware.control_interrupt);
    if (observer->after_interrupt) {
        observer->after_interrupt(observer->context);
    }
}

/* A drive that lost its power at an operation of its memory starts again. */
static void call_background(rig_t *rig) {
    if (rig->background_hung) {
        return;
    }
    call(rig, BOARD_BACKGROUND, rig->firmware.background);
    if (rig->board.nvm.power_lost) {
        rig_reset_drive(rig, HAL_RESET_POWER);
    }
}

/* A deferred interrupt that waits for the end of the control interrupt precedes a control interrupt triggered at that
 * instant. */
static void call_deferred(rig_t *rig) {
    if (rig->board.deferred_requested) {
        rig->board.deferred_requested = false;
        call(rig, BOARD_DEFERRED, rig->firmware.deferred_interrupt);
    }
}

void control_period_hold_event(void *context, uint64_t now_ns) {
    rig_t *rig = context;
    rig->scheduler.due_ns[EVENT_CURRENT_HOLD] = SCHEDULER_NEVER;
    plant_advance(&rig->plant, now_ns);
    sensors_hold_currents(&rig->sensors, &rig->plant);
}

static uint64_t at_least(uint64_t time_ns, uint64_t least_ns) {
    return time_ns > least_ns ? time_ns : least_ns;
}

void control_period_start_event(void *context, uint64_t now_ns) {
    rig_t *rig = context;
    const bool lost = rig->interrupts_lost && now_ns >= rig->interrupt_end_ns;
    const bool busy = lost || now_ns < rig->interrupt_end_ns;
    plant_advance(&rig->plant, now_ns);
    heat_step(rig);
    board_start_period(&rig->board, busy);
    rig->scheduler.due_ns[EVENT_CONTROL] = now_ns + rig->period_ns;
    control_period_schedule_hold(rig);
    if (lost) {
        call_background(rig);
        bus_start(rig);
    }
    if (busy) {
        return;
    }
    call_deferred(rig);
    rig->board.interrupt_took_ns = at_least(rig->interrupt_time_ns, rig->interrupt_late_ns);
    call_control(rig);
    /* A target has set the time that it took. */
    rig->board.interrupt_took_ns = at_least(rig->board.interrupt_took_ns, rig->interrupt_late_ns);
    if (rig->board.interrupt_took_ns == 0) {
        call_deferred(rig);
        call_background(rig);
    } else {
        /* When that is the start of the next period, the interrupt comes first and postpones the background again. */
        rig->interrupt_end_ns = rig->scheduler.due_ns[EVENT_BACKGROUND] = now_ns + rig->board.interrupt_took_ns;
    }
    bus_start(rig);
}

void control_period_background_event(void *context, uint64_t now_ns) {
    rig_t *rig = context;
    rig->scheduler.due_ns[EVENT_BACKGROUND] = SCHEDULER_NEVER;
    plant_advance(&rig->plant, now_ns);
    call_deferred(rig);
    call_background(rig);
    bus_start(rig);
}

/* A kick moves the time of the watchdog, and the event follows it when it is due. */
void control_period_watchdog_event(void *context, uint64_t now_ns) {
    rig_t *rig = context;
    rig->scheduler.due_ns[EVENT_WATCHDOG] = rig->board.watchdog_ns;
    if (rig->board.watchdog_ns > now_ns) {
        return;
    }
    rig->scheduler.due_ns[EVENT_WATCHDOG] = SCHEDULER_NEVER;
    plant_advance(&rig->plant, now_ns);
    if (!rig_reset_drive(rig, HAL_RESET_WATCHDOG)) {
        board_stop_gates(&rig->board);
    }
}
