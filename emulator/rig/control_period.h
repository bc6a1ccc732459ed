/* The control period: sample instants, the control interrupt, what runs after it, and a reset of the drive. */
#ifndef RIG_CONTROL_PERIOD_H
#define RIG_CONTROL_PERIOD_H

#include <stdbool.h>
#include <stdint.h>

#include "plant/plant.h"
#include "plant/sensors.h"
#include "rig/board.h"
#include "rig/firmware.h"
#include "rig/heat.h"
#include "rig/memory_flips.h"
#include "rig/scheduler.h"
#include "rig/shared_bus.h"

typedef struct {
    /* Parts of the rig that it uses. */
    plant_t *plant;
    sensors_t *sensors;
    board_t *board;
    heat_t *heat;
    scheduler_t *scheduler; /* with EVENT_CURRENT_HOLD, EVENT_CONTROL, EVENT_BACKGROUND and EVENT_WATCHDOG */
    shared_bus_t shared_bus;
    const rig_observer_t *observer;

    rig_firmware_t firmware;
    memory_flips_t flips; /* in its memory */
    uint64_t length_ns;
    uint64_t interrupt_time_ns;            /* of a control interrupt, as the bench sets it */
    uint64_t interrupt_late_ns;            /* least time of one, by a fault */
    uint64_t interrupt_end_ns;             /* triggers before the end of the last interrupt are lost */
    bool interrupts_lost, background_hung; /* by faults */
} control_period_t;

/* No firmware; keeps the parts of the rig, which `parts` holds. */
void control_period_init(control_period_t *period, const control_period_t *parts);

/* Schedules the first period, one period from now, when the firmware has started the timer, and the watchdog. */
void control_period_begin(control_period_t *period);

/* Takes the length of the periods after the present one from the timer's register. */
void control_period_set_length(control_period_t *period);

/* Schedules EVENT_CURRENT_HOLD for the next period's sample, ahead of it by the current sensors' delay, limited to one
 * period. Without a delay, or when that instant has passed, the currents at the sample itself will be converted. */
void control_period_schedule_hold(control_period_t *period);

/* Resets the drive: the switches open, the firmware starts again, the memory and everything outside the drive continue.
 * False when the firmware cannot be reset. */
bool control_period_reset_drive(control_period_t *period, hal_reset_cause_t cause);

/* EVENT_CURRENT_HOLD, EVENT_CONTROL, EVENT_BACKGROUND and EVENT_WATCHDOG. */
void control_period_hold(control_period_t *period, uint64_t now_ns);
void control_period_start(control_period_t *period, uint64_t now_ns);
void control_period_resume_background(control_period_t *period, uint64_t now_ns);
void control_period_watch(control_period_t *period, uint64_t now_ns);

#endif
