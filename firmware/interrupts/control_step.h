/* The control interrupt as one function of parameters, state, sample and command: unit tests, the host port and the
 * interrupt handler of a target call the same function. control_step in control.c lists its steps:
 *
 *   measure         counts -> currents, DC-link voltage, rotor angle                                  measure.h
 *   protect         fault mask of the failed checks                                                   protection.h
 *   measure torque  currents -> phase torques, flux linkages                                          measure.h
 *   observe         rotor angle, speed and load torque                                                observe.h
 *   supervise       drive state, fault record; every switch is open outside RUN                       supervise.h
 *   speed control   speed reference -> torque reference                                               speed_control.h
 *   torque control  torque reference -> duties                                                        torque_control.h
 *   modulate        duties -> compare values                                                          modulator.h
 *   hand over       values of the period -> deferred step, whose results act in the next one          deferred.h
 */
#ifndef INTERRUPTS_CONTROL_STEP_H
#define INTERRUPTS_CONTROL_STEP_H

#include <stdbool.h>
#include <stdint.h>

#include "control/applied_flux.h"
#include "control/bp_tuner.h"
#include "control/commutation.h"
#include "control/conduction.h"
#include "control/count_course.h"
#include "control/ditc_hysteresis.h"
#include "control/inertia.h"
#include "control/load_observer.h"
#include "control/machine_tables.h"
#include "control/misalignment.h"
#include "control/moving_load.h"
#include "control/observer_bandwidth.h"
#include "control/periodic_load.h"
#include "control/position/position_loop.h"
#include "control/predictive_torque.h"
#include "control/pwm_ditc.h"
#include "control/speed_pi.h"
#include "control/speed_smc.h"
#include "control/stroke_mean.h"
#include "control/table_scale.h"
#include "control/torque_mode.h"
#include "control/torque_offset.h"
#include "hal_adc.h"
#include "hal_encoder.h"
#include "hal_pwm.h"
#include "interrupts/command.h"
#include "interrupts/deferred_exchange.h"
#include "interrupts/state_machine.h"
#include "monitors/degraded.h"
#include "monitors/flux_monitor.h"
#include "monitors/protection.h"
#include "monitors/temperature.h"
#include "monitors/thermal.h"

typedef enum {
    SPEED_LAW_PI,
    SPEED_LAW_SMC /* sliding mode */
} speed_law_t;

typedef enum {
    TORQUE_LAW_HYSTERESIS, /* DITC by hysteresis */
    TORQUE_LAW_DUTY,       /* DITC with the duty of a BP-PID */
    TORQUE_LAW_PREDICTIVE  /* torque sharing, predictive flux control */
} torque_law_t;

/* Constant while the drive runs; derived from the user's parameters by configure_control. Enumerations have 8 bits: the
 * same layout with every ABI, so that a check of it finds the same error at the same time on every target. */
typedef struct {
    drive_controller_t controller : 8; /* for telemetry; the laws below are its parts */
    speed_law_t speed_law : 8;
    torque_law_t torque_law : 8;
    uint8_t edge_age_shift;          /* of an encoder edge's age: 13, on a fast machine or with a slow clock more */
    int32_t speed_reference_min_q22; /* rad/s, Q9.22: 0 for a single-quadrant controller, else INT32_MIN */
    int32_t speed_reference_max_q22; /* magnitude to which commands are limited, rad/s, Q9.22 */
    bool interleaved_pwm;            /* two voltage pulses per period */
    bool load_from_transducer;       /* load torque of the sliding mode: measured; false: of the observer */
    uint16_t period_ticks;           /* half a control period */
    uint8_t encoder_shift;           /* counts to 2^-32 rev */
    uint8_t adc_bits;                /* resolution, 12..16 */
    uint16_t edge_age_max_ticks;     /* two periods at 20 kHz; an older edge only limits the angle to its count */
    int32_t edge_angle_per_tick_q51; /* rotation in a tick or, of a slow clock, a part, 2^-32 rev per rad/s */
    uint32_t encoder_middle;         /* half a count, 2^-32 rev; 0 at 32 bits */
    int32_t current_scale_q18;       /* A Q7.9 per count, in Q18: 10 at 12 bits */
    int32_t voltage_scale_q18;       /* V Q9.6 per count, in Q18 */
    uint32_t initialise_ticks;       /* control periods in 1 ms */
    int32_t speed_ramp_q22;          /* rad/s per period, Q9.22; INT32_MAX: no ramp */
    load_observer_model_t observer;
    commutation_parameters_t commutation;
    protection_parameters_t protection;
    speed_pi_parameters_t speed_pi;
    speed_smc_parameters_t speed_smc;
    ditc_hysteresis_parameters_t hysteresis;
    pwm_ditc_parameters_t duty;
    predictive_torque_parameters_t predictive;
    conduction_parameters_t conduction;
    misalignment_parameters_t misalignment;
    observer_bandwidth_parameters_t bandwidth;
    moving_load_parameters_t moving_load;
    stroke_mean_parameters_t stroke_mean;
    torque_offset_parameters_t torque_offset;
    periodic_load_parameters_t periodic_load;
    torque_mode_parameters_t torque_mode;
    inertia_parameters_t inertia;
    slow_counts_parameters_t slow_counts;
    count_course_parameters_t count_course;
    flux_monitor_parameters_t flux_monitor; /* this and the next four: background */
    int32_t table_scale_part_q31; /* by which the scale of the tables follows in a period, Q0.31; 0: it is 1 */
    bool scale_by_shaft;          /* and by the acceleration of the shaft, shaft_torque.h */
    degraded_parameters_t degraded;
    thermal_parameters_t thermal; /* this and the next: by drive.c, which alone needs them */
    temperature_parameters_t temperature;
    position_parameters_t position;
} control_parameters_t;

/* Inputs of one control period as the HAL delivers them. */
typedef struct {
    const hal_adc_sample_t *adc;
    hal_encoder_sample_t encoder;
    uint32_t missed_interrupts; /* since the previous period */
    uint32_t break_causes;      /* HAL_PWM_BREAK_* */
    uint32_t time_us;
} control_sample_t;

/* A sample in the formats of the control laws, and the torque and flux linkage that it implies. */
typedef struct {
    uint32_t encoder_angle;             /* start of the encoder count, 2^-32 rev */
    uint32_t angle;                     /* rotor, 2^-32 rev */
    bool angle_from_edge;               /* extrapolated from the time of an encoder edge; false: middle of the count */
    int32_t predicted_speed_q22;        /* observer's prediction for this sample, rad/s, Q9.22 */
    int32_t dc_link_voltage_q6;         /* V, Q9.6 */
    commutation_t commutation;          /* angle only: the torque laws find the roles of the phases */
    int32_t current_max_q9;             /* largest phase current, A, Q7.9 */
    int32_t torque_sum_q24;             /* machine torque, N m, Q7.24, saturated */
    int32_t current_q9[HAL_PHASES_MAX]; /* A, Q7.9 */
    /* In units of the tables, machine_format_t: */
    int32_t torque[HAL_PHASES_MAX];       /* not with predictive torque control */
    int32_t flux_linkage[HAL_PHASES_MAX]; /* with predictive torque control only */
} control_measurement_t;

/* State of the deferred step, which alone writes it. */
typedef struct {
    bool started;        /* the first input has initialised the protection */
    uint32_t generation; /* of the last input */
    protection_deferred_t protection;
    observer_bandwidth_statistics_t bandwidth;
    moving_load_t moving_load;
    moving_load_rounding_t rounding;
    torque_offset_t torque_offset;
    periodic_load_t periodic_load;
    bool run;                    /* in the last input */
    int32_t speed_reference_q22; /* after the ramp, rad/s, Q9.22 */
    speed_pi_t speed_pi;
    drive_mode_t mode; /* of the last input */
    torque_mode_t torque_mode;
    unsigned turn; /* of the last step, below DEFERRED_COMMON_PERIODS */
    conduction_state_t conduction;
    conduction_update_t conduction_update; /* in progress */
    stroke_mean_t stroke_mean;
    bool load_constant;               /* in the last stroke_mean_step */
    speed_smc_parameters_t speed_smc; /* in effect: gain by the identified inertia, above base speed smaller */
    misalignment_t misalignment;      /* a property of the machine: survives the end of a run */
    inertia_t inertia;                /* its shift likewise */
    int32_t mean_torque_q24;          /* machine torque since its last update, N m, Q7.24 */
    int32_t approached_q22;           /* speed reference, rad/s, Q9.22 */
    uint32_t updates_since_near;      /* since the speed was first near it */
    bool approaches_reference;        /* until then, and for some more */
    bool follows_position;            /* position mode, in which the next one takes the place of this */
    bool accelerates;                 /* the law of position mode asks for a torque that shows the inertia */
    slow_counts_t slow_counts;
    count_course_t count_course;
    bp_tuner_t tuner;
    deferred_response_t response;
} deferred_t;

/* Half a millisecond in which the observer may slip. */
typedef struct {
    uint32_t periods; /* since it began; 0: none has */
    uint32_t angle;   /* then, 2^-32 rev */
} observer_slip_t;

/* State of the control; the control interrupt alone writes the members other than `deferred`, the first and the last.
 */
typedef struct {
    uint32_t reported_fault_mask; /* failed checks of the background, which writes it in one access; FAULT_BITs */
    bool started;                 /* the first sample has initialised observer and protection */
    int32_t innovation;           /* of the last sample, 2^-32 rev */
    load_observer_t observer;
    observer_bandwidth_t bandwidth;
    protection_t protection;
    state_machine_t state_machine;
    int32_t torque_reference_q24;     /* 0 outside RUN */
    int32_t duty_q15[HAL_PHASES_MAX]; /* acts from the coming sample on, -32768..32768; outside RUN -32768: off */
    pwm_ditc_t duty;
    predictive_torque_t predictive;
    deferred_request_t deferred_request;
    applied_flux_t applied_flux; /* corrected by the background with the interrupts masked */
    deferred_t deferred;
    control_measurement_t measurement; /* of this period, by measure.h; the background reads the last one */
    observer_slip_t slip;
    uint32_t lost_phase; /* number from 1 on of the phase whose switches stay open, as reported_fault_mask; 0: none */
    int32_t flux_misalignment[HAL_PHASES_MAX]; /* by the flux linkage, as reported_fault_mask, 2^-32 electrical rev; 0:
                                                  unknown */
    int32_t torque_limit_q24;          /* of the torque reference's magnitude, as reported_fault_mask, N m, Q7.24 */
    table_scale_factors_t table_scale; /* written by the background with the interrupts masked; so is the next */
    position_command_t position_command;
    position_t position; /* written by the deferred interrupt */
} control_state_t;

/* State INITIALISE, rotor at standstill, controllers reset. */
void control_reset(const control_parameters_t *parameters, control_state_t *state);

/* Resets the controllers for the next run. Required after a change of parameters, which is possible outside RUN only;
 * leaving RUN does it too, after a fault in the first period without a failed check. Not part of entering RUN because
 * initialising a network takes as long as a learning step. */
void control_prepare(const control_parameters_t *parameters, control_state_t *state);

/* One control period. command: the last accepted one, COMMAND_OFF before the first. Returns false when every switch
 * must be open; then *compare is all zero, else the values of the machine's phases are set. A deferred step
 * (deferred.h) is requested, unless state->deferred_request.skipped > 0. [control interrupt] */
bool control_step(const control_parameters_t *parameters, control_state_t *state, const control_sample_t *sample,
                  const command_t *command, hal_pwm_compare_t *compare);

#endif
