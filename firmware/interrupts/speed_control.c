#include "interrupts/speed_control.h"

#include "fixed/fixed.h"

/* Part of the largest torque from which on a load is not braked against. */
#define UNCERTAIN_LOAD 16

static int32_t ramp_step(int32_t reference_q22, int32_t target_q22, int32_t step_max_q22) {
    const int32_t difference_q22 = fixed_subtract(target_q22, reference_q22);
    return fixed_add(reference_q22, fixed_clamp(difference_q22, -step_max_q22, step_max_q22));
}

int32_t speed_control_limited_q22(const control_parameters_t *parameters, int32_t commanded_q22) {
    const int32_t max_q22 = parameters->speed_reference_max_q22;
    const int32_t lowest_q22 = parameters->speed_reference_min_q22 < 0 ? -max_q22 : 0;
    return fixed_clamp(commanded_q22, lowest_q22, max_q22);
}

/* The PI within a limit below its own. */
static int32_t limited_pi_q24(const control_parameters_t *parameters, deferred_t *deferred, int32_t error_q22,
                              int32_t limit_q24) {
    const int32_t torque_q24 = speed_pi_step(&parameters->speed_pi, &deferred->speed_pi, error_q22);
    const int32_t limited_q24 = fixed_clamp(torque_q24, -limit_q24, limit_q24);
    if (limited_q24 != torque_q24) {
        speed_pi_follow(&deferred->speed_pi, limited_q24);
    }
    return limited_q24;
}

/* With fast counts, at the start of a run and with a position loop the course is the angle itself. */
static int32_t course_q22(const control_parameters_t *parameters, deferred_t *deferred, const deferred_input_t *input) {
    if (!deferred->run || !deferred->slow_counts.slow || deferred->follows_position) {
        count_course_begin(&deferred->count_course, input->angle);
        return 0;
    }
    return count_course_step(&parameters->count_course, &deferred->count_course, deferred->speed_reference_q22,
                             input->angle, input->periods);
}

static int32_t speed_law_q24(const control_parameters_t *parameters, deferred_t *deferred,
                             const deferred_input_t *input, const command_t *command, int32_t limit_q24) {
    const int32_t commanded_q22 = command->request == COMMAND_RUN ? command->speed_reference_q22 : 0;
    const int32_t min_q22 = parameters->speed_reference_min_q22;
    const int32_t before_q22 =
        deferred->run ? deferred->speed_reference_q22 : fixed_clamp(input->speed_q22, min_q22, INT32_MAX);
    const int32_t target_q22 = speed_control_limited_q22(parameters, commanded_q22);
    const int32_t reference_q22 = ramp_step(before_q22, target_q22, parameters->speed_ramp_q22);
    deferred->speed_reference_q22 = reference_q22;
    const int32_t error_q22 =
        fixed_subtract(fixed_add(reference_q22, course_q22(parameters, deferred, input)), input->speed_q22);
    switch (parameters->speed_law) {
    case SPEED_LAW_SMC:
        return speed_smc_reaching_torque_q24(&deferred->speed_smc, error_q22);
    case SPEED_LAW_PI:
    default:
        return limited_pi_q24(parameters, deferred, error_q22, limit_q24);
    }
}

/* Torque mode begins with the present torque; the laws of the speed follow it. */
static int32_t torque_law_q24(const control_parameters_t *parameters, deferred_t *deferred,
                              const deferred_input_t *input, const command_t *command, int32_t offset_q24) {
    if (deferred->mode != DRIVE_MODE_TORQUE) {
        deferred->torque_mode.torque_q24 = fixed_subtract(input->torque_reference_q24, offset_q24);
    }
    const int32_t torque_q24 = torque_mode_step(&parameters->torque_mode, &deferred->torque_mode,
                                                command->torque_reference_q24, input->speed_q22);
    deferred->speed_reference_q22 = fixed_clamp(input->speed_q22, parameters->speed_reference_min_q22, INT32_MAX);
    speed_pi_follow(&deferred->speed_pi, torque_q24);
    return fixed_add(torque_q24, offset_q24);
}

/* [SR-08] [SR-09] [SR-14] */
ALWAYS_INLINE void compute_law(const control_parameters_t *parameters, deferred_t *deferred,
                               const deferred_input_t *input, const command_t *command, int32_t limit_q24,
                               deferred_results_t *results) {
    const int32_t offset_q24 = torque_offset_q24(&deferred->torque_offset);
    int32_t min_q24 = deferred->conduction.torque_min_q24, max_q24 = deferred->conduction.torque_max_q24;
    min_q24 = fixed_max(min_q24, -limit_q24);
    max_q24 = fixed_min(max_q24, limit_q24);
    if (parameters->torque_law == TORQUE_LAW_PREDICTIVE && !conduction_at_rest(input->speed_q22)) {
        const int32_t braking_q24 = conduction_braking_q24(&parameters->conduction, input->dc_link_voltage_q6);
        if (input->speed_q22 < 0) {
            max_q24 = fixed_min(max_q24, braking_q24);
        } else {
            min_q24 = fixed_max(min_q24, -braking_q24);
        }
    }
    int32_t torque_q24 = 0;
    drive_mode_t mode = DRIVE_MODE_SPEED;
    int32_t reference_q22 = 0, periodic_load_q24 = 0;
    if (!input->run) {
        min_q24 = max_q24 = 0;
    } else if (command->mode == DRIVE_MODE_TORQUE && command->request == COMMAND_RUN) {
        mode = DRIVE_MODE_TORQUE;
        torque_q24 = fixed_clamp(torque_law_q24(parameters, deferred, input, command, offset_q24), min_q24, max_q24);
        min_q24 = max_q24 = torque_q24;
    } else {
        periodic_load_q24 = deferred->periodic_load.torque_q24;
        torque_q24 = fixed_add(fixed_add(speed_law_q24(parameters, deferred, input, command, limit_q24), offset_q24),
                               periodic_load_q24);
        reference_q22 = deferred->speed_reference_q22;
    }
    deferred->mode = mode;
    results->speed.speed_reference_q22 = reference_q22;
    results->speed.periodic_load_q24 = periodic_load_q24;
    results->speed.speed_law_torque_q24 = torque_q24;
    results->speed.torque_min_q24 = min_q24;
    results->speed.torque_max_q24 = max_q24;
}

void speed_control_deferred(const control_parameters_t *parameters, deferred_t *deferred, const deferred_input_t *input,
                            const command_t *command, int32_t limit_q24, deferred_results_t *results) {
    compute_law(parameters, deferred, input, command, limit_q24, results);
}

/* The same code again: one that is called from two places is not inlined, which would take instructions of the speed
 * and torque modes. */
NOINLINE void speed_control_position(const control_parameters_t *parameters, deferred_t *deferred,
                                     const deferred_input_t *input, const command_t *command, int32_t limit_q24,
                                     deferred_results_t *results) {
    compute_law(parameters, deferred, input, command, limit_q24, results);
}

/* [SR-09] */
void speed_control_limit_uncertain(const control_parameters_t *parameters, int32_t load_q24,
                                   deferred_speed_results_t *results) {
    const int32_t most_q24 = parameters->conduction.torque_max_q24;
    const int32_t magnitude_q24 = fixed_abs(load_q24);
    const int32_t against_q24 =
        magnitude_q24 < most_q24 / UNCERTAIN_LOAD ? most_q24 - UNCERTAIN_LOAD * magnitude_q24 : 0;
    if (load_q24 > 0 && results->speed_reference_q22 >= 0) {
        results->torque_min_q24 = results->torque_min_q24 > -against_q24 ? results->torque_min_q24 : -against_q24;
    } else if (load_q24 < 0 && results->speed_reference_q22 <= 0) {
        results->torque_max_q24 = results->torque_max_q24 < against_q24 ? results->torque_max_q24 : against_q24;
    }
}

/* The transducer is offset binary, +-64 N m full scale: 2^31 of Q7.24 over all counts. */
static int32_t transducer_torque_q24(const control_parameters_t *parameters, uint16_t counts) {
    return (counts << (31 - parameters->adc_bits)) - (1 << 30);
}

static int32_t sliding_mode_torque_q24(const control_parameters_t *parameters, const load_observer_t *observer,
                                       const control_sample_t *sample, const deferred_speed_results_t *law) {
    const int32_t load_q24 = parameters->load_from_transducer
                                 ? transducer_torque_q24(parameters, sample->adc->load_torque_counts)
                                 : observer->load_torque_q24;
    return speed_smc_torque_q24(&parameters->speed_smc, law->speed_law_torque_q24, observer->speed_q22, load_q24,
                                law->torque_min_q24, law->torque_max_q24);
}

int32_t speed_control_torque_q24(const control_parameters_t *parameters, const load_observer_t *observer,
                                 const control_sample_t *sample, const deferred_results_t *deferred) {
    switch (parameters->speed_law) {
    case SPEED_LAW_SMC:
        return sliding_mode_torque_q24(parameters, observer, sample, &deferred->speed);
    case SPEED_LAW_PI:
    default:
        return deferred->speed.speed_law_torque_q24;
    }
}
