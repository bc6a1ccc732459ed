#include "control/predictive_torque.h"

#include "fixed/fixed.h"

#define HALF_PITCH 0x80000000u
#define ONE_Q15 32768
#define ONE_Q30 (1 << 30)

/* Missing torque that moves the windows: 0.05 N m and a 64th of the reference. Less is rounding. */
#define MISSING_LEAST_Q24 ((1 << 24) / 20)

/* A phase two periods ahead. */
typedef struct {
    phase_map_place_t place; /* in the half of positive torque */
    bool positive;           /* in that half itself, not its mirror image */
    uint32_t since_on;       /* angle past turn-on; beyond 2^31: before it */
    int32_t torque_q24;      /* that it will make, magnitude */
    int32_t flux_q29;        /* that it is to have */
    int32_t lowest_q29;      /* that a period of -Vdc leaves */
    int32_t highest_q29;     /* that a period of +Vdc brings */
    bool held;               /* flux_q29 is one of the two, torque_q24 what it makes */
} plan_t;

/* Takes the flux linkage for a torque, as far as current limit and voltage allow; true when that is not all the way. */
static bool aim(const predictive_torque_parameters_t *parameters, plan_t *plan, int32_t torque_q24) {
    int32_t current_q9 = 0;
    int32_t flux_q29 = 0;
    bool limited = false;
    if (torque_q24 > 0) {
        current_q9 = phase_map_current_of_torque_q9(&plan->place, torque_q24);
        limited = current_q9 > parameters->current_limit_q9;
        current_q9 = limited ? parameters->current_limit_q9 : current_q9;
        flux_q29 = phase_map_flux_q29(&plan->place, current_q9);
    }
    const int32_t held_q29 = fixed_clamp(flux_q29, plan->lowest_q29, plan->highest_q29);
    const bool held = held_q29 != flux_q29;
    if (held && plan->held && held_q29 == plan->flux_q29) {
        return true; /* at the same end of its reach as before: so is its torque */
    }
    plan->held = held;
    plan->flux_q29 = held_q29;
    if (held) {
        limited = true;
        current_q9 = phase_map_current_of_flux_q9(&plan->place, plan->flux_q29);
    }
    plan->torque_q24 = limited ? phase_map_torque_q24(&plan->place, current_q9) : fixed_clamp(torque_q24, 0, INT32_MAX);
    return limited;
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
static int32_t hand_over(const predictive_torque_parameters_t *parameters, plan_t *plan, unsigned phases,
                         const predictive_torque_sample_t *sample, bool positive, bool only_less, int32_t missing_q24) {
    unsigned order[HAL_PHASES_MAX];
    const unsigned count = by_entry(plan, phases, positive, sample->backwards, order);
    const bool more = (missing_q24 > 0) == positive;
    if (more && only_less) {
        return missing_q24;
    }
    for (unsigned n = 0; n < count && missing_q24 != 0; n++) {
        plan_t *p = &plan[order[more ? n : count - 1 - n]];
        const int32_t before_q24 = p->torque_q24;
        const int32_t change_q24 = positive ? missing_q24 : fixed_subtract(0, missing_q24);
        (void)aim(parameters, p, fixed_add(before_q24, change_q24));
        const int32_t given_q24 = fixed_subtract(p->torque_q24, before_q24);
        missing_q24 = positive ? fixed_subtract(missing_q24, given_q24) : fixed_add(missing_q24, given_q24);
    }
    return missing_q24;
}

static int32_t made_q24(const plan_t *plan, unsigned phases) {
    int32_t sum_q24 = 0;
    for (unsigned phase = 0; phase < phases; phase++) {
        const int32_t torque_q24 = plan[phase].torque_q24;
        sum_q24 = plan[phase].positive ? fixed_add(sum_q24, torque_q24) : fixed_subtract(sum_q24, torque_q24);
    }
    return sum_q24;
}

static void move_windows(const predictive_torque_parameters_t *parameters, predictive_torque_t *control,
                         int32_t torque_q24) {
    const bool runs_out = fixed_abs(control->missing_q24) > MISSING_LEAST_Q24 + fixed_abs(torque_q24) / 64;
    const int32_t step_q30 = runs_out ? parameters->advance_q30 : -parameters->return_q30;
    control->advance_q30 = fixed_clamp(control->advance_q30 + step_q30, 0, ONE_Q30);
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
        fixed_clamp(fixed_multiply(sample->bus_voltage_q6, parameters->period_q40, 17), 64, INT32_MAX);
    const uint32_t per_reach_q31 = 0x80000000u / ((uint32_t)reach_q29 >> 6);

    const int32_t torque_q24 = sample->torque_q24;
    const int32_t opposed_q24 = fixed_clamp(parameters->reserve_q24 - fixed_abs(torque_q24), 0, INT32_MAX);
    const int32_t forwards_q24 = fixed_add(torque_q24 > 0 ? torque_q24 : 0, opposed_q24);
    const int32_t backwards_q24 = fixed_add(torque_q24 < 0 ? fixed_abs(torque_q24) : 0, opposed_q24);

    move_windows(parameters, control, torque_q24);
    const torque_share_window_t late = torque_share_window(&parameters->share, 0);
    const int32_t advance_q15 = control->advance_q30 >> 15;
    const torque_share_window_t early = advance_q15 > 0 ? torque_share_window(&parameters->share, advance_q15) : late;

    plan_t plan[HAL_PHASES_MAX];
    int32_t drop_q29[HAL_PHASES_MAX];
    bool limited = false;
    for (unsigned phase = 0; phase < phases; phase++) {
        plan_t *p = &plan[phase];
        int32_t *flux_q29 = &control->flux_q29[phase];
        const int32_t applied_q29 = fixed_multiply(control->duty_q15[phase], reach_q29, 15);
        drop_q29[phase] = flux_observer_step(&parameters->flux, flux_q29, sample->flux_q29[phase], applied_q29,
                                             sample->current_q9[phase]);
        const int32_t freewheeling_q29 = fixed_subtract(*flux_q29, drop_q29[phase]);
        p->lowest_q29 = fixed_clamp(fixed_subtract(freewheeling_q29, reach_q29), 0, INT32_MAX);
        p->highest_q29 = fixed_clamp(fixed_add(freewheeling_q29, reach_q29), 0, INT32_MAX);

        const uint32_t angle = sample->angle[phase];
        p->held = false;
        p->positive = angle >= HALF_PITCH;
        const uint32_t forward_angle = p->positive ? angle : 0u - angle;
        p->place = phase_map_at(tables, forward_angle);
        if (p->positive == sample->backwards) { /* it brakes, on its way to unaligned */
            const int32_t removable_q29 = removable_flux_q29(reach_q29, forward_angle - HALF_PITCH, sample->turn);
            p->highest_q29 = fixed_clamp(p->highest_q29, p->lowest_q29,
                                         removable_q29 > p->lowest_q29 ? removable_q29 : p->lowest_q29);
        }
        /* Windows move ahead of the rotation: not those of a phase that brakes. */
        const torque_share_window_t *window = p->positive != sample->backwards ? &early : &late;
        p->since_on = forward_angle - window->turn_on;
        const int32_t share_q15 = torque_share_q15(window, forward_angle);
        const int32_t wanted_q24 = fixed_multiply(p->positive ? forwards_q24 : backwards_q24, share_q15, 15);
        limited |= aim(parameters, p, wanted_q24);
    }

    control->missing_q24 = 0;
    if (limited) {
        const bool positive = torque_q24 >= 0;
        int32_t missing_q24 = fixed_subtract(torque_q24, made_q24(plan, phases));
        missing_q24 = hand_over(parameters, plan, phases, sample, positive, false, missing_q24);
        control->missing_q24 = hand_over(parameters, plan, phases, sample, !positive, true, missing_q24);
    }

    for (unsigned phase = 0; phase < phases; phase++) {
        const int32_t rise_q29 =
            fixed_add(fixed_subtract(plan[phase].flux_q29, control->flux_q29[phase]), drop_q29[phase]);
        /* Q29 / (Q29 / 64) in Q31, to Q15. A phase that is to have no flux linkage has both switches open, one
         * above its current limit gets no voltage. */
        const int32_t duty = fixed_saturate(fixed_shift((int64_t)rise_q29 * per_reach_q31, 22));
        const int32_t highest = sample->current_q9[phase] > parameters->current_limit_q9 ? 0 : ONE_Q15;
        duty_q15[phase] = plan[phase].flux_q29 > 0 ? fixed_clamp(duty, -ONE_Q15, highest) : -ONE_Q15;
        control->duty_q15[phase] = duty_q15[phase];
    }
}
