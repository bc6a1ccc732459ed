#include "rig/control_period.h"

#include "plant/min_max.h"
#include "plant/pwm_timer.h"

void control_period_schedule_hold(control_period_t *period) {
    const uint64_t control_ns = period->scheduler->due_ns[EVENT_CONTROL];
    const uint64_t delay_ns = (uint64_t)(period->sensors->errors.current_delay_ns + 0.5);
    const uint64_t before_ns = min_u64(delay_ns, period->length_ns);
    const bool ahead = before_ns > 0 && control_ns - period->board->time_ns >= before_ns;
    period->scheduler->due_ns[EVENT_CURRENT_HOLD] = ahead ? control_ns - before_ns : SCHEDULER_NEVER;
    period->sensors->currents_held = false;
}

void control_period_set_length(control_period_t *period) {
    period->length_ns = pwm_timer_ns(UINT64_C(2) * period->board->period_ticks);
}

void control_period_begin(control_period_t *period) {
    period->scheduler->due_ns[EVENT_WATCHDOG] = period->board->watchdog_ns;
    if (period->board->period_ticks > 0) {
        control_period_set_length(period);
        period->scheduler->due_ns[EVENT_CONTROL] = period->board->time_ns + period->length_ns;
        control_period_schedule_hold(period);
    }
}

void control_period_init(control_period_t *period, const control_period_t *parts) {
    *period = (control_period_t){.plant = parts->plant,
                                 .sensors = parts->sensors,
                                 .board = parts->board,
                                 .heat = parts->heat,
                                 .scheduler = parts->scheduler,
                                 .shared_bus = parts->shared_bus,
                                 .observer = parts->observer};
    memory_flips_init(&period->flips);
}

bool control_period_reset_drive(control_period_t *period, hal_reset_cause_t cause) {
    if (!period->firmware.restart) {
        return false;
    }
    plant_advance(period->plant, period->board->time_ns);
    board_reset(period->board, cause);
    can_bus_reset_drive(period->shared_bus.bus, period->board->bus_drive, period->board->time_ns);
    period->interrupt_end_ns = 0;
    memory_flips_drive_reset(&period->flips);
    period->scheduler->due_ns[EVENT_CONTROL] = period->scheduler->due_ns[EVENT_CURRENT_HOLD] =
        period->scheduler->due_ns[EVENT_BACKGROUND] = SCHEDULER_NEVER;
    period->firmware.restart(period->firmware.context);
    if (period->observer->after_restart) {
        period->observer->after_restart(period->observer->context);
    }
    control_period_begin(period);
    return true;
}

static void call(control_period_t *period, board_context_t context, void (*function)(void *)) {
    period->board->context = context;
    function(period->firmware.context);
}

static void call_control(control_period_t *period) {
    const rig_observer_t *observer = period->observer;
    if (observer->before_interrupt) {
        observer->before_interrupt(observer->context);
    }
    call(period, BOARD_INTERRUPT, period->firmware.control_interrupt);
    if (observer->after_interrupt) {
        observer->after_interrupt(observer->context);
    }
}

/* A drive that lost its power at an operation of its memory starts again. */
static void call_background(control_period_t *period) {
    if (period->background_hung) {
        return;
    }
    call(period, BOARD_BACKGROUND, period->firmware.background);
    if (period->board->nvm.power_lost) {
        control_period_reset_drive(period, HAL_RESET_POWER);
    }
}

/* A deferred interrupt that waits for the end of the control interrupt precedes a control interrupt triggered at that
 * instant. */
static void call_deferred(control_period_t *period) {
    if (period->board->deferred_requested) {
        period->board->deferred_requested = false;
        call(period, BOARD_DEFERRED, period->firmware.deferred_interrupt);
    }
}

void control_period_hold(control_period_t *period, uint64_t now_ns) {
    period->scheduler->due_ns[EVENT_CURRENT_HOLD] = SCHEDULER_NEVER;
    plant_advance(period->plant, now_ns);
    sensors_hold_currents(period->sensors, period->plant);
}

void control_period_start(control_period_t *period, uint64_t now_ns) {
    const bool lost = period->interrupts_lost && now_ns >= period->interrupt_end_ns;
    const bool busy = lost || now_ns < period->interrupt_end_ns;
    plant_advance(period->plant, now_ns);
    heat_step(period->heat);
    board_start_period(period->board, busy);
    period->scheduler->due_ns[EVENT_CONTROL] = now_ns + period->length_ns;
    control_period_schedule_hold(period);
    if (lost) {
        call_background(period);
        shared_bus_start(&period->shared_bus);
    }
    if (busy) {
        return;
    }
    call_deferred(period);
    period->board->interrupt_took_ns = max_u64(period->interrupt_time_ns, period->interrupt_late_ns);
    call_control(period);
    /* A target has set the time that it took. */
    period->board->interrupt_took_ns = max_u64(period->board->interrupt_took_ns, period->interrupt_late_ns);
    if (period->board->interrupt_took_ns == 0) {
        call_deferred(period);
        call_background(period);
    } else {
        /* When that is the start of the next period, the interrupt comes first and postpones the background again. */
        period->interrupt_end_ns = period->scheduler->due_ns[EVENT_BACKGROUND] =
            now_ns + period->board->interrupt_took_ns;
    }
    shared_bus_start(&period->shared_bus);
}

void control_period_resume_background(control_period_t *period, uint64_t now_ns) {
    period->scheduler->due_ns[EVENT_BACKGROUND] = SCHEDULER_NEVER;
    plant_advance(period->plant, now_ns);
    call_deferred(period);
    call_background(period);
    shared_bus_start(&period->shared_bus);
}

/* A kick moves the time of the watchdog, and the event follows it when it is due. [SR-47] */
void control_period_watch(control_period_t *period, uint64_t now_ns) {
    period->scheduler->due_ns[EVENT_WATCHDOG] = period->board->watchdog_ns;
    if (period->board->watchdog_ns > now_ns) {
        return;
    }
    period->scheduler->due_ns[EVENT_WATCHDOG] = SCHEDULER_NEVER;
    plant_advance(period->plant, now_ns);
    if (!control_period_reset_drive(period, HAL_RESET_WATCHDOG)) {
        board_stop_gates(period->board);
    }
}
