#include "control/predictive_torque.h"

#include "fixed/fixed.h"

#define HALF_PITCH 0x80000000u
#define ONE_Q15 32768
#define ONE_Q30 (1 << 30)

/* 0.25 Wb: 512 V for half a millisecond. */
#define REACH_MAX_Q29 (1 << 27)

/* Missing torque that moves the windows: 0.05 N m and a 64th of the reference. Less is rounding. */
#define MISSING_LEAST_Q24 ((1 << 24) / 20)

/* Torque that is not missing: a point's is that of its flux linkage within 2 mN m, and several points may be asked for
 * a period. 1/64 N m. */
#define NOT_MISSING_Q24 (1 << 18)

/* A phase two periods ahead. */
typedef struct {
    uint32_t angle;           /* in the half of positive torque */
    bool positive;            /* in that half itself, not its mirror image */
    uint32_t since_on;        /* angle past turn-on; beyond 2^31: before it */
    int32_t freewheeling_q29; /* flux linkage that a period without voltage leaves */
    phase_map_range_t range;  /* from what a period of -Vdc leaves to what one of +Vdc brings, or less */
    phase_map_point_t point;  /* that it is to reach, torque by magnitude */
} plan_t;

/* Takes the point for a torque, as far as current limit and voltage allow; true when that is not all the way. */
static bool aim(const machine_tables_t *tables, plan_t *plan, int32_t torque_q24) {
    phase_map_point_t *point = &plan->point;
    if (torque_q24 <= 0 && plan->range.lowest_q29 == 0) {
        point->flux_q29 = 0;
        point->torque_q24 = 0;
        return false;
    }
    return !phase_map_reach(tables, plan->angle, torque_q24, &plan->range, point);
}

/* Phases of one half, those first that entered it last. Returns how many. */
static unsigned by_entry(const plan_t *plan, unsigned phases, bool positive, bool backwards,
                         unsigned order[HAL_PHASES_MAX]) {
    unsigned count = 0;
    for (unsigned phase = 0; phase < phases; phase++) {
        if (plan[phase].positive != positive || plan[phase].since_on >= HALF_PITCH) {
            continue;
        }
        /* In the positive half a phase that turns forwards enters at turn-on, in the other one at turn-off. */
        unsigned place = count++;
        while (place > 0 && (plan[phase].since_on < plan[order[place - 1]].since_on) == (positive != backwards)) {
            order[place] = order[place - 1];
            place--;
        }
        order[place] = phase;
    }
    return count;
}

/* Gives `missing` torque (signed) to the phases of one half; what is left. The opposed half only lets go. */
static int32_t hand_over(const machine_tables_t *tables, plan_t *plan, const predictive_torque_sample_t *sample,
                         bool positive, bool only_less, int32_t missing_q24) {
    const bool more = (missing_q24 > 0) == positive;
    if (missing_q24 == 0 || (more && only_less)) {
        return missing_q24;
    }
    unsigned order[HAL_PHASES_MAX];
    const unsigned count = by_entry(plan, tables->phases, positive, sample->backwards, order);
    for (unsigned n = 0; n < count && missing_q24 != 0; n++) {
        plan_t *p = &plan[order[more ? n : count - 1 - n]];
        if (p->point.flux_q29 == (more ? p->range.highest_q29 : p->range.lowest_q29)) {
            continue; /* at the end of its reach */
        }
        const int32_t before_q24 = p->point.torque_q24;
        const int32_t change_q24 = positive ? missing_q24 : fixed_subtract(0, missing_q24);
        (void)aim(tables, p, fixed_add(before_q24, change_q24));
        const int32_t given_q24 = fixed_subtract(p->point.torque_q24, before_q24);
        missing_q24 = positive ? fixed_subtract(missing_q24, given_q24) : fixed_add(missing_q24, given_q24);
    }
    return missing_q24;
}

static void move_windows(const predictive_torque_parameters_t *parameters, predictive_torque_t *control,
                         int32_t torque_q24) {
    const bool runs_out = fixed_abs(control->missing_q24) > MISSING_LEAST_Q24 + fixed_abs(torque_q24) / 64;
    const int32_t step_q30 = runs_out ? parameters->advance_q30 : -parameters->return_q30;
    control->advance_q30 = fixed_clamp(control->advance_q30 + step_q30, 0, ONE_Q30);
}

static int32_t not_below_none(int32_t flux_q29) {
    return flux_q29 > 0 ? flux_q29 : 0;
}

/* torque >= 0 times share 0..32768; to the last two bits, and all of it to the bit. */
static int32_t share_of(int32_t torque_q24, int32_t share_q15) {
    return share_q15 == ONE_Q15 ? torque_q24 : 4 * fixed_multiply_high(torque_q24, share_q15 << 15);
}

/* What -Vdc takes away on the way to an angle, `turn` a period; 2^-32 pitch. Wb, Q2.29, saturated. */
static int32_t removable_flux_q29(int32_t reach_q29, uint32_t way, uint32_t turn) {
    const uint32_t periods_q8 = way / ((turn >> 8) + 1);
    return fixed_saturate(fixed_shift((int64_t)reach_q29 * periods_q8, 8));
}

void predictive_torque_reset(predictive_torque_t *control) {
    *control = (predictive_torque_t){.advance_q30 = 0};
}

void predictive_torque_step(const predictive_torque_parameters_t *parameters, predictive_torque_t *control,
                            const machine_tables_t *tables, const predictive_torque_sample_t *sample,
                            int32_t duty_q15[HAL_PHASES_MAX]) {
    const unsigned phases = tables->phases;
    /* Q6 * Q40 to Q29; at least 64, so that the division below is defined without a bus. */
    const int32_t reach_q29 =
        fixed_clamp(fixed_multiply_high(sample->bus_voltage_q6 << 15, parameters->period_q40), 64, REACH_MAX_Q29);

    const int32_t torque_q24 = sample->torque_q24;
    const int32_t opposed_q24 = fixed_clamp(parameters->reserve_q24 - fixed_abs(torque_q24), 0, INT32_MAX);
    const int32_t forwards_q24 = fixed_add(torque_q24 > 0 ? torque_q24 : 0, opposed_q24);
    const int32_t backwards_q24 = fixed_add(torque_q24 < 0 ? fixed_abs(torque_q24) : 0, opposed_q24);

    move_windows(parameters, control, torque_q24);
    const int32_t advance_q15 = control->advance_q30 >> 15;
    const torque_share_window_t *late = &parameters->late;
    const torque_share_window_t advanced =
        advance_q15 > 0 ? torque_share_window(&parameters->share, advance_q15) : *late;

    plan_t plan[HAL_PHASES_MAX];
    int32_t missing_q24 = torque_q24;
    bool limited = false;
    for (unsigned phase = 0; phase < phases; phase++) {
        plan_t *p = &plan[phase];
        int32_t *flux_q29 = &control->flux_q29[phase];
        /* Q15 * Q29 to Q29. */
        const int32_t applied_q29 = fixed_multiply_high(control->duty_q15[phase] * (1 << 14), reach_q29 << 3);
        const int32_t drop_q29 = flux_observer_step(&parameters->flux, flux_q29, sample->flux_q29[phase], applied_q29,
                                                    sample->current_q9[phase]);
        p->freewheeling_q29 = fixed_subtract(*flux_q29, drop_q29);
        p->range = (phase_map_range_t){
            .lowest_q29 = not_below_none(fixed_subtract(p->freewheeling_q29, reach_q29)),
            .highest_q29 = not_below_none(fixed_add(p->freewheeling_q29, reach_q29)),
            .current_limit_q9 = parameters->current_limit_q9,
        };
        const uint32_t angle = sample->angle[phase];
        p->positive = angle >= HALF_PITCH;
        p->angle = p->positive ? angle : ~angle; /* as far from aligned as that, to a unit */
        p->point.column = control->column[phase];
        const bool brakes = p->positive == sample->backwards; /* it is on its way to unaligned */
        /* Windows move ahead of the rotation: not those of a phase that brakes. */
        const torque_share_window_t *window = brakes ? late : &advanced;
        p->since_on = p->angle - window->turn_on;
        const int32_t half_q24 = p->positive ? forwards_q24 : backwards_q24;
        int32_t wanted_q24 = 0;
        if (half_q24 > 0) {
            wanted_q24 = share_of(half_q24, torque_share_q15(window, p->angle));
        }
        if (brakes && p->range.highest_q29 > p->range.lowest_q29) {
            const int32_t removable_q29 = removable_flux_q29(reach_q29, p->angle - HALF_PITCH, sample->turn);
            p->range.highest_q29 = fixed_clamp(removable_q29, p->range.lowest_q29, p->range.highest_q29);
        }
        limited |= aim(tables, p, wanted_q24);
        const int32_t made_q24 = p->point.torque_q24;
        missing_q24 = p->positive ? fixed_subtract(missing_q24, made_q24) : fixed_add(missing_q24, made_q24);
    }

    control->missing_q24 = 0;
    if (limited) {
        const bool positive = torque_q24 >= 0;
        missing_q24 = hand_over(tables, plan, sample, positive, false, missing_q24);
        missing_q24 = hand_over(tables, plan, sample, !positive, true, missing_q24);
        control->missing_q24 = fixed_abs(missing_q24) > NOT_MISSING_Q24 ? missing_q24 : 0;
    }

    /* A quotient in Q15 of two numbers of 32 bits: the reach becomes 2^14..2^15, the rise has 15 bits more. */
    const int shift = __builtin_clz((uint32_t)reach_q29) - 2;
    const int32_t per_reach = (reach_q29 << shift) >> 15;
    for (unsigned phase = 0; phase < phases; phase++) {
        const plan_t *p = &plan[phase];
        const int32_t rise_q29 = p->point.flux_q29 - p->freewheeling_q29; /* within the reach */
        const int32_t duty = rise_q29 * (1 << shift) / per_reach;
        /* A phase that is to have no flux linkage has both switches open, one above its current limit gets no voltage.
         */
        const int32_t highest = sample->current_q9[phase] > parameters->current_limit_q9 ? 0 : ONE_Q15;
        duty_q15[phase] = p->point.flux_q29 > 0 ? fixed_clamp(duty, -ONE_Q15, highest) : -ONE_Q15;
        control->duty_q15[phase] = duty_q15[phase];
        control->column[phase] = (uint8_t)p->point.column;
    }
}
