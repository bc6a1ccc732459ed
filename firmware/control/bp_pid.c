#include "control/bp_pid.h"

#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "fixed/formats.h"

#define ERROR_BITS 17 /* Q16, saturated to -1..1 - 2^-16 */
#define DUTY_BITS 24  /* Q23, saturated to -1..1 - 2^-23, which rounds to 1 in Q15 */

void bp_pid_clear_telemetry(bp_pid_t *pid) {
    pid->duty_q23 = 0;
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        pid->gain_q24[l] = 0;
    }
}

void bp_pid_reset(bp_pid_t *pid) {
    pid->error_q16 = 0;
    pid->error_difference_q16 = 0;
    pid->sample.learns = false;
    bp_pid_clear_telemetry(pid);
}

void bp_pid_preset(bp_pid_t *pid, int32_t duty_q15) {
    pid->duty_q23 = fixed_clamp(duty_q15, -ONE_Q15, ONE_Q15) * 256;
}

/* Q24 * Q24 to Q16: below 2^31 * 2^30 / 2^32. */
ALWAYS_INLINE int32_t scaled_error_q16(const bp_pid_parameters_t *parameters, int32_t torque_error_q24) {
    return fixed_saturate_bits(fixed_multiply_high(torque_error_q24, parameters->error_scale_inverse_q24), ERROR_BITS);
}

void bp_pid_set_error(const bp_pid_parameters_t *parameters, bp_pid_t *pid, int32_t torque_error_q24) {
    pid->error_q16 = scaled_error_q16(parameters, torque_error_q24);
}

int32_t bp_pid_step(const bp_pid_parameters_t *parameters, bp_pid_t *pid, const int32_t gain_q24[BP_OUTPUTS],
                    int32_t torque_error_q24) {
    const int32_t error_q16 = scaled_error_q16(parameters, torque_error_q24);
    const int32_t error_difference_q16 = error_q16 - pid->error_q16;
    const int32_t second_difference_q16 = error_difference_q16 - pid->error_difference_q16;
    pid->error_q16 = error_q16;
    pid->error_difference_q16 = error_difference_q16;
    int32_t *term_q31 = pid->sample.term_q31;
    term_q31[0] = fixed_saturate_bits(error_difference_q16, ERROR_BITS) * (1 << 15);
    term_q31[1] = error_q16 * (1 << 15);
    term_q31[2] = fixed_saturate_bits(second_difference_q16, ERROR_BITS) * (1 << 15);

    int32_t sum_q23 = pid->duty_q23; /* within 1 + 3 * 4 */
    UNROLL(3)
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        pid->gain_q24[l] = gain_q24[l];
        sum_q23 = fixed_multiply_high_add(sum_q23, gain_q24[l], term_q31[l]);
    }
    const int32_t duty_q23 = fixed_saturate_bits(sum_q23, DUTY_BITS);
    pid->duty_q23 = duty_q23;

    /* Saturated at 2^16 - 1 or -2^16, whose complement is 2^16 - 1. */
    const bool at_limit = (error_q16 ^ error_q16 >> 31) == (1 << (ERROR_BITS - 1)) - 1;
    pid->sample.learns = sum_q23 == duty_q23 && !at_limit;
    return (duty_q23 + (1 << 7)) >> 8;
}
