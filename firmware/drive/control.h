/* The control interrupt as one function of parameters, state and sample: a unit test, the host loop and an interrupt
 * handler call the same one.
 *
 *   counts -> currents, angle -> phase torques -> observer -> checks -> state machine -> speed law -> torque law ->
 *   compare
 */
#ifndef DRIVE_CONTROL_H
#define DRIVE_CONTROL_H

#include <stdbool.h>
#include <stdint.h>

#include "control/commutation.h"
#include "control/ditc_duty.h"
#include "control/ditc_hysteresis.h"
#include "control/load_observer.h"
#include "control/machine_tables.h"
#include "control/misalignment.h"
#include "control/observer_bandwidth.h"
#include "control/predictive_torque.h"
#include "control/speed_pi.h"
#include "control/speed_smc.h"
#include "control/torque_trim.h"
#include "drive/command.h"
#include "drive/protection.h"
#include "drive/state_machine.h"
#include "hal_adc.h"
#include "hal_encoder.h"
#include "hal_pwm.h"

/* Read only in the interrupt; derived from the parameters by configure_control. */
typedef struct {
    const machine_tables_t *tables;
    drive_controller_t controller;
    bool two_pulses;           /* a period, of the salient controller */
    bool load_from_transducer; /* the sliding mode takes the measured load torque, not the observer's */
    uint16_t period_ticks;
    uint8_t encoder_shift;     /* counts to 2^-32 turn */
    uint8_t adc_bits;          /* of a code, 12..16 */
    uint32_t encoder_middle;   /* of a count, 2^-32 turn; 0 where a count is one */
    int32_t current_scale_q18; /* a code in A, Q7.9: 10 of a 12-bit code */
    int32_t voltage_scale_q18; /* a code in V, Q9.6 */
    uint32_t initialise_ticks; /* periods in 1 ms */
    int32_t speed_ramp_q22;    /* rad/s a period, Q9.22; INT32_MAX: no ramp */
    load_observer_model_t observer;
    commutation_parameters_t commutation;
    protection_parameters_t protection;
    speed_pi_parameters_t speed_pi;
    ditc_hysteresis_parameters_t hysteresis;
    speed_smc_parameters_t speed_smc;
    ditc_duty_parameters_t duty;
    torque_trim_parameters_t trim;
    predictive_torque_parameters_t predictive;
    misalignment_parameters_t misalignment;
    observer_bandwidth_parameters_t bandwidth;
} control_parameters_t;

/* What the sensors of the last sample say, in the formats of the laws. */
typedef struct {
    uint32_t count_angle; /* where the encoder's count begins, 2^-32 turn */
    uint32_t angle;       /* 2^-32 turn */
    bool from_edge;       /* the angle is that of an edge and its time */
    int32_t current_q9[HAL_PHASES_MAX];
    int32_t current_max_q9;
    int32_t bus_voltage_q6;
    commutation_t commutation;
    int32_t torque_q24[HAL_PHASES_MAX];
    int32_t torque_sum_q24;
    int32_t flux_q29[HAL_PHASES_MAX]; /* salient controller */
} control_estimate_t;

/* What every controller needs first: the nearer, the fewer instructions. */
typedef struct {
    load_observer_t observer;
    control_estimate_t estimate;
    observer_bandwidth_t bandwidth;
    protection_t protection;
    state_machine_t machine;
    bool started;                 /* the first sample has set the observer's angle */
    int32_t speed_reference_q22;  /* behind the ramp */
    int32_t torque_reference_q24; /* 0 outside RUN */
    speed_pi_t speed_pi;
    ditc_hysteresis_t hysteresis;
    misalignment_t misalignment;      /* of the machine: outlives a run */
    int32_t duty_q15[HAL_PHASES_MAX]; /* of a law that gives duties, in RUN */
    ditc_duty_t duty;
    torque_trim_t trim;
    predictive_torque_t predictive;
} control_state_t;

typedef struct {
    hal_adc_sample_t adc;
    hal_encoder_sample_t encoder;
    uint32_t missed_interrupts; /* since the last call */
    uint32_t time_us;
    command_t command; /* the last accepted one; request off before the first */
} control_sample_t;

/* INITIALISE, everything at rest, the laws prepared. */
void control_reset(const control_parameters_t *parameters, control_state_t *state);

/* The laws start afresh at the next RUN: whenever parameters change, which they do outside of RUN. control_step does it
 * itself on leaving RUN. Apart from entering RUN, because a network takes as long to start as it does to learn. */
void control_prepare(const control_parameters_t *parameters, control_state_t *state);

/* One control period. Returns false when every switch must be open: then *compare is all zero. [interrupt] */
bool control_step(const control_parameters_t *parameters, control_state_t *state, const control_sample_t *sample,
                  hal_pwm_compare_t *compare);

/* True when the torque law gives duties, as the paper's does; else it is hysteresis, or the salient controller. */
static inline bool control_gives_duties(const control_parameters_t *parameters) {
    return parameters->controller == DRIVE_CONTROLLER_PAPER && parameters->duty.pid.mode != BP_PID_OFF;
}

#endif
