#include "control/torque_offset.h"

#include "fixed/divide.h"
#include "fixed/fixed.h"

#define RATE_1_S 20

torque_offset_parameters_t torque_offset_configure(uint32_t update_rate_hz, int32_t torque_max_q24) {
    return (torque_offset_parameters_t){
        .gain_q32 = (int32_t)fixed_divide((int64_t)RATE_1_S << 32, update_rate_hz),
        .limit_q24 = torque_max_q24 / 8,
    };
}

void torque_offset_step(const torque_offset_parameters_t *parameters, torque_offset_t *offset, int32_t reference_q24,
                        int32_t torque_q24, bool voltage_limited) {
    if (voltage_limited) {
        return;
    }
    const int32_t requested_q24 = fixed_subtract(reference_q24, torque_offset_q24(offset));
    const int32_t error_q24 = fixed_subtract(requested_q24, torque_q24);
    const int64_t sum_q56 = offset->offset_q56 + fixed_product(error_q24, parameters->gain_q32); /* below 2^60 */
    const int64_t limit_q56 = (int64_t)parameters->limit_q24 << 32;
    offset->offset_q56 = fixed_clamp_64(sum_q56, -limit_q56, limit_q56);
}
