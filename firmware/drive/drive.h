/* The drive: called by a board's main program, its interrupts and its loop. */
#ifndef DRIVE_DRIVE_H
#define DRIVE_DRIVE_H

#include <assert.h>
#include <stdbool.h>
#include <stdint.h>

#include "comms/comms.h"
#include "control/flux_angle.h"
#include "control/identify.h"
#include "control/shaft_torque.h"
#include "control/table_scale.h"
#include "hal.h"
#include "interrupts/configure.h"
#include "interrupts/control_step.h"
#include "interrupts/fault_trace.h"
#include "interrupts/sampler.h"
#include "interrupts/self_test.h"
#include "monitors/available_torque.h"
#include "monitors/flux_monitor.h"
#include "monitors/stall_monitor.h"
#include "monitors/sto_monitor.h"
#include "monitors/temperature.h"
#include "monitors/thermal.h"
#include "monitors/watchdog_monitor.h"
#include "storage/nvm_store.h"
#include "storage/parameters.h"
#include "storage/table_store.h"

/* Without commands a run's torque ramps to zero in this time after the parameter command_timeout_ms, in steps of a
 * hundredth; after COMMAND_LOST_US it ends in the fault command_timeout, in the control interrupt, whatever the
 * background does. Commands of the same sender, in sequence, that come back before then continue the run without
 * arming: the torque rises again from where it is, by the slew rates of the parameters. In speed mode the ramp carries
 * the speed beyond the last reference by no more than a sixteenth: silence may come during an acceleration. */
#define DRIVE_RAMP_US 100000u
#define DRIVE_RAMP_STEP_US 1000u

/* One drive. The caller allocates it; only the functions below and telemetry_collect() access it. */
typedef struct {
    /* Last accepted command; this and the next are written by the background with the interrupts masked. */
    command_t command;
    /* Written by the control interrupt, its member `deferred` by the deferred interrupt; the background prepares the
     * control laws for new parameters with the interrupts masked. */
    control_state_t control;
    control_parameters_t control_parameters;
    hal_pwm_compare_t compare; /* of the last period in RUN; written by the control interrupt */
    uint32_t break_causes;     /* of the last control interrupt, HAL_PWM_BREAK_*; written by it */
    /* Execution time of the interrupts, for telemetry only; overruns are handled by monitors/protection.h. */
    uint32_t used_ticks;  /* last control interrupt, from trigger to end, ticks of the timer */
    uint32_t worst_ticks; /* maximum since start */
    /* Written by the deferred interrupt. */
    uint32_t deferred_used_ticks;  /* last deferred interrupt, from the trigger of its period to its end */
    uint32_t deferred_worst_ticks; /* maximum since start */
    /* Used by the background only. */
    uint32_t processor_time_q24; /* LSB of telemetry, 5 ns, per tick */
    parameters_t parameters;
    uint32_t applied_revision; /* parameters.revision from which control_parameters are derived */
    uint32_t failed_checks;    /* of phases, encoder, stall and STO lines, when last checked, FAULT_BITs */
    sto_monitor_t sto;
    stall_monitor_t stall;
    flux_monitor_t flux;
    bool conduction_ends; /* of a phase, within two checks: its last sample is to have hardly a flux linkage */
    shaft_torque_t shaft_torque;
    table_scale_t table_scale; /* a property of the machine: survives the end of a run */
    degraded_t degraded;
    available_torque_t available_torque; /* for telemetry */
    self_test_t self_test;
    watchdog_monitor_t watchdog;
    bool ramping;          /* the torque ramps to zero, without commands; the others of a ramp are for this */
    bool ramp_of_speed;    /* the last command was one of speed */
    int16_t left_q14;      /* torque that the load left, of the largest one, when a position was last held */
    int32_t ramp_from_q24; /* torque reference at its start, N m, Q7.24 */
    uint32_t ramp_us;      /* time of the last step */
    /* Written by the context of its event, and by the background while it has none. Ahead of the members below,
     * although it is large: the control interrupt reads its first member within the offset of a load. */
    sampler_t sampler;
    /* Used by the background only. */
    comms_t comms;
    nvm_store_t store;
    table_store_t tables;
    flux_angle_t flux_angle[HAL_PHASES_MAX];
    thermal_t thermal;
    temperature_t temperature;
    /* Written by the control interrupt, from an address of its own. */
    fault_trace_t trace;
    /* Written by the control interrupt, its member `command` by the background with the interrupts masked. */
    identify_t identify;
} drive_t;

static_assert(sizeof(drive_t) % sizeof(uint32_t) == 0, "the sampler and XCP read words");
#define DRIVE_WORDS (sizeof(drive_t) / sizeof(uint32_t))
static_assert(DRIVE_WORDS <= SAMPLER_DRIVE_WORDS_MAX, "places of words in it");

/* Prepares the drive and starts the timer. Returns false, and starts nothing, for a node number above NODE_MAX and
 * for a control rate that the timer's clock (hal_pwm.h) cannot make or that is too low for the machine
 * (machine_tables.h). The drive keeps no pointer: each call is given the same hal.
 * [background, before anything else] */
bool drive_init(drive_t *drive, hal_t *hal, const drive_config_t *config);

/* One control period. [control interrupt] */
void drive_control_interrupt(drive_t *drive, hal_t *hal);

/* The deferred step that the control interrupt has requested (interrupts/deferred.h). [deferred interrupt] */
void drive_deferred_interrupt(drive_t *drive, hal_t *hal);

/* Commands, telemetry, parameters; returns immediately when nothing is due. [background] */
void drive_background(drive_t *drive, hal_t *hal);

#endif
