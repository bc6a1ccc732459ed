#include "drive/speed_control.h"

#include "fixed/fixed.h"

static int32_t ramp_step(int32_t reference_q22, int32_t target_q22, int32_t step_max_q22) {
    const int32_t difference_q22 = fixed_subtract(target_q22, reference_q22);
    return fixed_add(reference_q22, fixed_clamp(difference_q22, -step_max_q22, step_max_q22));
}

int32_t speed_control_law_q24(const control_parameters_t *parameters, deferred_t *deferred,
                              const deferred_input_t *input) {
    const int32_t min_q22 = parameters->speed_reference_min_q22;
    const int32_t before_q22 =
        deferred->run ? deferred->speed_reference_q22 : fixed_clamp(input->speed_q22, min_q22, INT32_MAX);
    const int32_t target_q22 = fixed_clamp(input->commanded_speed_q22, min_q22, INT32_MAX);
    const int32_t reference_q22 = ramp_step(before_q22, target_q22, parameters->speed_ramp_q22);
    deferred->speed_reference_q22 = reference_q22;
    const int32_t error_q22 = fixed_subtract(reference_q22, input->speed_q22);
    switch (parameters->speed_law) {
    case SPEED_LAW_SMC:
        return speed_smc_reaching_torque_q24(&parameters->speed_smc, error_q22);
    case SPEED_LAW_PI:
    default:
        return speed_pi_step(&parameters->speed_pi, &deferred->speed_pi, error_q22);
    }
}

/* The transducer is offset binary, +-64 N m full scale: 2^31 of Q7.24 over all counts. */
static int32_t transducer_torque_q24(const control_parameters_t *parameters, uint16_t counts) {
    const unsigned bits = parameters->adc_bits;
    return (counts - (1 << (bits - 1))) * (1 << (31 - bits));
}

int32_t speed_control_torque_q24(const control_parameters_t *parameters, const load_observer_t *observer,
                                 const control_sample_t *sample, int32_t law_torque_q24) {
    switch (parameters->speed_law) {
    case SPEED_LAW_SMC: {
        const int32_t load_q24 = parameters->load_from_transducer
                                     ? transducer_torque_q24(parameters, sample->adc.load_torque_counts)
                                     : observer->load_torque_q24;
        return speed_smc_torque_q24(&parameters->speed_smc, law_torque_q24, observer->speed_q22, load_q24);
    }
    case SPEED_LAW_PI:
    default:
        return law_torque_q24;
    }
}
