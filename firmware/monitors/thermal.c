/* [SR-16] */
#include "monitors/thermal.h"

#include "fixed/compiler.h"
#include "fixed/divide.h"
#include "fixed/fixed.h"
#include "storage/fault.h"

#define US_PER_S INT64_C(1000000)
#define LOAD_MAX_Q24 (INT64_C(0x1000000) * THERMAL_SQUARE_MAX - 1)
#define SQUARE_MAX_Q16 ((uint64_t)THERMAL_SQUARE_MAX << 16)

COLD static thermal_model_t model(int32_t current_q9, int32_t time_constant_s) {
    const int64_t square_q18 = (int64_t)current_q9 * current_q9;
    return (thermal_model_t){
        .inverse_q48 = (uint32_t)fixed_divide(INT64_C(1) << 48, square_q18), /* at most 2^30, of 1 A */
        .rate_q48 = (uint32_t)fixed_divide(INT64_C(1) << 48, time_constant_s * US_PER_S),
    };
}

COLD thermal_parameters_t thermal_configure(const int32_t *values) {
    return (thermal_parameters_t){
        .winding = model(values[PARAMETER_WINDING_CURRENT_A], values[PARAMETER_WINDING_TIME_CONSTANT_S]),
        .switches = model(values[PARAMETER_SWITCH_CURRENT_A], THERMAL_SWITCH_TIME_CONSTANT_S),
        .torque_max_q24 = values[PARAMETER_TORQUE_MAX_NM],
    };
}

/* Loads in Q24, below 2^30, times at most 2^30. */
COLD static void keep_heat(const thermal_model_t *before, const thermal_model_t *now, int64_t *load_q56) {
    const bool differs = before->inverse_q48 != 0 && before->inverse_q48 != now->inverse_q48;
    for (unsigned phase = 0; differs && phase < HAL_PHASES_MAX; phase++) {
        const int64_t load_q24 = fixed_divide((load_q56[phase] >> 32) * now->inverse_q48, before->inverse_q48);
        load_q56[phase] = fixed_clamp_64(load_q24, 0, LOAD_MAX_Q24) * INT64_C(0x100000000);
    }
}

COLD void thermal_reconfigure(const thermal_parameters_t *before, const thermal_parameters_t *now, thermal_t *thermal) {
    keep_heat(&before->winding, &now->winding, thermal->winding_q56);
    keep_heat(&before->switches, &now->switches, thermal->switches_q56);
}

/* rate * step is at most 2^29 * 2^17, and the difference less than 2^23. */
COLD static void move(const thermal_model_t *model, int64_t *load_q56, uint64_t mean_square_q18, uint32_t step_us) {
    const uint64_t square_q16 = (mean_square_q18 * model->inverse_q48) >> 32;
    const int64_t target_q16 = (int64_t)(square_q16 < SQUARE_MAX_Q16 ? square_q16 : SQUARE_MAX_Q16);
    const int64_t part_q40 = (int64_t)(((uint64_t)model->rate_q48 * step_us) >> 8);
    *load_q56 += part_q40 * (target_q16 - (*load_q56 >> 40));
}

static uint32_t largest_q16(const int64_t *load_q56) {
    int64_t largest_q56 = 0;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        largest_q56 = load_q56[phase] > largest_q56 ? load_q56[phase] : largest_q56;
    }
    return (uint32_t)(largest_q56 >> 40);
}

COLD uint32_t thermal_winding_load_q16(const thermal_t *thermal) {
    return largest_q16(thermal->winding_q56);
}

COLD uint32_t thermal_switch_load_q16(const thermal_t *thermal) {
    return largest_q16(thermal->switches_q56);
}

static bool hot(bool before, uint32_t load_q16) {
    return load_q16 >= (before ? THERMAL_DERATE_Q16 : THERMAL_LIMIT_Q16);
}

COLD bool thermal_sample(const thermal_parameters_t *parameters, thermal_t *thermal, const int32_t *current_q9,
                         uint32_t time_us) {
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        const uint32_t sample_q9 = (uint32_t)current_q9[phase];
        thermal->square_q18[phase] += (uint64_t)sample_q9 * sample_q9;
    }
    thermal->samples++;
    uint32_t step_us = time_us - thermal->step_us;
    if (step_us < THERMAL_STEP_US) {
        return false;
    }
    step_us = fixed_min_u32(step_us, THERMAL_STEP_MAX_US);
    const uint64_t reciprocal_q32 =
        UINT32_MAX / thermal->samples; /* the product is below 2^64: no square is above 2^32 */
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        const uint64_t mean_q18 = (thermal->square_q18[phase] * reciprocal_q32) >> 32;
        move(&parameters->winding, &thermal->winding_q56[phase], mean_q18, step_us);
        move(&parameters->switches, &thermal->switches_q56[phase], mean_q18, step_us);
        thermal->square_q18[phase] = 0;
    }
    thermal->samples = 0;
    thermal->step_us = time_us;
    thermal->winding_hot = hot(thermal->winding_hot, thermal_winding_load_q16(thermal));
    thermal->switches_hot = hot(thermal->switches_hot, thermal_switch_load_q16(thermal));
    return true;
}

COLD int32_t thermal_torque_limit_q24(const thermal_parameters_t *parameters, const thermal_t *thermal) {
    const uint32_t winding_q16 = thermal_winding_load_q16(thermal), switch_q16 = thermal_switch_load_q16(thermal);
    const int32_t load_q16 = (int32_t)fixed_max_u32(winding_q16, switch_q16);
    const int32_t range_q16 = THERMAL_LIMIT_Q16 - THERMAL_DERATE_Q16;
    const int32_t room_q16 = fixed_clamp(THERMAL_LIMIT_Q16 - load_q16, 0, range_q16);
    return (int32_t)fixed_divide((int64_t)fixed_non_negative(parameters->torque_max_q24) * room_q16, range_q16);
}

COLD uint32_t thermal_faults(const thermal_t *thermal) {
    return (thermal->winding_hot ? (uint32_t)FAULT_BIT(FAULT_WINDING_OVERLOAD) : 0) |
           (thermal->switches_hot ? (uint32_t)FAULT_BIT(FAULT_INVERTER_OVERLOAD) : 0);
}
