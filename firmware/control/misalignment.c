#include "control/misalignment.h"

#include "control/phase_map.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"

/* 0.01 rad in 2^-32 turn. */
#define PROBE 6835653

#define MEAN_1_S 10
#define SHARE_MAX_Q16 65535 /* below one */
#define SETTLE_MS 150
#define TORQUE_LEAST_Q24 (1 << 24)
/* 0.05 * 0.02^2, of T^2. */
#define POWER_FLOOR_Q20 21
#define OFFSET_LIMIT_Q40 (((int64_t)7 << 40) / 8)

misalignment_parameters_t misalignment_configure(int32_t rate_1_s, uint32_t bandwidth_rad_s, uint32_t control_rate_hz,
                                                 int32_t inertia_q30, unsigned phases, unsigned rotor_poles) {
    const int64_t turn_rate_hz = control_rate_hz / phases;
    return (misalignment_parameters_t){
        .probe = PROBE * rotor_poles,
        .rate_q30 = (int32_t)fixed_divide((int64_t)rate_1_s << 30, turn_rate_hz),
        .filter_q16 = fixed_clamp((int32_t)fixed_divide((int64_t)(bandwidth_rad_s * 8u / 5u) << 16, turn_rate_hz), 0,
                                  SHARE_MAX_Q16),
        .mean_q16 = (int32_t)fixed_divide((int64_t)MEAN_1_S << 16, turn_rate_hz) + 1,
        .inertia_rate_q8 = fixed_saturate(((int64_t)inertia_q30 * control_rate_hz) >> 22),
        .settle_ticks = control_rate_hz / 1000u * SETTLE_MS,
    };
}

void misalignment_reset(misalignment_t *misalignment) {
    *misalignment = (misalignment_t){.turn = 0};
}

/* value towards target by a share in Q16, below one. */
static inline void follow(int32_t *value, int32_t target, int32_t share_q16) {
    const int32_t half = fixed_multiply_high(fixed_subtract(target, *value), share_q16 << 15);
    *value = fixed_add(fixed_add(*value, half), half);
}

static int32_t product_q24(int32_t a_q24, int32_t b_q24) {
    return fixed_multiply(a_q24, b_q24, 24);
}

void misalignment_step(const misalignment_parameters_t *parameters, misalignment_t *misalignment,
                       const machine_tables_t *tables, const load_observer_t *observer,
                       const misalignment_sample_t *sample) {
    const bool steady = sample->steady && fixed_abs(sample->torque_q24) > TORQUE_LEAST_Q24;
    const int32_t disturbance_q24 = fixed_subtract(
        observer->load_torque_q24, fixed_multiply(observer->correction_q22, parameters->inertia_rate_q8, 6));
    const bool settled = misalignment->steady_ticks >= parameters->settle_ticks;
    misalignment->steady_ticks = !steady ? 0 : settled ? misalignment->steady_ticks : misalignment->steady_ticks + 1;
    const bool learns = steady && settled;
    /* Means of all since it became steady, then of the last 100 ms: what was before is another load. */
    const int32_t phases = (int32_t)tables->phases;
    const int32_t fresh_q16 = SHARE_MAX_Q16 / ((int32_t)misalignment->steady_ticks / phases + 1);
    const int32_t mean_q16 = fresh_q16 > parameters->mean_q16 ? fresh_q16 : parameters->mean_q16;

    const unsigned turn = misalignment->turn;
    misalignment->turn = turn + 1 < tables->phases ? turn + 1 : 0;
    misalignment_phase_t *phase = &misalignment->phase[turn];
    misalignment->sum_q24 += disturbance_q24;
    const int64_t since_q24 = phase->sum_q24;
    phase->sum_q24 = misalignment->sum_q24;
    const int32_t current_q9 = sample->current_q9[turn];
    const int32_t slope_q24 =
        current_q9 > 0 ? phase_map_torque_slope_q24(tables, sample->angle[turn], current_q9, 2 * parameters->probe) : 0;
    follow(&phase->first_q24, slope_q24, parameters->filter_q16);
    follow(&phase->second_q24, phase->first_q24, parameters->filter_q16);
    follow(&phase->mean_q24, phase->second_q24, mean_q16);
    const int32_t alternating_q24 = fixed_subtract(phase->second_q24, phase->mean_q24);
    /* Its turn comes once for all phases: their sum. */
    const int32_t square_q24 = product_q24(alternating_q24, alternating_q24);
    follow(&misalignment->power_q24, fixed_saturate((int64_t)square_q24 * phases), mean_q16 / phases + 1);
    follow(&misalignment->disturbance_mean_q24, disturbance_q24, mean_q16 / phases + 1);
    if (!learns) {
        return;
    }

    const int32_t torque_square_q24 = product_q24(sample->torque_q24, sample->torque_q24);
    const int32_t power_q24 =
        fixed_add(misalignment->power_q24, fixed_multiply(torque_square_q24, POWER_FLOOR_Q20, 20));
    /* All of y since the phase's last turn: of at most four periods, each within a word. */
    const int32_t mean_q24 = 4 * ((int32_t)((misalignment->sum_q24 - since_q24) >> 2) / phases);
    const int32_t error_q24 = fixed_subtract(mean_q24, misalignment->disturbance_mean_q24);
    /* Q24 * Q24 to Q30, by Q20: Q10. */
    const int32_t step_q10 = fixed_multiply(error_q24, alternating_q24, 18) / ((power_q24 >> 4) + 1);
    const int64_t offset_q40 = phase->offset_q40 + (int64_t)step_q10 * parameters->rate_q30;
    phase->offset_q40 = offset_q40 > OFFSET_LIMIT_Q40    ? OFFSET_LIMIT_Q40
                        : offset_q40 < -OFFSET_LIMIT_Q40 ? -OFFSET_LIMIT_Q40
                                                         : offset_q40;
    /* 0.02 rad are two probes. */
    phase->offset = fixed_multiply((int32_t)fixed_shift(phase->offset_q40, 10), (int32_t)parameters->probe, 29);
}
