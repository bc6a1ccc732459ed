/* The drive: what a board's main program starts, calls from its interrupt and calls from its loop. */
#ifndef DRIVE_H
#define DRIVE_H

#include <stdbool.h>
#include <stdint.h>

#include "comms/comms.h"
#include "drive/configure.h"
#include "drive/control.h"
#include "drive/parameters.h"
#include "hal.h"

/* One drive. The caller allocates it; only the functions below touch it. */
typedef struct {
    hal_t *hal;
    /* Of the interrupt; read by the background with the interrupt kept out. Its command is written by the background,
     * the interrupt kept out as well. */
    control_sample_t sample;
    /* Written by the background with the interrupt kept out. */
    control_parameters_t control_parameters;
    /* Of the interrupt; the background prepares its laws for new parameters, the interrupt kept out. */
    control_state_t control;
    /* The interrupt's time on the processor: nobody acts on it. What a late interrupt does is in drive/protection.h. */
    uint32_t used_ticks;      /* from trigger to end, of the last one, HAL_PWM_TICK_NS */
    uint32_t worst_ticks;     /* of the longest since start */
    uint32_t late_interrupts; /* that ended after the next trigger, since start */
    /* Of the background. */
    const machine_tables_t *tables;
    uint32_t control_rate_hz;
    parameters_t parameters;
    uint32_t configured_changes; /* parameters.changes that control_parameters stand for */
    comms_t comms;
} drive_t;

/* Prepares the drive and starts the timer. False, and nothing started, for a control rate that is not allowed. Keeps
 * hal and tables. [background, before anything else] */
bool drive_init(drive_t *drive, hal_t *hal, const machine_tables_t *tables, const drive_config_t *config);

/* One control period. [interrupt] */
void drive_control_interrupt(drive_t *drive);

/* Commands, telemetry, parameters; cheap when nothing is due. [background] */
void drive_background(drive_t *drive);

#endif
