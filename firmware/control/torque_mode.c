#include "control/torque_mode.h"

#include "fixed/divide.h"
#include "fixed/fixed.h"

torque_mode_parameters_t torque_mode_configure(int32_t slew_rate_q10, uint32_t control_rate_hz, int32_t torque_min_q24,
                                               int32_t torque_max_q24, int32_t over_speed_q22) {
    const int64_t slew_q24 = fixed_divide((int64_t)slew_rate_q10 << 14, control_rate_hz);
    const int32_t range_q22 = over_speed_q22 / 16;
    return (torque_mode_parameters_t){
        .slew_q24 = slew_rate_q10 == 0 ? INT32_MAX : fixed_clamp(fixed_saturate(slew_q24), 1, INT32_MAX),
        .torque_min_q24 = torque_min_q24,
        .torque_max_q24 = torque_max_q24,
        .speed_end_q22 = over_speed_q22 - range_q22,
        .fold_back_range_q22 = range_q22,
        .fold_back_q18 = (int32_t)fixed_divide((int64_t)torque_max_q24 << 16, range_q22) + 1,
    };
}

/* [SR-08] */
int32_t torque_mode_step(const torque_mode_parameters_t *parameters, torque_mode_t *mode, int32_t commanded_q24,
                         int32_t speed_q22) {
    const int32_t target_q24 = fixed_clamp(commanded_q24, parameters->torque_min_q24, parameters->torque_max_q24);
    const int32_t change_q24 = fixed_subtract(target_q24, mode->torque_q24);
    mode->torque_q24 =
        fixed_add(mode->torque_q24, fixed_clamp(change_q24, -parameters->slew_q24, parameters->slew_q24));
    const int32_t room_q22 = fixed_clamp(fixed_subtract(parameters->speed_end_q22, fixed_abs(speed_q22)), 0,
                                         parameters->fold_back_range_q22);
    const int32_t driving_max_q24 = (int32_t)(fixed_product(room_q22, parameters->fold_back_q18) >> 16);
    return speed_q22 < 0 ? fixed_clamp(mode->torque_q24, -driving_max_q24, INT32_MAX)
                         : fixed_clamp(mode->torque_q24, INT32_MIN, driving_max_q24);
}
