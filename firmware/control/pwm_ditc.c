#include "control/pwm_ditc.h"

#include "control/phase_map.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"
#include "fixed/formats.h"

#define SETPOINT_UNIT_BITS 20 /* 1/16 N m in Q24 */

/* Limits of the factor of the gains. */
#define FACTOR_MIN_Q16 (1 << 11)
#define FACTOR_MAX_Q16 (1 << 18)

/* Periods, as a power of two, over which the duty that an outgoing phase keeps is averaged. */
#define RELEASED_SHIFT 2

void pwm_ditc_reset(pwm_ditc_t *ditc) {
    bp_pid_reset(&ditc->pid);
    ditc->regulated = COMMUTATION_NONE;
    ditc->released_q15 = ditc->incoming_torque = ditc->error_q24 = 0;
}

pwm_ditc_setpoints_t pwm_ditc_setpoints(const machine_tables_t *tables, uint32_t crossover_angle) {
    pwm_ditc_setpoints_t setpoints = {{0}};
    for (unsigned k = 1; k < PWM_DITC_SETPOINTS; k++) {
        const uint32_t entry_q24 = ((4u + k % 4u) << (k / 4u + SETPOINT_UNIT_BITS - 2u)) - (1u << SETPOINT_UNIT_BITS);
        const int32_t torque_q24 = entry_q24 < INT32_MAX ? (int32_t)entry_q24 : INT32_MAX;
        /* Largest current whose torque does not exceed it, by bisection. */
        uint32_t current_q9 = 0;
        for (uint32_t bit = 1u << 15; bit > 0; bit >>= 1) {
            const int32_t trial_q9 = fixed_clamp((int32_t)(current_q9 | bit), 0, PHASE_MAP_CURRENT_MAX_Q9);
            const int32_t torque = phase_map_torque(tables, crossover_angle, trial_q9);
            if (phase_map_scale(&tables->torque_format, torque) <= torque_q24) {
                current_q9 |= bit;
            }
        }
        setpoints.current_q9[k] = (uint16_t)fixed_clamp((int32_t)current_q9, 0, PHASE_MAP_CURRENT_MAX_Q9);
    }
    return setpoints;
}

int32_t pwm_ditc_setpoint_q9(const pwm_ditc_setpoints_t *setpoints, int32_t torque_q24) {
    const uint32_t shifted_q24 = (uint32_t)fixed_non_negative(torque_q24) + (1u << SETPOINT_UNIT_BITS);
    const unsigned zeros = (unsigned)__builtin_clz(shifted_q24); /* 0..11 */
    const uint32_t mantissa = shifted_q24 << zeros << 1;         /* without the leading one */
    const uint16_t *entry = &setpoints->current_q9[4u * (31u - SETPOINT_UNIT_BITS - zeros) + (mantissa >> 30)];
    const int32_t fraction_q14 = (int32_t)(mantissa >> 16) & 0x3fff;
    return entry[0] + ((entry[1] - entry[0]) * fraction_q14 >> 14);
}

typedef struct {
    int32_t torque; /* unit of the tables */
    int32_t flux_q29;
} difference_t;

/* Over an eighth of a current. */
static difference_t difference_at(const machine_tables_t *tables, uint32_t angle, int32_t current_q9) {
    const int32_t high_q9 = fixed_clamp(current_q9 + (current_q9 >> 3), 0, PHASE_MAP_CURRENT_MAX_Q9);
    const uint32_t distance = phase_map_distance(angle);
    return (difference_t){
        .torque = phase_map_torque(tables, angle, high_q9) - phase_map_torque(tables, angle, current_q9),
        .flux_q29 = phase_map_flux_q29(tables, distance, high_q9) - phase_map_flux_q29(tables, distance, current_q9),
    };
}

void pwm_ditc_set_reference_point(pwm_ditc_parameters_t *parameters, const machine_tables_t *tables, uint32_t angle,
                                  int32_t voltage_step_q29) {
    const difference_t at = difference_at(tables, angle, parameters->current_limit_q9 >> 1);
    const int64_t torque = at.torque > 0 ? at.torque : 1;                /* without torque there the largest values */
    const int64_t flux_q29 = fixed_clamp(at.flux_q29, 1, (1 << 29) - 1); /* below 1 Wb */
    parameters->torque_per_flux_q16 = fixed_saturate(fixed_divide(torque << 16, flux_q29));
    const int64_t flux_per_torque_q34 = fixed_clamp_64(fixed_divide(flux_q29 << 34, torque), 0, INT64_MAX >> 10);
    parameters->duty_per_torque_q44 = fixed_saturate(fixed_divide(flux_per_torque_q34 << 10, voltage_step_q29));
}

/* expected / torque, limited, within 0.1 %: a division of 32 bits. */
static int32_t limited_ratio_q16(int32_t expected, int32_t torque) {
    if (torque <= 0) {
        return FACTOR_MAX_Q16;
    }
    const unsigned shift = (unsigned)__builtin_clz((uint32_t)torque) - 1u;
    const uint32_t divisor = (uint32_t)torque << shift >> 15; /* 2^15..2^16 - 1 */
    const int64_t dividend = (int64_t)expected << shift;      /* 2^30..2^31 - 1 times the ratio */
    if (dividend >= INT64_C(1) << 33) {
        return FACTOR_MAX_Q16;
    }
    const uint32_t eighth = (uint32_t)(dividend >> 2) / divisor; /* of the ratio in Q16 */
    return fixed_clamp((int32_t)eighth * 8, FACTOR_MIN_Q16, FACTOR_MAX_Q16);
}

static int32_t factor_at(const pwm_ditc_parameters_t *parameters, const machine_tables_t *tables, uint32_t angle,
                         int32_t current_q9) {
    /* A column below the end of the tables, so that there is a difference. */
    const int32_t from_q9 = fixed_clamp(current_q9, parameters->current_limit_q9 >> 5,
                                        PHASE_MAP_CURRENT_MAX_Q9 - (1 << MACHINE_COLUMN_BITS));
    const difference_t at = difference_at(tables, angle, from_q9);
    /* With the slope of the reference point. */
    const int32_t expected = fixed_saturate(fixed_product(at.flux_q29, parameters->torque_per_flux_q16) >> 16);
    return limited_ratio_q16(fixed_non_negative(expected), at.torque);
}

pwm_ditc_plan_t pwm_ditc_plan(const pwm_ditc_parameters_t *parameters, const machine_tables_t *tables,
                              const pwm_ditc_plan_sample_t *sample) {
    const int32_t factor = factor_at(parameters, tables, sample->angle, sample->current_q9);
    const int32_t carrying_q9 = pwm_ditc_setpoint_q9(&parameters->current_setpoints, sample->reference_q24);
    const int32_t limit_q9 = parameters->current_limit_q9;
    const int32_t setpoint_q9 = fixed_min(carrying_q9, limit_q9);
    /* The rise takes as many periods as the deadbeat gain, twice incoming_gain, gives duties. */
    const int32_t periods_q15 =
        2 * ONE_Q15 + fixed_multiply_high(setpoint_q9 * (1 << 14), parameters->incoming_gain_q24);
    return (pwm_ditc_plan_t){
        .factor_q16 = factor,
        .duty_per_torque_q47 = fixed_saturate(fixed_product(parameters->duty_per_torque_q44, factor) >> 13),
        .setpoint_q9 = setpoint_q9,
        .lead = (uint32_t)(fixed_product(sample->angle_step, periods_q15) >> 15),
    };
}

static void open_switches(int32_t duty_q15[HAL_PHASES_MAX]) {
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        duty_q15[phase] = -ONE_Q15;
    }
}

/* Duty that drives the incoming phase to its current setpoint, or to the limit while the torque is below the outer
 * band. acting_q15: its duty until the new one acts. */
static int32_t incoming_duty_q15(const pwm_ditc_parameters_t *parameters, const pwm_ditc_sample_t *sample,
                                 int32_t current_q9, int32_t acting_q15) {
    const int32_t limit_q9 = parameters->current_limit_q9;
    const int32_t target_q9 = sample->error_q24 > parameters->band_outer_q24 ? limit_q9 : sample->plan->setpoint_q9;
    /* Q23 * Q24 to Q15: currents of 0..128 A differ by less than 2^30. */
    const int32_t wanted_q15 = fixed_multiply_high((target_q9 - current_q9) * (1 << 14), parameters->incoming_gain_q24);
    const int32_t effect_q15 = acting_q15 == -ONE_Q15 ? 0 : acting_q15; /* off, so far */
    const int32_t duty_q15 = wanted_q15 - (effect_q15 >> 1);            /* within 2^31 / 2 */
    return current_q9 > limit_q9 && duty_q15 > 0 ? 0 : duty_q15;
}

/* Highest duty of the regulated phase. acting_q15: its duty until the new one acts. */
static int32_t ceiling_q15(const pwm_ditc_parameters_t *parameters, int32_t current_q9, int32_t acting_q15) {
    if (current_q9 > parameters->current_limit_q9) {
        return 0;
    }
    const int32_t room_q9 = parameters->current_ceiling_q9 - current_q9; /* >= 0 */
    return fixed_multiply_high(room_q9 * (1 << 14), parameters->ceiling_gain_q24) - acting_q15;
}

/* Duty of the outgoing phase after the BP-PID has left it. */
static int32_t outgoing_duty_q15(const pwm_ditc_parameters_t *parameters, const pwm_ditc_t *ditc,
                                 const pwm_ditc_sample_t *sample, int32_t current_q9, int32_t acting_q15) {
    if (sample->error_q24 > parameters->band_outer_q24) {
        return ceiling_q15(parameters, current_q9, acting_q15);
    }
    if (sample->error_q24 < -parameters->band_outer_q24) {
        return -ONE_Q15;
    }
    return ditc->released_q15 < 0 ? ditc->released_q15 : 0; /* no voltage raises it */
}

static int32_t normalised_q24(int32_t error_q24, int32_t factor_q16) {
    return fixed_saturate(fixed_product(error_q24, factor_q16) >> 16);
}

/* Duty of the regulated phase by the BP-PID, and with an incoming phase less what that gains in torque. */
static int32_t regulated_duty_q15(const pwm_ditc_parameters_t *parameters, pwm_ditc_t *ditc,
                                  const pwm_ditc_sample_t *sample, unsigned active) {
    const int32_t incoming_torque = ditc->regulated != active ? sample->torque[active] : 0;
    const int32_t gained = fixed_subtract(incoming_torque, ditc->incoming_torque);
    ditc->incoming_torque = incoming_torque;
    /* Both errors by the present factor: one that changes, above all with the phase, is no change of the error. */
    const int32_t factor_q16 = sample->plan->factor_q16;
    bp_pid_set_error(&parameters->pid, &ditc->pid, normalised_q24(ditc->error_q24, factor_q16));
    ditc->error_q24 = sample->error_q24;
    const int32_t error_q24 = normalised_q24(sample->error_q24, factor_q16);
    const int32_t duty_q15 = bp_pid_step(&parameters->pid, &ditc->pid, sample->gain_q24, error_q24);
    const int32_t forward_q15 = fixed_multiply_high(gained, sample->plan->duty_per_torque_q47);
    return ditc->regulated == active ? duty_q15 : duty_q15 - forward_q15;
}

void pwm_ditc_step(const pwm_ditc_parameters_t *parameters, pwm_ditc_t *ditc, const commutation_t *commutation,
                   const pwm_ditc_sample_t *sample, int32_t duty_q15[HAL_PHASES_MAX]) {
    const unsigned active = commutation->active;
    const unsigned outgoing = commutation->outgoing;
    if (active == COMMUTATION_NONE) {
        open_switches(duty_q15);
        return;
    }

    if (ditc->regulated >= COMMUTATION_NONE) {
        /* From standstill: a phase past its window still has torque, the one that just entered has none. */
        ditc->regulated = outgoing != COMMUTATION_NONE ? outgoing : active;
    }
    int32_t other_q15 = -ONE_Q15; /* of the available phase that is not regulated */
    if (ditc->regulated != active) {
        other_q15 = incoming_duty_q15(parameters, sample, sample->current_q9[active], duty_q15[active]);
        const bool overtaken = sample->torque[ditc->regulated] <= sample->torque[active] && sample->error_q24 <= 0;
        if (overtaken || ditc->regulated != outgoing) {
            bp_pid_preset(&ditc->pid, other_q15);
            ditc->regulated = active;
        }
    }
    const unsigned regulated = ditc->regulated;
    unsigned other = active;
    if (regulated == active && outgoing != COMMUTATION_NONE) {
        other = outgoing;
        other_q15 = outgoing_duty_q15(parameters, ditc, sample, sample->current_q9[outgoing], duty_q15[outgoing]);
    } else {
        ditc->released_q15 += (duty_q15[regulated] - ditc->released_q15) >> RELEASED_SHIFT;
    }

    const int32_t regulated_q15 = regulated_duty_q15(parameters, ditc, sample, active);
    const int32_t highest_q15 = ceiling_q15(parameters, sample->current_q9[regulated], duty_q15[regulated]);
    open_switches(duty_q15);
    duty_q15[other] = fixed_clamp(other_q15, -ONE_Q15, ONE_Q15);
    duty_q15[regulated] = fixed_clamp(fixed_min(regulated_q15, highest_q15), -ONE_Q15, ONE_Q15);
}
