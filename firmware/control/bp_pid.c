#include "control/bp_pid.h"

#include "fixed/fixed.h"

#define ERROR_LIMIT_Q15 32767
#define DUTY_ONE_Q30 (1 << 30)

void bp_pid_reset(const bp_pid_parameters_t *parameters, bp_pid_t *pid) {
    *pid = (bp_pid_t){0};
    bp_network_reset(&pid->network, parameters->seed);
}

void bp_pid_preset(bp_pid_t *pid, int32_t duty_q15) {
    pid->duty_q30 = fixed_clamp(duty_q15, -32768, 32768) * 32768;
}

void bp_pid_show_none(bp_pid_t *pid) {
    pid->duty_q30 = 0;
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        pid->gain_q15[l] = 0;
    }
}

static int32_t limited(int32_t value_q15) {
    return fixed_clamp(value_q15, -ERROR_LIMIT_Q15, ERROR_LIMIT_Q15);
}

int32_t bp_pid_step(const bp_pid_parameters_t *parameters, bp_pid_t *pid, int32_t torque_error_q24) {
    /* Q24 * Q24 to Q15. */
    const int32_t error_q15 = limited(fixed_multiply(torque_error_q24, parameters->error_scale_inverse_q24, 33));
    const int32_t term_q15[BP_OUTPUTS] = {
        limited(error_q15 - pid->error_q15),
        error_q15,
        limited(error_q15 - 2 * pid->error_q15 + pid->previous_q15),
    };
    const int32_t scale_q15[BP_OUTPUTS] = {parameters->kp_scale_q15, parameters->ki_scale_q15,
                                           parameters->kd_scale_q15};
    const bool from_network = parameters->mode == BP_PID_FROZEN || parameters->mode == BP_PID_LEARNING;
    if (from_network) {
        const int32_t input_q15[BP_INPUTS] = {error_q15, term_q15[0], term_q15[2]};
        bp_network_forward(&pid->network, input_q15);
    }

    int64_t duty_q30 = pid->duty_q30;
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        pid->gain_q15[l] =
            from_network ? fixed_multiply(pid->network.output_q15[l], scale_q15[l], 15) : scale_q15[l] / 2;
        duty_q30 += (int64_t)pid->gain_q15[l] * term_q15[l]; /* 2^17 * 2^15 */
    }
    const bool saturated = duty_q30 > DUTY_ONE_Q30 || duty_q30 < -DUTY_ONE_Q30;
    pid->duty_q30 = (int32_t)(duty_q30 > DUTY_ONE_Q30    ? DUTY_ONE_Q30
                              : duty_q30 < -DUTY_ONE_Q30 ? -DUTY_ONE_Q30
                                                         : duty_q30);

    const bool at_limit = error_q15 == ERROR_LIMIT_Q15 || error_q15 == -ERROR_LIMIT_Q15;
    if (parameters->mode == BP_PID_LEARNING && !saturated && !at_limit) {
        bp_network_learn(&parameters->network, &pid->network, error_q15, term_q15);
    }
    pid->previous_q15 = pid->error_q15;
    pid->error_q15 = error_q15;
    return (int32_t)fixed_shift(pid->duty_q30, 15);
}
