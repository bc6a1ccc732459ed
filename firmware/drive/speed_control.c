#include "drive/speed_control.h"

#include "fixed/fixed.h"

static int32_t ramp_step(int32_t reference_q22, int32_t target_q22, int32_t step_max_q22) {
    const int32_t difference_q22 = fixed_subtract(target_q22, reference_q22);
    return fixed_add(reference_q22, fixed_clamp(difference_q22, -step_max_q22, step_max_q22));
}

/* The transducer is offset binary, +-64 N m full scale: 2^31 of Q7.24 over all counts. */
static int32_t transducer_torque_q24(const control_parameters_t *parameters, uint16_t counts) {
    const unsigned bits = parameters->adc_bits;
    return (counts - (1 << (bits - 1))) * (1 << (31 - bits));
}

static int32_t load_torque_q24(const control_parameters_t *parameters, const control_state_t *state,
                               const control_sample_t *sample) {
    return parameters->load_from_transducer ? transducer_torque_q24(parameters, sample->adc.load_torque_counts)
                                            : state->observer.load_torque_q24;
}

void speed_control(const control_parameters_t *parameters, control_state_t *state, const control_sample_t *sample,
                   const command_t *command, int32_t law_torque_q24) {
    const int32_t commanded_q22 = command->request == COMMAND_RUN ? command->speed_reference_q22 : 0;
    const int32_t target_q22 = fixed_clamp(commanded_q22, parameters->speed_reference_min_q22, INT32_MAX);
    const int32_t reference_q22 = ramp_step(state->speed_reference_q22, target_q22, parameters->speed_ramp_q22);
    state->speed_reference_q22 = reference_q22;
    switch (parameters->speed_law) {
    case SPEED_LAW_PI:
        state->torque_reference_q24 = law_torque_q24;
        break;
    case SPEED_LAW_SMC:
        state->torque_reference_q24 = speed_smc_torque_q24(&parameters->speed_smc, law_torque_q24, state->observer.speed_q22,
                                                           load_torque_q24(parameters, state, sample));
        break;
    }
}
