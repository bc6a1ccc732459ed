#include "control/bp_tuner.h"

#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "fixed/sigmoid.h"

static void set_gains(const bp_pid_parameters_t *parameters, bp_tuner_t *tuner, const int32_t output_q27[BP_OUTPUTS]) {
    UNROLL(3)
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        tuner->gain_q24[l] = fixed_multiply_high(sigmoid_logistic_q28(output_q27[l]), parameters->scale_q28[l]);
    }
}

/* f = 0: g = 1/2. */
static void set_half_gains(const bp_pid_parameters_t *parameters, bp_tuner_t *tuner) {
    set_gains(parameters, tuner, (const int32_t[BP_OUTPUTS]){0});
}

void bp_tuner_reset(const bp_pid_parameters_t *parameters, bp_tuner_t *tuner) {
    bp_network_reset(&tuner->network, parameters->seed);
    tuner->passed = false;
    set_half_gains(parameters, tuner);
}

void bp_tuner_step(const bp_pid_parameters_t *parameters, bp_tuner_t *tuner, const bp_pid_sample_t *sample) {
    const int32_t *term_q31 = sample->term_q31;
    if (parameters->mode != BP_PID_FROZEN && parameters->mode != BP_PID_LEARNING) {
        set_half_gains(parameters, tuner); /* of scales that may have changed */
        return;
    }
    if (parameters->mode == BP_PID_LEARNING && sample->learns && tuner->passed) {
        bp_network_learn(&parameters->network, &tuner->network, term_q31[1] >> 15, tuner->input_q31, term_q31);
    }
    const int32_t input_q27[BP_INPUTS] = {term_q31[0] >> 4, term_q31[1] >> 4, term_q31[2] >> 4};
    bp_network_forward(&tuner->network, input_q27);
    UNROLL(3)
    for (unsigned j = 0; j < BP_INPUTS; j++) {
        tuner->input_q31[j] = term_q31[j];
    }
    tuner->passed = true;
    set_gains(parameters, tuner, tuner->network.output_q27);
}
