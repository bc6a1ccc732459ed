#include "control/predictive_torque.h"

#include "fixed/fixed.h"
#include "fixed/formats.h"

/* 0.25 Wb: 512 V for half a millisecond. */
#define FLUX_STEP_LIMIT_Q29 (1 << 27)

/* Torque shortfall that advances the windows: 0.05 N m and 1/64 of the reference. Less may be rounding. */
#define SHORTFALL_MIN_Q24 ((1 << 24) / 20)

/* Torque shortfall below which none is reported: 1/64 N m. Torque and flux linkage of an operating point agree within 2
 * mN m, and a period may need several points. */
#define SHORTFALL_TOLERANCE_Q24 (1 << 18)

/* Plan of a phase for the sample two periods ahead. */
typedef struct {
    uint32_t angle;                      /* 2^-32 electrical rev, mirrored into the half of positive torque */
    bool positive;                       /* the phase itself is in that half */
    uint32_t since_on;                   /* angle past turn-on, 2^-32 electrical rev; from 2^31: before turn-on */
    int32_t freewheeling_q29;            /* flux linkage after a period without voltage, Wb */
    phase_map_constraints_t constraints; /* flux linkages that a period of -Vdc and of +Vdc reach, or less */
    phase_map_operating_point_t point;   /* target, torque by magnitude */
} plan_t;

/* Plans the operating point for a torque within the constraints; true when they limit the torque. */
static bool plan_torque(const machine_tables_t *tables, plan_t *plan, int32_t torque_q24) {
    phase_map_operating_point_t *point = &plan->point;
    if (torque_q24 <= 0 && plan->constraints.flux_min_q29 == 0) {
        point->flux_q29 = 0;
        point->torque_q24 = 0;
        return false;
    }
    return !phase_map_solve(tables, plan->angle, torque_q24, &plan->constraints, point);
}

/* Sorts the phases of one half past turn-on, last to enter first. Returns their number. */
static unsigned sort_by_entry(const plan_t *plan, unsigned phases, bool positive, bool reverse,
                              unsigned order[HAL_PHASES_MAX]) {
    unsigned count = 0;
    for (unsigned phase = 0; phase < phases; phase++) {
        if (plan[phase].positive != positive || plan[phase].since_on >= HALF_REV) {
            continue;
        }
        /* In forward rotation a phase enters the positive half at turn-on, the other half at turn-off. */
        unsigned index = count++;
        while (index > 0 && (plan[phase].since_on < plan[order[index - 1]].since_on) == (positive != reverse)) {
            order[index] = order[index - 1];
            index--;
        }
        order[index] = phase;
    }
    return count;
}

/* Distributes a torque shortfall (signed, N m, Q7.24) over the phases of one half; returns the rest. */
static int32_t redistribute_torque(const machine_tables_t *tables, plan_t *plan,
                                   const predictive_torque_sample_t *sample, bool positive, bool decrease_only,
                                   int32_t shortfall_q24) {
    const bool increase = (shortfall_q24 > 0) == positive;
    if (shortfall_q24 == 0 || (increase && decrease_only)) {
        return shortfall_q24;
    }
    unsigned order[HAL_PHASES_MAX];
    const unsigned count = sort_by_entry(plan, tables->phases, positive, sample->reverse, order);
    for (unsigned n = 0; n < count && shortfall_q24 != 0; n++) {
        plan_t *p = &plan[order[increase ? n : count - 1 - n]];
        if (p->point.flux_q29 == (increase ? p->constraints.flux_max_q29 : p->constraints.flux_min_q29)) {
            continue;
        }
        const int32_t before_q24 = p->point.torque_q24;
        const int32_t change_q24 = positive ? shortfall_q24 : fixed_subtract(0, shortfall_q24);
        (void)plan_torque(tables, p, fixed_add(before_q24, change_q24));
        const int32_t gained_q24 = fixed_subtract(p->point.torque_q24, before_q24);
        shortfall_q24 = positive ? fixed_subtract(shortfall_q24, gained_q24) : fixed_add(shortfall_q24, gained_q24);
    }
    return shortfall_q24;
}

torque_sharing_window_t predictive_torque_move_windows(const predictive_torque_parameters_t *parameters,
                                                       int32_t *advance_q30, int32_t torque_q24,
                                                       int32_t torque_shortfall_q24) {
    const bool voltage_limited = fixed_abs(torque_shortfall_q24) > SHORTFALL_MIN_Q24 + fixed_abs(torque_q24) / 64;
    const int32_t step_q30 = voltage_limited ? parameters->advance_step_q30 : -parameters->retract_step_q30;
    *advance_q30 = fixed_clamp(*advance_q30 + step_q30, 0, ONE_Q30);
    const int32_t advance_q15 = *advance_q30 >> 15;
    return advance_q15 > 0 ? torque_sharing_window(&parameters->sharing, advance_q15) : parameters->base_window;
}

static int32_t non_negative(int32_t flux_q29) {
    return flux_q29 > 0 ? flux_q29 : 0;
}

/* torque * share, torque >= 0, share 0..1 in Q1.15: rounded to 4 LSB, exact for a share of 1. */
static int32_t share_of(int32_t torque_q24, int32_t share_q15) {
    return share_q15 == ONE_Q15 ? torque_q24 : 4 * fixed_multiply_high(torque_q24, share_q15 << 15);
}

/* Flux linkage that -Vdc removes until `travel` is covered at `angle_step` per period, 2^-32 electrical rev; Wb, Q2.29,
 * saturated. */
static int32_t removable_flux_q29(int32_t flux_step_max_q29, uint32_t travel, uint32_t angle_step) {
    const uint32_t periods_q8 = travel / ((angle_step >> 8) + 1);
    return fixed_saturate(fixed_shift((int64_t)flux_step_max_q29 * periods_q8, 8));
}

/* Predicts the flux linkage of a phase and which flux linkages the coming period can reach from there. */
static inline void predict_flux(const predictive_torque_parameters_t *parameters, predictive_torque_t *control,
                                const predictive_torque_sample_t *sample, unsigned phase, int32_t flux_step_max_q29,
                                plan_t *p) {
    int32_t *flux_q29 = &control->flux_q29[phase];
    /* Q15 * Q29 to Q29. */
    const int32_t applied_q29 = fixed_multiply_high(control->duty_q15[phase] * (1 << 14), flux_step_max_q29 << 3);
    const int32_t resistive_drop_q29 = flux_observer_step(&parameters->flux, flux_q29, sample->flux_q29[phase],
                                                          applied_q29, sample->current_q9[phase]);
    p->freewheeling_q29 = fixed_subtract(*flux_q29, resistive_drop_q29);
    p->constraints = (phase_map_constraints_t){
        .flux_min_q29 = non_negative(fixed_subtract(p->freewheeling_q29, flux_step_max_q29)),
        .flux_max_q29 = non_negative(fixed_add(p->freewheeling_q29, flux_step_max_q29)),
        .current_limit_q9 = parameters->current_limit_q9,
    };
}

/* Duty of each phase from its planned flux linkage. */
static inline void set_duties(const predictive_torque_parameters_t *parameters, predictive_torque_t *control,
                              const predictive_torque_sample_t *sample, unsigned phases, int32_t flux_step_max_q29,
                              const plan_t *plan, int32_t duty_q15[HAL_PHASES_MAX]) {
    /* Q15 quotient of two 32-bit numbers, normalised: divisor 2^14..2^15, dividend with 15 fraction bits more. */
    const int shift = __builtin_clz((uint32_t)flux_step_max_q29) - 2;
    const int32_t divisor = (flux_step_max_q29 << shift) >> 15;
    for (unsigned phase = 0; phase < phases; phase++) {
        const plan_t *p = &plan[phase];
        const int32_t flux_step_q29 = p->point.flux_q29 - p->freewheeling_q29; /* within +-flux_step_max */
        const int32_t unclamped_q15 = flux_step_q29 * (1 << shift) / divisor;
        /* Target 0: both switches off. Current above the limit: no positive voltage. */
        const int32_t duty_max_q15 = sample->current_q9[phase] > parameters->current_limit_q9 ? 0 : ONE_Q15;
        duty_q15[phase] = p->point.flux_q29 > 0 ? fixed_clamp(unclamped_q15, -ONE_Q15, duty_max_q15) : -ONE_Q15;
        control->duty_q15[phase] = duty_q15[phase];
        control->column[phase] = (uint8_t)p->point.column;
    }
}

void predictive_torque_reset(predictive_torque_t *control) {
    *control = (predictive_torque_t){.torque_shortfall_q24 = 0};
}

void predictive_torque_step(const predictive_torque_parameters_t *parameters, predictive_torque_t *control,
                            const machine_tables_t *tables, const predictive_torque_sample_t *sample,
                            int32_t duty_q15[HAL_PHASES_MAX]) {
    const unsigned phases = tables->phases;
    /* Vdc Ts: Q6 * Q40 to Q29; at least 64, so that the division in set_duties() is defined without a DC link. */
    const int32_t flux_step_max_q29 =
        fixed_clamp(fixed_multiply_high(sample->bus_voltage_q6 << 15, parameters->period_q40), 64, FLUX_STEP_LIMIT_Q29);

    const int32_t torque_q24 = sample->torque_q24;
    const int32_t opposed_q24 = fixed_clamp(parameters->reserve_q24 - fixed_abs(torque_q24), 0, INT32_MAX);
    const int32_t positive_half_q24 = fixed_add(torque_q24 > 0 ? torque_q24 : 0, opposed_q24);
    const int32_t negative_half_q24 = fixed_add(torque_q24 < 0 ? fixed_abs(torque_q24) : 0, opposed_q24);

    plan_t plan[HAL_PHASES_MAX];
    int32_t shortfall_q24 = torque_q24;
    bool limited = false;
    for (unsigned phase = 0; phase < phases; phase++) {
        plan_t *p = &plan[phase];
        predict_flux(parameters, control, sample, phase, flux_step_max_q29, p);
        const uint32_t angle = sample->angle[phase];
        p->positive = angle >= HALF_REV;
        p->angle = p->positive ? angle : ~angle; /* mirrored, to 1 LSB */
        p->point.column = control->column[phase];
        const bool braking = p->positive == sample->reverse; /* it moves towards unaligned */
        /* Windows advance against the rotation, which would be later for a braking phase. */
        const torque_sharing_window_t *window = braking ? &parameters->base_window : sample->window;
        p->since_on = p->angle - window->turn_on;
        const int32_t half_q24 = p->positive ? positive_half_q24 : negative_half_q24;
        int32_t target_q24 = 0;
        if (half_q24 > 0) {
            target_q24 = share_of(half_q24, torque_sharing_q15(window, p->angle));
        }
        if (braking && p->constraints.flux_max_q29 > p->constraints.flux_min_q29) {
            const int32_t removable_q29 =
                removable_flux_q29(flux_step_max_q29, p->angle - HALF_REV, sample->angle_step);
            p->constraints.flux_max_q29 =
                fixed_clamp(removable_q29, p->constraints.flux_min_q29, p->constraints.flux_max_q29);
        }
        limited |= plan_torque(tables, p, target_q24);
        const int32_t planned_q24 = p->point.torque_q24;
        shortfall_q24 =
            p->positive ? fixed_subtract(shortfall_q24, planned_q24) : fixed_add(shortfall_q24, planned_q24);
    }

    control->torque_shortfall_q24 = 0;
    if (limited) {
        const bool positive = torque_q24 >= 0;
        shortfall_q24 = redistribute_torque(tables, plan, sample, positive, false, shortfall_q24);
        shortfall_q24 = redistribute_torque(tables, plan, sample, !positive, true, shortfall_q24);
        control->torque_shortfall_q24 = fixed_abs(shortfall_q24) > SHORTFALL_TOLERANCE_Q24 ? shortfall_q24 : 0;
    }
    set_duties(parameters, control, sample, phases, flux_step_max_q29, plan, duty_q15);
}
