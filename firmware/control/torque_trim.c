#include "control/torque_trim.h"

#include "fixed/fixed.h"

void torque_trim_reset(torque_trim_t *trim, int32_t reference_q24) {
    bp_pid_reset(&trim->pid);
    trim->reference_q24[0] = trim->reference_q24[1] = reference_q24;
    trim->trim_q24 = 0;
}

int32_t torque_trim_correct(const torque_trim_parameters_t *parameters, torque_trim_t *trim,
                            const int32_t gain_q24[BP_OUTPUTS], int32_t reference_q24, int32_t torque_q24,
                            bool voltage_limited) {
    const int32_t due_q24 = trim->reference_q24[1];
    trim->reference_q24[1] = trim->reference_q24[0];
    trim->reference_q24[0] = reference_q24;
    if (!voltage_limited) {
        const int32_t error_q24 = fixed_subtract(due_q24, torque_q24);
        const int32_t output_q15 = bp_pid_step(&parameters->pid, &trim->pid, gain_q24, error_q24);
        trim->trim_q24 = fixed_multiply(output_q15, parameters->limit_q24, 15);
    }
    return fixed_add(reference_q24, trim->trim_q24);
}
