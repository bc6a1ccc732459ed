/* Experiments on a machine whose tables are not known: the drive measures its own motor.
 *
 * One experiment at a time, each begun by a new number: all switches off; a phase held at a current, with damping;
 * a full-voltage pulse to a current and back to none, fired at once or when the rotor passes a window. The host chooses
 * them so that the rotor is aligned, drifts at a mean speed or is spun up, and computes the machine from the record.
 *
 * Of the machine's tables nothing is used but the number of phases. A voltage chosen at a sample acts from the next
 * sample on, so that the current of the one after that is predicted, with the rise of the last period and, where that
 * grows, the growth; a phase without a known rise is fed one period, and waits for what that makes of its current.
 *
 * Limits: a phase whose current is beyond 1 1/32 of the limit, its sum of squares, travel and time end all experiments
 * until the drive leaves the mode: the switches stay off.
 */
#ifndef CONTROL_IDENTIFY_H
#define CONTROL_IDENTIFY_H

#include <stdbool.h>
#include <stdint.h>

#include "drive_enumerations.h"
#include "hal_pwm.h"

/* An experiment, as the host asks for it. */
typedef struct {
    identify_kind_t kind;
    uint8_t phase;      /* below the machine's number */
    uint8_t number;     /* another one begins the experiment */
    uint16_t level_q12; /* current, part of the limit, 0..4095 */
    uint16_t time_ms;   /* pulse: longest wait for the window; freewheel: its length; else none */
    uint16_t angle_q16; /* pulse: start of the window; damped: place of rest; 2^-16 rev of the encoder */
    uint16_t width_q16; /* pulse: of the window, 0: at once */
} identify_command_t;

typedef enum {
    IDENTIFY_IDLE,
    IDENTIFY_HOLDS,
    IDENTIFY_WAITS, /* for the window */
    IDENTIFY_CHARGES,
    IDENTIFY_FREEWHEELS,
    IDENTIFY_DISCHARGES,
    IDENTIFY_RESTS, /* some periods without current */
    IDENTIFY_ENDED  /* a limit; until the next run */
} identify_state_t;

typedef enum {
    IDENTIFY_WITHIN,
    IDENTIFY_CURRENT,
    IDENTIFY_ENERGY,
    IDENTIFY_TRAVEL,
    IDENTIFY_TIME,
    IDENTIFY_CONTROLLER /* another one than salient */
} identify_limit_t;

/* Switches of the experiment's phase in the period that begins with a sample. */
typedef enum { IDENTIFY_OFF, IDENTIFY_ZERO, IDENTIFY_ON, IDENTIFY_PART } identify_action_t;

typedef struct {
    int32_t limit_q9;        /* current, A, Q7.9, at least 1 A */
    uint32_t periods_per_ms; /* 20..1000; above 100 the copper loss of less than a second may be the limit */
    uint32_t phases;
} identify_parameters_t;

typedef struct {
    const int32_t *current_q9; /* of each phase, A, Q7.9, 0..65535 */
    int32_t dc_link_q6;        /* V, Q9.6, 0..65535 */
    uint32_t angle;            /* start of the encoder's count, 2^-32 rev */
} identify_sample_t;

/* State of the experiments. */
typedef struct {
    identify_command_t command; /* written by the background with the interrupts masked */
    uint32_t record[2];         /* of the last period, below */
    bool begun;                 /* in this run */
    bool records;               /* it belongs into the record, in which an idle drive has one in a millisecond */
    uint8_t number;             /* of the experiment */
    uint8_t state;              /* identify_state_t */
    uint8_t action, acted;      /* identify_action_t, of the period after the last sample, and before it */
    uint8_t limit;              /* identify_limit_t that has ended the experiments */
    uint32_t periods;           /* since the state */
    uint32_t run_periods;       /* since the start of the run */
    uint32_t recorded_periods;  /* since the last record, and its values: */
    int32_t recorded_q9;
    uint8_t recorded_state, recorded_action;
    uint32_t angle, mark[2];               /* of the last sample, and at 32 to 96 periods before it */
    int32_t travel;                        /* 2^-16 rev, saturated */
    int32_t previous_q9;                   /* current of the phase at the last sample */
    int32_t rise_q9;                       /* of it in the last period at full voltage of this pulse; 0: none yet */
    int32_t growth_q9;                     /* of the rise, at least 0 */
    int32_t first_rise_q9[HAL_PHASES_MAX]; /* largest one of a pulse's first period; 0: not known */
    uint32_t energy[HAL_PHASES_MAX];       /* sum of squares of currents, 2^-1 A^2 periods */
} identify_t;

/* Record: word 0 is the current of the phase, A, Q7.9, and from bit 16 on the DC-link voltage, V, Q9.6. Word 1: */
#define IDENTIFY_RECORD_NUMBER_BITS 4u /* of the experiment */
#define IDENTIFY_RECORD_STATE_BITS 3u
#define IDENTIFY_RECORD_ACTION_BITS 2u
#define IDENTIFY_RECORD_PHASE_BITS 3u
#define IDENTIFY_RECORD_ANGLE_BITS 20u /* the highest ones of the encoder's angle */

/* Longest time in which a winding carries the limit, or less current for as much copper loss: 1 s. */
#define IDENTIFY_ENERGY_MS 1000u
#define IDENTIFY_TIME_MS 120000u
/* Revolutions, from the start on. */
#define IDENTIFY_TRAVEL_REV 256
/* Longest time at full voltage. */
#define IDENTIFY_CHARGE_MS 50u
#define IDENTIFY_HOLD_MS 10000u

/* Begins a run, without an experiment before one with another number than the present command's; ended at once when the
 * controller estimates torque by the machine's tables outside of its runs, which would mislead the observer. */
void identify_begin(identify_t *identify, uint32_t angle, bool permitted);

/* A control period: the duty of each phase, Q1.15, -32768..32768, which acts from the next sample on.
 * [control interrupt] */
void identify_step(const identify_parameters_t *parameters, identify_t *identify, const identify_sample_t *sample,
                   int32_t duty_q15[HAL_PHASES_MAX]);

#endif
