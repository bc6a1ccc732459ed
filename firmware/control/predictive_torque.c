#include "control/predictive_torque.h"

#include <stddef.h>

#include "control/phase_cell.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "fixed/formats.h"

/* 0.25 Wb: 512 V for half a millisecond. */
#define FLUX_STEP_LIMIT_Q29 (1 << 27)

/* Twice the largest unit of the tables, so that the division in duty_of() is defined without a DC link: 0.6 V at 40
 * kHz. */
#define FLUX_STEP_MIN_Q29 (1 << 13)

/* Torque shortfall below which none is reported: 1/64 N m. Torque and flux linkage of an operating point agree within a
 * few mN m. */
#define SHORTFALL_TOLERANCE_Q24 (1 << 18)

/* Duty in Q1.15, -1..1 - 2^-15, which the modulator rounds to 1. */
#define DUTY_BITS 16

/* Position from which a phase without flux linkage starts, in columns, Q13: its cell is then usable from 0 to 3.5
 * columns. */
#define START_Q13 (1 << 13)

/* A column in Q4. */
#define COLUMN_Q4 16

/* Plan of a phase for the sample two periods ahead. Torque, by magnitude, and flux linkages in units of the tables. */
typedef struct {
    phase_cell_t *cell;
    int32_t column;           /* of the cell */
    int32_t v_q13;            /* of the planned point in the cell */
    int32_t flux;             /* planned */
    int32_t torque;           /* planned */
    int32_t flux_min;         /* flux linkage that a period of -Vdc leaves */
    int32_t flux_max;         /* that a period of +Vdc reaches, or less */
    int32_t freewheeling_q29; /* flux linkage after a period without voltage, Wb */
    uint32_t angle;           /* 2^-32 electrical rev, mirrored into the half of positive torque */
    uint32_t since_on; /* angle past turn-on, 2^-32 electrical rev; from 2^31: before turn-on; UINT32_MAX: ended */
    int32_t limit;     /* -1: at flux_min, 1: at flux_max or at the current limit, 0: torque reached */
} plan_t;

/* Operating point within the cell, or at its end, for a torque within flux_min, flux_max and the current limit, by
 * descending priority; true when it has the torque. */
static inline bool solve_in_cell(plan_t *p, int32_t torque, int32_t current_limit_q9) {
    const phase_cell_t *cell = p->cell;
    int32_t flux = p->flux_min; /* for a torque of 0, also where no current makes torque */
    int32_t limit = -1;
    if (torque > 0) {
        const int32_t limit_q13 = phase_cell_u_q13(cell, current_limit_q9);
        int32_t v_q13 = phase_cell_solve_q13(cell, torque);
        const bool outside = (v_q13 ^ v_q13 >> 31) == PHASE_CELL_V_MAX_Q13;
        limit = 0;
        if (v_q13 > limit_q13) {
            v_q13 = limit_q13;
            limit = 1;
        }
        flux = phase_cell_flux(cell, v_q13);
        if (flux >= p->flux_max) {
            flux = p->flux_max;
            limit = 1;
        }
        if (flux <= p->flux_min) {
            flux = p->flux_min;
            limit = -1;
        }
        if (limit == 0 && !outside) {
            p->v_q13 = v_q13;
            p->flux = flux;
            p->torque = torque;
            p->limit = 0;
            return true;
        }
    }
    p->v_q13 = phase_cell_v_q13(cell, flux);
    p->flux = flux;
    p->torque = phase_cell_torque(cell, p->v_q13);
    p->limit = limit;
    return false;
}

NOINLINE static void locate_cell(const machine_tables_t *tables, uint32_t angle, int32_t column, phase_cell_t *cell) {
    phase_cell_locate(tables, angle - HALF_REV, column, cell);
}

/* Plans the operating point of a phase for a torque in units of the tables, in the cell of its last plan; true when the
 * point has the torque. */
static inline bool plan_torque(const machine_tables_t *tables, plan_t *p, int32_t torque, int32_t current_limit_q9) {
    if (torque <= 0 && p->flux_min == 0) {
        p->cell->located = false;
        p->v_q13 = 0;
        p->flux = 0;
        p->torque = 0;
        p->limit = -1;
        return true;
    }
    locate_cell(tables, p->angle, p->column, p->cell);
    return solve_in_cell(p, torque, current_limit_q9);
}

/* Column in which the operating point for a torque > 0 is expected, by straight lines. */
static inline int32_t expected_column(const plan_t *p, int32_t torque, int32_t current_limit_q9) {
    const phase_cell_t *cell = p->cell;
    const int32_t distance_q4 =
        fixed_clamp(phase_cell_distance_q4(&cell->torque, torque), phase_cell_distance_q4(&cell->flux, p->flux_min),
                    phase_cell_distance_q4(&cell->flux, p->flux_max));
    const int32_t limit_column = current_limit_q9 >> MACHINE_COLUMN_BITS;
    const int32_t column = fixed_add(p->column, fixed_add(distance_q4, COLUMN_Q4 / 2) >> 4);
    return fixed_clamp(column, 0, fixed_min(limit_column, PHASE_CELL_COLUMN_MAX));
}

/* Plans a phase again, in another cell if that is where the point is expected. */
NOINLINE static void replan_torque(const machine_tables_t *tables, plan_t *p, int32_t torque,
                                   int32_t current_limit_q9) {
    if (!p->cell->located) {
        locate_cell(tables, p->angle, p->column, p->cell);
    }
    const int32_t column = expected_column(p, torque, current_limit_q9);
    if (column != p->column) {
        p->column = column;
        locate_cell(tables, p->angle, column, p->cell);
    }
    (void)solve_in_cell(p, torque, current_limit_q9);
}

/* Corrects one phase by the torque shortfall (signed) where it can change in that direction; returns the rest. Of the
 * half that carries the reference: a shortfall goes to the phase that entered last, of motoring phases after them to
 * one before its turn-on where the window is torque sharing's, an excess is taken from the one that entered
 * first. Without such a phase an opposed one may reduce its torque. */
static inline int32_t correct_torque(const machine_tables_t *tables, plan_t *plan, bool positive, bool reverse,
                                     int32_t current_limit_q9, int32_t shortfall) {
    const bool increase = (shortfall > 0) == positive;
    const int8_t sign = positive ? 1 : -1;
    const int32_t limit = increase ? 1 : -1;
    /* In forward rotation a phase enters the positive half at turn-on, the other half at turn-off. The order of entry
     * is the order of since_on or the reverse; phases before turn-on are last, or, in the reverse order, none. */
    const uint32_t reversal = ((positive != reverse) == increase) ? 0 : HALF_REV - 1;
    plan_t *corrected = NULL;
    plan_t *opposed = NULL;
    uint32_t first = ~reversal;
    const unsigned phases = tables->phases;
    UNROLL(4)
    for (unsigned phase = 0; phase < phases; phase++) {
        plan_t *p = &plan[phase];
        const uint32_t order = p->since_on ^ reversal;
        if (p->cell->sign != sign) {
            opposed = p->limit >= 0 && p->torque > 0 ? p : opposed;
        } else if (order < first && p->limit != limit) {
            first = order;
            corrected = p;
        }
    }
    if (corrected == NULL) {
        if (opposed == NULL || !increase) {
            return shortfall;
        }
        corrected = opposed;
    }
    const int32_t before = corrected->torque;
    const bool adds = corrected->cell->sign > 0;
    replan_torque(tables, corrected, adds ? fixed_add(before, shortfall) : fixed_subtract(before, shortfall),
                  current_limit_q9);
    const int32_t gained = corrected->torque - before;
    return adds ? fixed_subtract(shortfall, gained) : fixed_add(shortfall, gained);
}

/* True if the magnitude of a value exceeds a tolerance: in one comparison. */
static bool beyond(int32_t value, int32_t tolerance) {
    return (uint32_t)value + (uint32_t)tolerance > 2 * (uint32_t)tolerance;
}

/* torque * share, torque >= 0, share 0..1 in Q1.15: rounded to 4 LSB, exact for a share of 1. */
static int32_t share_of(int32_t torque_q24, int32_t share_q15) {
    return share_q15 == ONE_Q15 ? torque_q24 : 4 * fixed_multiply_high(torque_q24, share_q15 << 15);
}

/* Values that all phases have in common. */
typedef struct {
    uint32_t flux_step_max;  /* that a period of Vdc adds or removes, in units of the tables */
    uint32_t angle_step_q24; /* rotation per period, 2^-24 electrical rev, rounded up */
} period_t;

/* Flux linkage that -Vdc removes until `travel` is covered, 2^-32 electrical rev; in units of the tables, saturated. */
static inline int32_t removable_flux(const period_t *period, uint32_t travel) {
    const uint32_t periods_q8 = travel / period->angle_step_q24;
    const uint64_t flux_q8 = (uint64_t)period->flux_step_max * periods_q8;
    return flux_q8 >> 39 != 0 ? INT32_MAX : (int32_t)(flux_q8 >> 8);
}

/* Predicts the flux linkage of a phase and which flux linkages the coming period can reach from there. */
static inline void predict_flux(predictive_torque_t *control, const predictive_torque_sample_t *sample, unsigned phase,
                                int32_t flux_step_max_q29, unsigned flux_shift, plan_t *p) {
    int32_t *flux_q29 = &control->flux_q29[phase];
    /* Q15 * Q29 to Q29. */
    const int32_t applied_q29 = fixed_multiply_high(control->duty_q15[phase] * (1 << 14), flux_step_max_q29 << 3);
    const int32_t resistive_drop_q29 =
        flux_observer_step(sample->flux_observer, flux_q29, (int32_t)((uint32_t)sample->flux[phase] << flux_shift),
                           applied_q29, sample->current_q9[phase]);
    p->freewheeling_q29 = fixed_subtract(*flux_q29, resistive_drop_q29);
    p->flux_min = fixed_non_negative(fixed_subtract(p->freewheeling_q29, flux_step_max_q29)) >> flux_shift;
    p->flux_max = fixed_non_negative(fixed_add(p->freewheeling_q29, flux_step_max_q29)) >> flux_shift;
}

/* Flux linkage that is built up at full voltage for the half that follows, up to the current limit. built: what Vdc has
 * added since turn-on. */
static inline void plan_lead(const machine_tables_t *tables, plan_t *p, int32_t built, int32_t current_limit_q9) {
    locate_cell(tables, p->angle, p->column, p->cell);
    const int32_t limit = phase_cell_flux(p->cell, phase_cell_u_q13(p->cell, current_limit_q9));
    p->flux = fixed_clamp(built, p->flux_min, p->flux_max < limit ? p->flux_max : limit);
    p->v_q13 = phase_cell_v_q13(p->cell, p->flux);
    p->torque = phase_cell_torque(p->cell, p->v_q13);
    p->limit = -1; /* none of it is to be taken away */
}

/* Operating point of a phase two periods ahead; true when it has the torque of the phase. torque: of its half, to
 * share, by magnitude. outgoing: it moves towards the unaligned position. */
static inline bool plan_phase(const predictive_torque_parameters_t *parameters, const machine_tables_t *tables,
                              const period_t *period, const conduction_half_t *half, int32_t torque, bool outgoing,
                              plan_t *p) {
    const uint32_t since_on = p->angle - half->window.turn_on;
    p->since_on = since_on < half->width ? since_on : UINT32_MAX;
    const uint32_t remaining = outgoing ? p->angle - HALF_REV : ~p->angle; /* until it leaves the half */
    if (remaining < half->lead) {
        plan_lead(tables, p, removable_flux(period, half->lead - remaining), parameters->current_limit_q9);
        return false;
    }
    if (p->angle > half->end && p->flux_max > p->flux_min) {
        const int32_t flux = fixed_add(removable_flux(period, p->angle - half->end), half->flux);
        p->flux_max = fixed_clamp(flux, p->flux_min, p->flux_max);
    }
    return plan_torque(tables, p, torque > 0 ? share_of(torque, torque_sharing_q15(&half->window, p->angle)) : 0,
                       parameters->current_limit_q9);
}

/* Voltage of a period as divisor of flux linkages in Wb, Q2.29: normalised for a quotient of 15 bits. */
typedef struct {
    int shift;       /* of the dividend, which has 15 fraction bits more then */
    int32_t divisor; /* 2^14..2^15 */
} duty_divisor_t;

static inline duty_divisor_t duty_divisor(int32_t flux_step_max_q29) {
    const int shift = __builtin_clz((uint32_t)flux_step_max_q29) - 2;
    return (duty_divisor_t){shift, (flux_step_max_q29 << shift) >> 15};
}

/* Duty of a phase for its planned flux linkage, Q1.15. */
static inline int32_t duty_of(const plan_t *p, duty_divisor_t by, unsigned flux_shift, bool above_current_limit) {
    if (p->flux <= 0) {
        return -ONE_Q15; /* both switches off */
    }
    /* Within +-flux_step_max and the truncation to the unit of the tables. */
    const int32_t flux_step_q29 = p->flux * (1 << flux_shift) - p->freewheeling_q29;
    const int32_t duty = fixed_saturate_bits(flux_step_q29 * (1 << by.shift) / by.divisor, DUTY_BITS);
    return above_current_limit && duty > 0 ? 0 : duty; /* no positive voltage */
}

/* Column in which the next plan begins: the current changes as from the last plan to this one. Within 2 (40 + 4) + 4
 * columns of either sign, and limited to the columns of the tables where it is used. */
static inline void extrapolate_column(predictive_torque_t *control, unsigned phase, const plan_t *p) {
    const int32_t position_q13 = p->flux > 0 ? p->column * (1 << 13) + p->v_q13 + PHASE_CELL_HALF_Q13 : START_Q13;
    control->column[phase] = (int8_t)((2 * position_q13 - control->position_q13[phase]) >> 13);
    control->position_q13[phase] = position_q13;
}

/* Takes a phase out of the plan, and of the phases to correct; returns the shortfall with its torque. */
static inline int32_t drop_plan(plan_t *p, int32_t shortfall) {
    const int32_t torque = p->cell->sign * p->torque;
    p->cell->located = false;
    p->v_q13 = 0;
    p->flux = 0;
    p->torque = 0;
    p->since_on = UINT32_MAX;
    return fixed_add(shortfall, torque);
}

/* Not in its caller, whose prologue shared a block with it on RV32: the computed bounds of the laws without predictive
 * control then had the 1,000 instructions of clearing its state. */
NOINLINE void predictive_torque_reset(predictive_torque_t *control) {
    *control = (predictive_torque_t){.torque_shortfall_q24 = 0};
}

void predictive_torque_step(const predictive_torque_parameters_t *parameters, predictive_torque_t *control,
                            const machine_tables_t *tables, const predictive_torque_sample_t *sample,
                            int32_t duty_q15[HAL_PHASES_MAX]) {
    /* At most HAL_PHASES_MAX; the compiler needs to see it where it unrolls loops without knowing the tables. */
    const unsigned phases = tables->phases < HAL_PHASES_MAX ? tables->phases : HAL_PHASES_MAX;
    /* Vdc Ts: Q6 * Q40 to Q29. */
    const int32_t flux_step_max_q29 = fixed_clamp(fixed_multiply_high(sample->bus_voltage_q6 << 15, sample->period_q40),
                                                  FLUX_STEP_MIN_Q29, FLUX_STEP_LIMIT_Q29);

    const unsigned torque_shift = tables->torque_format.result_shift;
    const unsigned flux_shift = tables->flux_format.result_shift;
    const int32_t torque_q24 = sample->torque_q24;
    const int32_t opposed_q24 = fixed_clamp(parameters->reserve_q24 - fixed_abs(torque_q24), 0, INT32_MAX);
    const int32_t positive_half_q24 = fixed_add(fixed_max(torque_q24, 0), opposed_q24);
    const int32_t negative_half_q24 = fixed_add(torque_q24 < 0 ? fixed_abs(torque_q24) : 0, opposed_q24);

    const int32_t torque[2] = {negative_half_q24 >> torque_shift, positive_half_q24 >> torque_shift};
    const period_t period = {(uint32_t)flux_step_max_q29 >> flux_shift, (sample->angle_step >> 8) + 1};

    plan_t plan[HAL_PHASES_MAX];
    const unsigned turn = control->turn & 1u;
    phase_cell_t *cells = control->cell[turn]; /* the cells of this sample have served */
    control->turn = turn ^ 1u;
    int32_t shortfall = torque_q24 >> torque_shift;
    bool reached = true;
    UNROLL(4)
    for (unsigned phase = 0; phase < phases; phase++) {
        plan_t *p = &plan[phase];
        predict_flux(control, sample, phase, flux_step_max_q29, flux_shift, p);
        const uint32_t angle = sample->angle - phase * parameters->stroke - (uint32_t)sample->misalignment[phase];
        const bool positive = angle >= HALF_REV;
        p->angle = positive ? angle : ~angle; /* mirrored, to 1 LSB */
        p->column = fixed_clamp(control->column[phase], 0, parameters->column_max);
        p->cell = &cells[phase];
        p->cell->sign = (int8_t)(2 * (int)positive - 1);
        const bool outgoing = positive == sample->reverse;
        const conduction_half_t *half = &sample->conduction->half[outgoing];
        IN_REGISTER(half);
        reached &= plan_phase(parameters, tables, &period, half, torque[positive], outgoing, p);
        shortfall = fixed_subtract(shortfall, p->cell->sign * p->torque);
    }

    const uint32_t lost = sample->lost_phase - 1u; /* UINT32_MAX: none */
    if (!LIKELY(lost >= phases)) {
        shortfall = drop_plan(&plan[lost], shortfall);
        reached = false;
    }
    control->torque_shortfall_q24 = 0;
    /* The share of a phase that is not yet in its half is missing. */
    const int32_t tolerance = SHORTFALL_TOLERANCE_Q24 >> torque_shift;
    if (!reached || beyond(shortfall, tolerance)) {
        shortfall =
            correct_torque(tables, plan, torque_q24 >= 0, sample->reverse, parameters->current_limit_q9, shortfall);
        const int32_t shortfall_q24 = phase_map_scale(&tables->torque_format, shortfall);
        control->torque_shortfall_q24 = beyond(shortfall_q24, SHORTFALL_TOLERANCE_Q24) ? shortfall_q24 : 0;
    }
    const duty_divisor_t by = duty_divisor(flux_step_max_q29);
    UNROLL(4)
    for (unsigned phase = 0; phase < phases; phase++) {
        const bool above_current_limit = sample->current_q9[phase] > parameters->current_max_q9;
        duty_q15[phase] = duty_of(&plan[phase], by, flux_shift, above_current_limit);
        control->duty_q15[phase] = duty_q15[phase];
        extrapolate_column(control, phase, &plan[phase]);
    }
}
