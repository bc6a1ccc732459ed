#include "interrupts/deferred.h"

#include "fixed/compiler.h"
#include "fixed/fixed.h"
#include "interrupts/deferred_jobs.h"
#include "interrupts/position_control.h"
#include "interrupts/speed_control.h"
#include "interrupts/torque_control.h"

/* 3 ms at 40 kHz. */
#define SETTLING_UPDATES 16u

/* Error of a speed that has settled at a reference of 0: 0.5 rad/s times the unit of the speed. */
#define NEAR_MIN_Q22 (1 << 21)

/* From the slopes of a sample to their effect on the load observer, periods. */
#define SLOPE_LAG_PERIODS 5

/* Resets what the control interrupt has reset since the previous step. [SR-44] */
NOINLINE static void follow_resets(const control_parameters_t *parameters, deferred_t *deferred,
                                   const deferred_input_t *input) {
    const uint32_t changed = deferred->generation ^ input->generation;
    if ((changed & DEFERRED_RUN_MASK) != 0) {
        conduction_reset(&parameters->conduction, &deferred->conduction, &deferred->conduction_update);
        deferred->speed_smc = parameters->speed_smc;
        deferred->run = false;
        deferred->mode = DRIVE_MODE_SPEED;
        speed_pi_reset(&deferred->speed_pi);
        deferred->torque_offset = (torque_offset_t){0};
        periodic_load_reset(&deferred->periodic_load);
        misalignment_keep(&deferred->misalignment);
    }
    if ((changed & DEFERRED_OBSERVER_MASK) != 0) {
        deferred->bandwidth = (observer_bandwidth_statistics_t){0, 0};
    }
    deferred->generation = input->generation;
    if (!deferred->started) {
        deferred->started = true;
        protection_deferred_reset(&deferred->protection, input->encoder_angle);
    }
}

static uint64_t protect(const control_parameters_t *parameters, deferred_t *deferred, const deferred_input_t *input) {
    const protection_deferred_input_t checked = {
        .dc_link_voltage_q6 = input->dc_link_voltage_q6,
        .speed_q22 = input->speed_q22,
        .encoder_angle = input->encoder_angle,
        .command_age_us = input->command_age_us,
        .periods = input->periods,
    };
    return protection_check_deferred(&parameters->protection, &deferred->protection, &checked);
}

/* Rotation per control period, 2^-32 rev. */
static int32_t rotation(const control_parameters_t *parameters, const deferred_input_t *input) {
    return fixed_multiply_high(input->speed_q22, parameters->observer.angle_step_q32);
}

static void limit_bandwidth(const control_parameters_t *parameters, deferred_t *deferred, const deferred_input_t *input,
                            observer_bandwidth_limits_t *limits) {
    const observer_bandwidth_sample_t *sample = &input->bandwidth;
    const uint32_t angle_step = fixed_magnitude(rotation(parameters, input));
    const uint32_t rounding_q4 = moving_load_rounding_q4(&parameters->moving_load, &deferred->rounding, angle_step);
    const uint32_t withheld = moving_load_step(&parameters->moving_load, &deferred->moving_load, sample, rounding_q4,
                                               deferred->periodic_load.engaged);
    observer_bandwidth_update(&parameters->bandwidth.schedule, &deferred->bandwidth, sample, angle_step, rounding_q4,
                              withheld, limits);
}

/* Between slow counts there is nothing of which statistics could be made. */
NOINLINE static bool follow_slow_counts(const control_parameters_t *parameters, deferred_t *deferred,
                                        const deferred_input_t *input, deferred_results_t *results) {
    results->bandwidth = (observer_bandwidth_limits_t){0, parameters->bandwidth.schedule.retrigger_holdoff_ticks, 1,
                                                       parameters->bandwidth.schedule.trigger_stage_count};
    if (!slow_counts_step(&parameters->slow_counts, &deferred->slow_counts, input->encoder_angle,
                          fixed_magnitude(rotation(parameters, input)), input->periods)) {
        return false;
    }
    slow_counts_set(&deferred->slow_counts, &results->slow_counts);
    if (deferred->mode == DRIVE_MODE_SPEED) {
        speed_control_limit_uncertain(parameters, input->load_torque_q24, &results->speed);
    }
    return true;
}

static void follow_innovation(const control_parameters_t *parameters, deferred_t *deferred,
                              const deferred_input_t *input, deferred_results_t *results) {
    results->slow_counts.slow = false;
    if (deferred->slow_counts.slow) {
        results->slow_counts.slow = follow_slow_counts(parameters, deferred, input, results);
    } else if (parameters->bandwidth.schedule.adaptive) {
        limit_bandwidth(parameters, deferred, input, &results->bandwidth);
    }
}

static bool disturbed(const control_parameters_t *parameters, const deferred_input_t *input) {
    return parameters->bandwidth.schedule.adaptive &&
           input->bandwidth.stage < parameters->bandwidth.schedule.moving_stage;
}

/* Beat of the counts (observer_bandwidth.h), whose sawtooth may be as slow as the strokes. */
static bool beats(const deferred_input_t *input) {
    return input->bandwidth.stage == OBSERVER_BANDWIDTH_BEAT_STAGE;
}

/* Speed control in which neither a disturbance, nor a beat, nor the voltage adds to the ripple. A misalignment of a
 * quarter of a stroke moves the speed by more than an eighth, and learning it ends that. */
static bool undisturbed_speed_control(const control_parameters_t *parameters, const deferred_t *deferred,
                                      const deferred_input_t *input) {
    const uint32_t speed_error_q22 = fixed_magnitude(fixed_subtract(deferred->speed_reference_q22, input->speed_q22));
    return deferred->mode == DRIVE_MODE_SPEED && speed_error_q22 < fixed_magnitude(input->speed_q22) / 8 &&
           !disturbed(parameters, input) && !beats(input) && input->torque_shortfall_q24 == 0;
}

/* The misalignment is observable while speed, load and voltage are steady. In torque mode nothing keeps the speed
 * steady; a dynamometer that does hides the ripple of the torque, and what the observer then takes for a load would be
 * learned. */
static misalignment_condition_t condition(const deferred_t *deferred, bool undisturbed) {
    if (deferred->mode != DRIVE_MODE_SPEED || !deferred->load_constant) {
        return MISALIGNMENT_UNSTEADY;
    }
    const bool steady = undisturbed && stroke_mean_shows_load(&deferred->stroke_mean);
    return steady ? MISALIGNMENT_STEADY : MISALIGNMENT_INTERRUPTED;
}

static int32_t disturbance_q24(const deferred_t *deferred, const deferred_input_t *input) {
    return misalignment_disturbance_q24(deferred->inertia.laws.rate_q8, input->load_torque_q24,
                                        input->speed_correction_q22);
}

/* Between slow counts the flux linkage is compared at an angle of the model, and no ripple corrects what the shape of
 * the tables errs by (misalignment.h): only what exceeds both is told. */
static int32_t told_by_flux(const control_parameters_t *parameters, const deferred_t *deferred, int32_t misalignment) {
    const int32_t offset = deferred->misalignment.phase[misalignment_phase_index(&deferred->misalignment)].offset;
    const uint32_t angle = slow_counts_uncertain_angle(&parameters->slow_counts, &deferred->slow_counts);
    const int32_t uncertain = (int32_t)((angle + MISALIGNMENT_SHAPE_ANGLE) * parameters->commutation.rotor_poles);
    const int32_t excused = fixed_clamp(fixed_subtract(misalignment, offset), -uncertain, uncertain);
    return misalignment != 0 ? fixed_subtract(misalignment, excused) : 0;
}

/* One phase by its flux linkage alone, and the gains of the coming counts by the slope of the torque. */
NOINLINE static void learn_between_counts(const control_parameters_t *parameters, deferred_t *deferred,
                                          const deferred_input_t *input,
                                          const int32_t flux_misalignment[HAL_PHASES_MAX]) {
    const commutation_t commutation = {.electrical = input->electrical};
    const unsigned phase = misalignment_phase_index(&deferred->misalignment);
    const uint32_t angle = commutation_angle(&parameters->commutation, &commutation, phase) -
                           (uint32_t)deferred->misalignment.phase[phase].offset;
    /* The laws that learn no misalignment have none. */
    const int32_t told = parameters->torque_law == TORQUE_LAW_PREDICTIVE
                             ? told_by_flux(parameters, deferred, flux_misalignment[phase])
                             : 0;
    misalignment_follow_flux(&parameters->misalignment, &deferred->misalignment, &machine_tables, angle,
                             input->current_q9, told);
    slow_counts_update(&parameters->slow_counts, &deferred->slow_counts,
                       misalignment_slope_q24(&deferred->misalignment));
}

static void learn_misalignment(const control_parameters_t *parameters, deferred_t *deferred,
                               const deferred_input_t *input, const int32_t flux_misalignment[HAL_PHASES_MAX]) {
    const commutation_t commutation = {.electrical = input->electrical};
    const unsigned phase = misalignment_phase_index(&deferred->misalignment);
    const uint32_t lag =
        (uint32_t)rotation(parameters, input) * parameters->commutation.rotor_poles * SLOPE_LAG_PERIODS;
    const misalignment_sample_t sample = {
        .current_q9 = input->current_q9,
        .angle = commutation_angle(&parameters->commutation, &commutation, phase) -
                 (uint32_t)deferred->misalignment.phase[phase].offset - lag,
        .disturbance_q24 = disturbance_q24(deferred, input),
        .torque_q24 = input->torque_reference_q24,
        .bandwidth_rad_s = observer_bandwidth_stage(&parameters->bandwidth, input->bandwidth.stage)->bandwidth_rad_s,
        .condition = condition(deferred, undisturbed_speed_control(parameters, deferred, input)),
        .flux_misalignment = flux_misalignment[phase],
    };
    misalignment_step(&parameters->misalignment, &deferred->misalignment, &machine_tables, &sample);
}

/* Part of a stroke that passes between two steps of the common misalignment, Q16: 2^15 strokes fit. */
static int32_t stroke_part_q16(const control_parameters_t *parameters, const deferred_input_t *input) {
    const uint32_t strokes = parameters->commutation.rotor_poles * machine_tables.phases;
    return (int32_t)((uint64_t)fixed_magnitude(rotation(parameters, input)) * strokes * DEFERRED_COMMON_PERIODS >> 16);
}

/* While counts are slow the ripple teaches nothing. */
static void learn_phase(const control_parameters_t *parameters, deferred_t *deferred, const deferred_input_t *input,
                        const int32_t flux_misalignment[HAL_PHASES_MAX]) {
    if (deferred->slow_counts.slow) {
        learn_between_counts(parameters, deferred, input, flux_misalignment);
    } else {
        learn_misalignment(parameters, deferred, input, flux_misalignment);
    }
}

static void learn_common_misalignment(const control_parameters_t *parameters, deferred_t *deferred,
                                      const deferred_input_t *input) {
    misalignment_common_step(&parameters->misalignment, &deferred->misalignment, machine_tables.phases,
                             input->torque_reference_q24, stroke_part_q16(parameters, input));
}

static void follow_strokes(const control_parameters_t *parameters, deferred_t *deferred,
                           const deferred_input_t *input) {
    const bool constant =
        stroke_mean_step(&parameters->stroke_mean, &deferred->stroke_mean, input->electrical, input->load_torque_q24,
                         input->torque_reference_q24, disturbed(parameters, input));
    deferred->load_constant = constant && !deferred->periodic_load.engaged;
}

static void learn_periodic_load(const control_parameters_t *parameters, deferred_t *deferred,
                                const deferred_input_t *input) {
    if (deferred->mode != DRIVE_MODE_SPEED) {
        periodic_load_reset(&deferred->periodic_load);
        return;
    }
    const periodic_load_sample_t sample = {
        .angle = input->encoder_angle,
        .angle_step = rotation(parameters, input),
        .load_torque_q24 = input->load_torque_q24,
        .moving = deferred->moving_load.withheld > 0 && !deferred->load_constant,
    };
    periodic_load_step(&parameters->periodic_load, &deferred->periodic_load, &sample);
}

/* Either of both, and in the turn in which a stroke has ended neither: each of the three takes the time of one. */
static void review_stroke_or_learn_periodic_load(const control_parameters_t *parameters, deferred_t *deferred,
                                                 const deferred_input_t *input) {
    stroke_mean_t *strokes = &deferred->stroke_mean;
    if (stroke_mean_to_review(strokes)) {
        stroke_mean_review(&parameters->stroke_mean, strokes);
        misalignment_end_stroke(&deferred->misalignment, strokes->changed, strokes->grown);
    } else if (!stroke_mean_ended(strokes)) {
        learn_periodic_load(parameters, deferred, input);
    }
}

static bool at_torque_limit(const deferred_t *deferred, int32_t torque_q24) {
    return torque_q24 >= deferred->conduction.torque_max_q24 || torque_q24 <= deferred->conduction.torque_min_q24;
}

/* From a change of the speed reference on it is approached, until two windows of inertia.h and SETTLING_UPDATES after
 * the speed was first within a sixteenth of it with a torque below its limit: what comes later may be a load's. A
 * position reference is approached all the time. */
static void approach_reference(const control_parameters_t *parameters, deferred_t *deferred,
                               const deferred_input_t *input) {
    const uint32_t settling = (2u << parameters->inertia.window_shift) + SETTLING_UPDATES;
    const int32_t reference_q22 = deferred->speed_reference_q22;
    const int32_t near_q22 = fixed_abs(reference_q22) / 16 + NEAR_MIN_Q22;
    const bool is_near = fixed_abs(fixed_subtract(reference_q22, input->speed_q22)) <= near_q22;
    const bool limited = at_torque_limit(deferred, input->torque_reference_q24);
    if (reference_q22 != deferred->approached_q22) {
        deferred->approached_q22 = reference_q22;
        deferred->updates_since_near = 0;
    }
    deferred->updates_since_near +=
        deferred->updates_since_near > 0 ? deferred->updates_since_near < settling : is_near && !limited;
    deferred->approaches_reference = deferred->follows_position || deferred->updates_since_near < settling;
}

_Static_assert(DEFERRED_COMMON_PERIODS / DEFERRED_LEARNING_PERIODS == 4, "four samples in the mean torque");

/* Mean over the samples since the last update of the inertia; rounded down. */
static void average_torque(deferred_t *deferred, const deferred_input_t *input) {
    deferred->mean_torque_q24 += input->torque_sum_q24 >> 2;
}

/* A torque that is at its limit in order to change the speed follows no load. In position mode the law's own torque
 * counts, to which the observer's load is added: it accelerates the reference, or shows that a rotor at rest swings
 * because its inertia is another one. The next mean torque begins. */
static void identify_inertia(const control_parameters_t *parameters, deferred_t *deferred,
                             const deferred_input_t *input) {
    inertia_step(&parameters->inertia, &deferred->inertia, input->electrical, deferred->mean_torque_q24,
                 deferred->follows_position ? deferred->accelerates
                                            : at_torque_limit(deferred, input->torque_reference_q24),
                 deferred->approaches_reference);
    deferred->mean_torque_q24 = 0;
}

static void move_conduction(const control_parameters_t *parameters, deferred_t *deferred,
                            const deferred_input_t *input) {
    const conduction_sample_t sample = {
        .torque_q24 = input->torque_reference_q24,
        .torque_sum_q24 = input->torque_sum_q24,
        .torque_shortfall_q24 = input->torque_shortfall_q24,
        .speed_q22 = input->speed_q22,
        .angle_step = fixed_magnitude(rotation(parameters, input)) * parameters->commutation.rotor_poles *
                      DEFERRED_CONDUCTION_PERIODS,
        .dc_link_voltage_q6 = input->dc_link_voltage_q6,
    };
    conduction_step(&parameters->conduction, &deferred->conduction, &deferred->conduction_update, &machine_tables,
                    &sample);
}

/* Gain by the identified inertia; above base speed gain and epsilon by the same factor smaller: far from the reference
 * the law stays the same. */
static void set_speed_law(const control_parameters_t *parameters, deferred_t *deferred) {
    const int32_t gain_q24 = deferred->inertia.laws.reaching_gain_q24;
    const int32_t full_q31 = parameters->speed_smc.epsilon_q31;
    const int32_t excess_q31 = deferred->conduction.gain_excess_q31;
    deferred->speed_smc.gain_q24 = gain_q24 - 2 * fixed_multiply_high(gain_q24, excess_q31);
    const int32_t epsilon_q31 = full_q31 - 2 * fixed_multiply_high(full_q31, excess_q31);
    deferred->speed_smc.epsilon_q31 = fixed_max(epsilon_q31, SPEED_SMC_EPSILON_MIN_Q31);
}

COLD void deferred_tune(const control_parameters_t *parameters, control_state_t *state, unsigned part) {
    deferred_t *deferred = &state->deferred;
    if (part == DEFERRED_TUNE_INERTIA) {
        inertia_tune(&parameters->inertia, &parameters->observer, &deferred->inertia);
        return;
    }
    inertia_tune_laws(&deferred->inertia);
    deferred->speed_smc = parameters->speed_smc;
    if (parameters->torque_law == TORQUE_LAW_PREDICTIVE) {
        set_speed_law(parameters, deferred);
    }
}

/* In single pulse operation the level makes the torque equal the reference, and the offset returns to 0: one that
 * came from the shortfall before would remain. Above base speed, where the windows stay where there is hardly any
 * shortfall, the offset makes up for it. */
static void step_torque_offset(const control_parameters_t *parameters, deferred_t *deferred,
                               const deferred_input_t *input) {
    const conduction_state_t *conduction = &deferred->conduction;
    const bool single_pulse = conduction->single_pulse;
    const bool limited = !single_pulse && input->torque_shortfall_q24 != 0 && conduction->partial_q15 == 0;
    torque_offset_step(&parameters->torque_offset, &deferred->torque_offset, input->torque_reference_q24,
                       single_pulse ? input->torque_reference_q24 : input->torque_sum_q24, limited);
}

/* periods: since the previous call. */
NOINLINE static void await_slow_counts(const control_parameters_t *parameters, deferred_t *deferred,
                                       const deferred_input_t *input, uint32_t periods) {
    if (!deferred->slow_counts.slow) {
        (void)slow_counts_step(&parameters->slow_counts, &deferred->slow_counts, input->encoder_angle,
                               fixed_magnitude(rotation(parameters, input)), periods);
    }
}

/* Limit of hysteresis control. A step that resets has done enough: the buffer then has the limit of the last but one.
 */
static void limit_currents(const control_parameters_t *parameters, const deferred_input_t *input, bool reset,
                           deferred_results_t *results) {
    if (!reset) {
        results->limit = torque_control_limit(parameters, input->speed_q22);
    }
}

/* A step that resets has done enough: the next one counts what the rotor has turned meanwhile. */
static void follow_position(control_state_t *state, const deferred_input_t *input, bool reset) {
    if (!reset) {
        position_control_follow(state, input);
    }
}

static pwm_ditc_plan_t plan_duty(const control_parameters_t *parameters, const deferred_input_t *input,
                                 const table_scale_factors_t *scale) {
    const pwm_ditc_plan_sample_t sample = {
        .angle = input->regulated_angle,
        .current_q9 = input->regulated_current_q9,
        .reference_q24 = table_scale_multiply(input->torque_reference_q24, scale->inverse_excess_q31),
        .angle_step = rotation(parameters, input) * (int32_t)parameters->commutation.rotor_poles,
    };
    return pwm_ditc_plan(&parameters->duty, &machine_tables, &sample);
}

static const uint8_t turns[] = {DEFERRED_TURNS};
_Static_assert(sizeof turns == DEFERRED_COMMON_PERIODS, "a turn in each step");

/* Jobs of one turn, a constant: their calls are all that is left of the table. */
ALWAYS_INLINE void run_jobs(deferred_turn_t turn, const control_parameters_t *parameters, deferred_t *deferred,
                            const deferred_input_t *input, const int32_t flux_misalignment[HAL_PHASES_MAX]) {
#define JOB(of, call, before, after, writes)                                                                           \
    if (turn == (of)) {                                                                                                \
        call;                                                                                                          \
    }
#include "interrupts/deferred_jobs.def"
#undef JOB
}

/* The position is followed in the shortest turn, which the budget of the interrupts does not feel. */
NOINLINE static void take_turn(const control_parameters_t *parameters, control_state_t *state,
                               const deferred_input_t *input) {
    deferred_t *deferred = &state->deferred;
    const int32_t *flux_misalignment = state->flux_misalignment;
    deferred->turn = (deferred->turn + 1) % DEFERRED_COMMON_PERIODS;
    const deferred_turn_t turn = turns[deferred->turn];
    if (turn == TURN_INERTIA) { /* the longest one is asked for first */
        run_jobs(TURN_INERTIA, parameters, deferred, input, flux_misalignment);
    } else if (turn == TURN_COMMON) {
        run_jobs(TURN_COMMON, parameters, deferred, input, flux_misalignment);
    } else if (turn == TURN_PHASE) {
        run_jobs(TURN_PHASE, parameters, deferred, input, flux_misalignment);
    } else {
        run_jobs(TURN_LOAD, parameters, deferred, input, flux_misalignment);
        position_control_follow(state, input);
    }
}

/* The network learns while the drive runs, and begins anew with each run. */
NOINLINE static void tune_pid(const control_parameters_t *parameters, deferred_t *deferred,
                              const deferred_input_t *input, bool reset, deferred_results_t *results) {
    const bp_pid_parameters_t *pid = &parameters->duty.pid;
    bp_tuner_t *tuner = &deferred->tuner;
    if (reset) {
        bp_tuner_reset(pid, tuner);
    } else if (input->run) {
        bp_tuner_step(pid, tuner, &input->pid);
    }
    UNROLL(3)
    for (unsigned l = 0; l < BP_OUTPUTS; l++) {
        results->pid_gain_q24[l] = tuner->gain_q24[l];
    }
}

void deferred_compute(const control_parameters_t *parameters, control_state_t *state, const command_t *command) {
    const deferred_input_t *input = &state->deferred_request.input;
    deferred_t *deferred = &state->deferred;
    deferred_results_t *results = deferred_buffer(&deferred->response);
    IN_REGISTER(results);
    const uint32_t changed = deferred->generation ^ input->generation;
    const bool reset = changed != 0; /* as in the first step: control_prepare */
    const bool run_reset = (changed & DEFERRED_RUN_MASK) != 0;
    if (reset) {
        follow_resets(parameters, deferred, input);
    }
    results->generation = input->generation;
    results->fault_mask = (uint32_t)protect(parameters, deferred, input) | state->reported_fault_mask;
    position_control_deferred(parameters, state, input, command, results);
    follow_innovation(parameters, deferred, input, results);
    deferred->run = input->run;
    if (!input->run) {
        deferred->updates_since_near = 0;
        deferred->mean_torque_q24 = 0;
        inertia_restart(&parameters->inertia, &parameters->observer, &deferred->inertia, input->electrical);
        await_slow_counts(parameters, deferred, input, input->periods);
        slow_counts_update(&parameters->slow_counts, &deferred->slow_counts, 0);
        limit_currents(parameters, input, reset, results);
        follow_position(state, input, reset);
    } else if (parameters->torque_law != TORQUE_LAW_PREDICTIVE) {
        if (deferred->slow_counts.slow) {
            learn_between_counts(parameters, deferred, input, state->flux_misalignment);
        }
        if (parameters->torque_law == TORQUE_LAW_DUTY) {
            results->duty = plan_duty(parameters, input, &state->table_scale);
        }
        await_slow_counts(parameters, deferred, input, input->periods);
        limit_currents(parameters, input, reset, results);
        follow_position(state, input, reset);
    } else if (!reset) { /* a step that resets has done enough */
        take_turn(parameters, state, input);
    }
    if (parameters->torque_law == TORQUE_LAW_DUTY) {
        tune_pid(parameters, deferred, input, run_reset, results);
    }
    results->observer = deferred->inertia.laws.observer;
    results->predictive.conduction = deferred->conduction.latest;
    UNROLL(4)
    for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
        results->predictive.misalignment[phase] = deferred->misalignment.phase[phase].offset;
    }
}
