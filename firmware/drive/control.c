#include "drive/control.h"

#include "control/phase_map.h"
#include "control/modulator.h"
#include "fixed/fixed.h"

/* A stop ends below this speed: 0.5 rad/s, 5 r/min. */
#define STANDING_Q22 (1 << 21)

/* A tick over 2 pi, in 2^-32 turn per rad/s Q9.22, Q51. */
#define TURN_PER_TICK_Q51 1834931565

/* Two periods at 20 kHz. */
#define EDGE_AGE_MAX_TICKS 20000

/* The transducer's codes are offset binary, +-64 N m: 2^31 of Q7.24 over all of them. */
static int32_t load_torque_q24(const control_parameters_t *parameters, uint16_t code) {
    const unsigned bits = parameters->adc_bits;
    return (code - (1 << (bits - 1))) * (1 << (31 - bits));
}

void control_reset(const control_parameters_t *parameters, control_state_t *state) {
    *state = (control_state_t){0};
    state_machine_reset(&state->machine);
    control_prepare(parameters, state);
}

/* A code in the LSBs of the scale, rounded to nearest, half upwards: below 2^16. Nothing but code 0 gives 0. */
static int32_t from_code(uint16_t code, int32_t scale_q18) {
    return fixed_multiply_high(code << 14, scale_q18);
}

/* The measured angle. Behind an edge the rotor turned on at the observer's speed; an edge of long ago says less than
 * the count does. */
static void measure_angle(const control_parameters_t *parameters, const hal_encoder_sample_t *encoder,
                          int32_t speed_q22, control_estimate_t *e) {
    const uint32_t count = encoder->counts << parameters->encoder_shift;
    e->count_angle = count;
    if (!encoder->edge_known || encoder->edge_age_ticks > EDGE_AGE_MAX_TICKS) {
        /* The middle of the count's interval, so that the mean error is zero. */
        e->angle = count + parameters->encoder_middle;
        e->from_edge = false;
        return;
    }
    const uint32_t edge = encoder->edge_forward ? count : count + (1u << parameters->encoder_shift);
    const int32_t turn_per_tick_q19 = fixed_multiply_high(speed_q22, TURN_PER_TICK_Q51);
    e->angle = edge + (uint32_t)fixed_shift((int64_t)turn_per_tick_q19 * (int32_t)encoder->edge_age_ticks, 19);
    e->from_edge = true;
}

/* Of one phase, 2^-32 pitch, by its own pole. */
static uint32_t phase_angle(const control_parameters_t *parameters, const control_state_t *state, unsigned phase) {
    const uint32_t offset = (uint32_t)state->misalignment.phase[phase].offset;
    return commutation_angle(&parameters->commutation, &state->estimate.commutation, phase) - offset;
}

/* Torque in N m, Q7.24, and flux linkage in Wb, Q2.29. As phase_map_torque_at_q24(), a function of its own. */
__attribute__((noinline)) static int32_t torque_and_flux(const machine_tables_t *tables, uint32_t angle,
                                                         int32_t current_q9, int32_t *flux_q29) {
    const phase_map_lookup_t place = phase_map_lookup(tables, angle);
    *flux_q29 = phase_map_flux_q29(&place, current_q9);
    return phase_map_torque_q24(&place, current_q9);
}

/* Currents and torques, and the flux linkages where they are asked for: of a constant, so that who does not ask has
 * nothing of it in the loop. */
__attribute__((always_inline)) static inline void estimate_phases(const control_parameters_t *parameters,
                                                                  control_state_t *state, const hal_adc_sample_t *adc,
                                                                  bool with_flux) {
    const machine_tables_t *tables = parameters->tables;
    control_estimate_t *e = &state->estimate;
    int32_t current_max_q9 = 0;
    int32_t torque_sum_q24 = 0;
    const unsigned phases = tables->phases;
    for (unsigned phase = 0; phase < phases; phase++) {
        const uint16_t code = adc->phase_current_counts[phase];
        e->current_q9[phase] = 0;
        e->torque_q24[phase] = 0;
        if (with_flux) {
            e->flux_q29[phase] = 0;
        }
        if (code == 0) { /* most of the time a phase has none */
            continue;
        }
        /* Every code's current is on the map. */
        const int32_t current_q9 = from_code(code, parameters->current_scale_q18);
        const uint32_t angle = phase_angle(parameters, state, phase);
        const int32_t torque_q24 = with_flux ? torque_and_flux(tables, angle, current_q9, &e->flux_q29[phase])
                                             : phase_map_torque_at_q24(tables, angle, current_q9);
        torque_sum_q24 = fixed_add(torque_sum_q24, torque_q24);
        current_max_q9 = current_q9 > current_max_q9 ? current_q9 : current_max_q9;
        e->current_q9[phase] = current_q9;
        e->torque_q24[phase] = torque_q24;
    }
    e->current_max_q9 = current_max_q9;
    e->torque_sum_q24 = torque_sum_q24;
}

static void estimate(const control_parameters_t *parameters, control_state_t *state, const control_sample_t *sample) {
    control_estimate_t *e = &state->estimate;
    measure_angle(parameters, &sample->encoder, state->observer.speed_q22, e);
    e->bus_voltage_q6 = from_code(sample->adc.bus_voltage_counts, parameters->voltage_scale_q18);
    commutation_find(&parameters->commutation, e->angle, &e->commutation);
    if (parameters->controller == DRIVE_CONTROLLER_SALIENT) {
        estimate_phases(parameters, state, &sample->adc, true);
    } else {
        estimate_phases(parameters, state, &sample->adc, false);
    }
}

void control_prepare(const control_parameters_t *parameters, control_state_t *state) {
    speed_pi_reset(&state->speed_pi);
    ditc_hysteresis_reset(&state->hysteresis);
    predictive_torque_reset(&state->predictive);
    if (parameters->controller == DRIVE_CONTROLLER_SALIENT) {
        torque_trim_reset(&parameters->trim, &state->trim, 0);
    }
    if (parameters->controller == DRIVE_CONTROLLER_PAPER) {
        pwm_ditc_reset(&parameters->duty, &state->duty);
    } else {
        bp_pid_clear_telemetry(&state->duty.pid);
    }
}

static void follow_ramp(const control_parameters_t *parameters, control_state_t *state, int32_t target_q22) {
    const int32_t way_q22 = fixed_subtract(target_q22, state->speed_reference_q22);
    if (way_q22 == 0) {
        return;
    }
    state->speed_reference_q22 = fixed_add(
        state->speed_reference_q22, fixed_clamp(way_q22, -parameters->speed_ramp_q22, parameters->speed_ramp_q22));
}

/* Torque reference of the sliding mode. */
static int32_t slide(const control_parameters_t *parameters, const control_state_t *state,
                     const hal_adc_sample_t *adc) {
    const int32_t load_q24 = parameters->load_from_transducer ? load_torque_q24(parameters, adc->load_torque_counts)
                                                              : state->observer.load_torque_q24;
    return speed_smc_step(&parameters->speed_smc, state->speed_reference_q22, state->observer.speed_q22, load_q24);
}

/* Compare values by hysteresis. */
static void switch_by_state(const control_parameters_t *parameters, control_state_t *state, int32_t reference_q24,
                            hal_pwm_compare_t *compare) {
    const control_estimate_t *e = &state->estimate;
    const int32_t error_q24 = fixed_subtract(reference_q24, e->torque_sum_q24);
    ditc_hysteresis_step(&parameters->hysteresis, &state->hysteresis, &e->commutation, error_q24, e->current_q9);
    /* The other phases are open. */
    const unsigned active = e->commutation.active;
    const unsigned outgoing = e->commutation.outgoing;
    if (outgoing != COMMUTATION_NONE) {
        pwm_set_state(compare, outgoing, state->hysteresis.state[outgoing], parameters->period_ticks);
    }
    if (active != COMMUTATION_NONE) {
        pwm_set_state(compare, active, state->hysteresis.state[active], parameters->period_ticks);
    }
}

/* Compare values by the BP-PID's duty. */
static void switch_by_duty(const control_parameters_t *parameters, control_state_t *state, int32_t reference_q24,
                           hal_pwm_compare_t *compare) {
    const control_estimate_t *e = &state->estimate;
    const pwm_ditc_sample_t sample = {
        .current_q9 = e->current_q9,
        .torque_q24 = e->torque_q24,
        .reference_q24 = reference_q24,
        .error_q24 = fixed_subtract(reference_q24, e->torque_sum_q24),
    };
    pwm_ditc_step(&parameters->duty, &state->duty, &e->commutation, &sample, state->duty_q15);
    for (unsigned phase = 0; phase < parameters->tables->phases; phase++) {
        pwm_set_phase(compare, phase, state->duty_q15[phase], parameters->period_ticks);
    }
}

/* Salient: compare values for a torque reference of either sign. The observer stands at the coming sample. A function
 * of its own: its stack and its registers would cost the other controllers. */
__attribute__((noinline)) static void predict_torque(const control_parameters_t *parameters, control_state_t *state,
                                                     int32_t reference_q24, hal_pwm_compare_t *compare) {
    const machine_tables_t *tables = parameters->tables;
    const load_observer_t *observer = &state->observer;
    const control_estimate_t *e = &state->estimate;
    const bool runs_out = state->predictive.torque_shortfall_q24 != 0;
    const int32_t slip_q22 = fixed_abs(fixed_subtract(state->speed_reference_q22, observer->speed_q22));
    /* From the sample to two periods behind it: to the observer's angle and one period on. */
    const int32_t step = fixed_multiply_high(observer->speed_q22, parameters->observer.angle_step_q32);
    const uint32_t ahead =
        ((uint32_t)(observer->angle_q64 >> 32) + (uint32_t)step - e->angle) * parameters->commutation.rotor_poles;
    uint32_t angle[HAL_PHASES_MAX], angle_ahead[HAL_PHASES_MAX];
    for (unsigned phase = 0; phase < tables->phases; phase++) {
        angle[phase] = phase_angle(parameters, state, phase);
        angle_ahead[phase] = angle[phase] + ahead;
    }
    const misalignment_sample_t learned = {
        .current_q9 = e->current_q9,
        .angle = angle,
        .torque_q24 = reference_q24,
        .steady = observer_bandwidth_steady(&parameters->bandwidth, &state->bandwidth) &&
                  slip_q22 < fixed_abs(observer->speed_q22) / 64 && !runs_out,
    };
    misalignment_step(&parameters->misalignment, &state->misalignment, tables, observer, &learned);

    const predictive_torque_sample_t sample = {
        .current_q9 = e->current_q9,
        .flux_q29 = e->flux_q29,
        .angle = angle_ahead,
        .bus_voltage_q6 = e->bus_voltage_q6,
        .torque_q24 = torque_trim_step(&parameters->trim, &state->trim, reference_q24, e->torque_sum_q24, runs_out),
        .reverse = observer->speed_q22 < 0,
        .angle_step = (uint32_t)fixed_abs(step) * parameters->commutation.rotor_poles,
    };
    predictive_torque_step(&parameters->predictive, &state->predictive, tables, &sample, state->duty_q15);
    for (unsigned phase = 0; phase < tables->phases; phase++) {
        if (parameters->two_pulses) {
            pwm_set_phase_twice(compare, phase, state->duty_q15[phase], parameters->period_ticks);
        } else {
            pwm_set_phase(compare, phase, state->duty_q15[phase], parameters->period_ticks);
        }
    }
}

__attribute__((cold)) static void complete_record(fault_record_t *record, const control_sample_t *sample,
                                                  const control_state_t *state, int32_t speed_q22) {
    record->time_us = sample->time_us;
    /* Of the last period: what failed may be the encoder, and its angle is in the present estimate. */
    record->speed_q22 = speed_q22;
    record->torque_reference_q24 = state->torque_reference_q24;
    record->current_max_q9 = (uint16_t)state->estimate.current_max_q9;
    record->bus_voltage_q6 = (uint16_t)state->estimate.bus_voltage_q6;
}

/* The first sample: what the observer and the checks start from. */
__attribute__((cold)) static void start(control_state_t *state) {
    state->started = true;
    load_observer_reset(&state->observer, state->estimate.angle);
    observer_bandwidth_reset(&state->bandwidth);
    protection_reset(&state->protection, state->estimate.count_angle);
}

/* What a change of the drive's state asks for. */
__attribute__((cold)) static void enter(const control_parameters_t *parameters, control_state_t *state,
                                        drive_state_t before) {
    if (before == DRIVE_STATE_FAULT) {
        /* Whatever the encoder did in between, believe it anew. */
        load_observer_reset(&state->observer, state->estimate.angle);
        observer_bandwidth_reset(&state->bandwidth);
    }
    if (before == DRIVE_STATE_RUN) {
        control_prepare(parameters, state);
    }
    if (state->machine.state == DRIVE_STATE_RUN) {
        /* From the present speed. */
        const bool reverses = parameters->controller == DRIVE_CONTROLLER_SALIENT;
        state->speed_reference_q22 = fixed_clamp(state->observer.speed_q22, reverses ? INT32_MIN : 0, INT32_MAX);
    }
}

bool control_step(const control_parameters_t *parameters, control_state_t *state, const control_sample_t *sample,
                  hal_pwm_compare_t *compare) {
    estimate(parameters, state, sample);
    const control_estimate_t *e = &state->estimate;
    if (!state->started) {
        start(state);
    }
    const int32_t last_speed_q22 = state->observer.speed_q22;
    const int32_t innovation = load_observer_innovation(&state->observer, e->angle);
    const load_observer_gains_t *gains =
        observer_bandwidth_step(&parameters->bandwidth, &state->bandwidth, innovation, e->from_edge);
    load_observer_step(&parameters->observer, gains, &state->observer, innovation, e->torque_sum_q24);

    const protection_sample_t checked = {
        .current_max_q9 = e->current_max_q9,
        .bus_voltage_q6 = e->bus_voltage_q6,
        .speed_q22 = state->observer.speed_q22,
        .angle = e->count_angle,
        .missed_interrupts = sample->missed_interrupts,
        .command_age_us = sample->time_us - sample->command.time_us,
    };
    const command_request_t request = sample->command.request;
    const state_machine_input_t input = {
        .checks = protection_check(&parameters->protection, &state->protection, &checked),
        .request = request,
        .standing = request == COMMAND_STOP && fixed_abs(state->observer.speed_q22) < STANDING_Q22,
    };
    const drive_state_t before = state->machine.state;
    if (state_machine_step(&state->machine, &input, parameters->initialise_ticks)) {
        complete_record(&state->machine.record, sample, state, last_speed_q22);
    }
    if (state->machine.state != before) {
        enter(parameters, state, before);
    }

    *compare = (hal_pwm_compare_t){{0}, {0}};
    if (state->machine.state != DRIVE_STATE_RUN) {
        state->speed_reference_q22 = 0;
        state->torque_reference_q24 = 0;
        return false;
    }
    const int32_t asked_q22 = request == COMMAND_RUN ? sample->command.speed_reference_q22 : 0;
    if (parameters->controller == DRIVE_CONTROLLER_SALIENT) {
        follow_ramp(parameters, state, asked_q22);
        state->torque_reference_q24 = slide(parameters, state, &sample->adc);
        predict_torque(parameters, state, state->torque_reference_q24, compare);
        return true;
    }
    /* The others motor in one direction: less torque than none is not to be had. */
    follow_ramp(parameters, state, fixed_clamp(asked_q22, 0, INT32_MAX));
    const bool paper = parameters->controller == DRIVE_CONTROLLER_PAPER;
    const int32_t torque_q24 =
        paper ? slide(parameters, state, &sample->adc)
              : speed_pi_step(&parameters->speed_pi, &state->speed_pi,
                              fixed_subtract(state->speed_reference_q22, state->observer.speed_q22));
    state->torque_reference_q24 = fixed_clamp(torque_q24, 0, INT32_MAX);
    if (control_gives_duties(parameters)) {
        switch_by_duty(parameters, state, state->torque_reference_q24, compare);
    } else {
        switch_by_state(parameters, state, state->torque_reference_q24, compare);
    }
    return true;
}
