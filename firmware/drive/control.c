#include "drive/control.h"

#include "control/phase_map.h"
#include "control/pwm.h"
#include "fixed/fixed.h"

/* Of a 12-bit code: 80 A over 4096 counts is 10 LSB of Q7.9 a count, 512 V is 8 LSB of Q9.6 a count. Exact. */
#define CURRENT_Q9_PER_COUNT (HAL_ADC_CURRENT_FULL_SCALE_A * 512 / (1 << HAL_ADC_BITS_MIN))
#define BUS_VOLTAGE_Q6_PER_COUNT (HAL_ADC_BUS_FULL_SCALE_V * 64 / (1 << HAL_ADC_BITS_MIN))

/* A stop ends below this speed: 0.5 rad/s, 5 r/min. */
#define STANDING_Q22 (1 << 21)

#define DUTY_ONE_Q15 32768

void control_reset(control_state_t *state) {
    *state = (control_state_t){0};
    state_machine_reset(&state->machine);
}

/* What the sensors say, in the formats of the laws. */
typedef struct {
    uint32_t angle; /* 2^-32 turn */
    int32_t current_q9[HAL_PHASES_MAX];
    int32_t current_max_q9;
    int32_t bus_voltage_q6;
    commutation_t commutation;
    int32_t torque_q24[HAL_PHASES_MAX];
    int32_t torque_sum_q24;
} estimate_t;

/* A code in LSBs of which a 12-bit count has so many; finer codes are rounded to nearest, half upwards. */
static int32_t from_code(const control_parameters_t *parameters, uint16_t code, int32_t per_count) {
    const unsigned shift = parameters->adc_bits - (unsigned)HAL_ADC_BITS_MIN;
    return (code * per_count + ((1 << shift) >> 1)) >> shift;
}

static estimate_t estimate(const control_parameters_t *parameters, const control_sample_t *sample) {
    const machine_tables_t *tables = parameters->tables;
    estimate_t e = {.current_max_q9 = 0};
    /* The middle of the count's interval, so that the mean error is zero; a 32-bit encoder has no interval. */
    const unsigned shift = parameters->encoder_shift;
    e.angle = (sample->encoder.counts << shift) + (shift > 0 ? 1u << (shift - 1) : 0u);
    e.bus_voltage_q6 = from_code(parameters, sample->adc.bus_voltage_counts, BUS_VOLTAGE_Q6_PER_COUNT);
    commutation_find(&parameters->commutation, tables->phases, tables->rotor_poles, e.angle, &e.commutation);
    for (unsigned phase = 0; phase < tables->phases; phase++) {
        const int32_t current_q9 = from_code(parameters, sample->adc.phase_current_counts[phase], CURRENT_Q9_PER_COUNT);
        e.current_q9[phase] = current_q9;
        e.current_max_q9 = current_q9 > e.current_max_q9 ? current_q9 : e.current_max_q9;
        if (current_q9 > 0) { /* most of the time a phase has none */
            e.torque_q24[phase] = phase_map_torque_at_q24(tables, e.commutation.angle[phase], current_q9);
            e.torque_sum_q24 = fixed_add(e.torque_sum_q24, e.torque_q24[phase]);
        }
    }
    return e;
}

/* Entering RUN: the laws start afresh, the reference from the present speed. */
static void start_laws(const control_parameters_t *parameters, control_state_t *state) {
    state->speed_reference_q22 = fixed_clamp(state->observer.speed_q22, 0, INT32_MAX);
    speed_pi_reset(&state->speed_pi);
    ditc_hysteresis_reset(&state->hysteresis);
    ditc_duty_reset(&parameters->duty, &state->duty);
}

static void follow_ramp(const control_parameters_t *parameters, control_state_t *state, int32_t target_q22) {
    const int32_t way_q22 = fixed_subtract(target_q22, state->speed_reference_q22);
    state->speed_reference_q22 = fixed_add(
        state->speed_reference_q22, fixed_clamp(way_q22, -parameters->speed_ramp_q22, parameters->speed_ramp_q22));
}

static int32_t regulate_speed(const control_parameters_t *parameters, control_state_t *state) {
    if (parameters->controller == DRIVE_CONTROLLER_TRADITIONAL) {
        return speed_pi_step(&parameters->speed_pi, &state->speed_pi,
                             fixed_subtract(state->speed_reference_q22, state->observer.speed_q22));
    }
    return speed_smc_step(&parameters->speed_smc, state->speed_reference_q22, state->observer.speed_q22,
                          state->observer.load_torque_q24);
}

/* Duty of every phase for a torque reference >= 0. */
static void regulate_torque(const control_parameters_t *parameters, control_state_t *state, const estimate_t *e,
                            int32_t reference_q24, int32_t duty_q15[HAL_PHASES_MAX]) {
    const unsigned phases = parameters->tables->phases;
    const int32_t error_q24 = fixed_subtract(reference_q24, e->torque_sum_q24);
    if (parameters->controller == DRIVE_CONTROLLER_PAPER && parameters->duty.pid.mode != BP_PID_OFF) {
        const ditc_duty_sample_t sample = {
            .current_q9 = e->current_q9,
            .torque_q24 = e->torque_q24,
            .reference_q24 = reference_q24,
            .error_q24 = error_q24,
        };
        ditc_duty_step(&parameters->duty, &state->duty, parameters->tables, &e->commutation, &sample, duty_q15);
        return;
    }
    ditc_hysteresis_step(&parameters->hysteresis, &state->hysteresis, phases, &e->commutation, error_q24,
                         e->current_q9);
    for (unsigned phase = 0; phase < phases; phase++) {
        duty_q15[phase] = state->hysteresis.state[phase] * DUTY_ONE_Q15;
    }
}

static void complete_record(fault_record_t *record, const control_sample_t *sample, const estimate_t *e,
                            const control_diagnostics_t *last) {
    record->time_us = sample->time_us;
    /* Of the last period: what failed may be the encoder, and its angle is in the present estimate. */
    record->speed_q22 = last->speed_q22;
    record->torque_reference_q24 = last->torque_reference_q24;
    record->current_max_q9 = (uint16_t)e->current_max_q9;
    record->bus_voltage_q6 = (uint16_t)e->bus_voltage_q6;
}

bool control_step(const control_parameters_t *parameters, control_state_t *state, const control_sample_t *sample,
                  hal_pwm_compare_t *compare, control_diagnostics_t *diagnostics) {
    const estimate_t e = estimate(parameters, sample);
    state_machine_t *machine = &state->machine;
    const drive_state_t before = machine->state;
    if (!state->started) {
        state->started = true;
        load_observer_reset(&state->observer, e.angle);
        protection_reset(&state->protection, e.angle);
    }
    load_observer_step(&parameters->observer, &state->observer, e.angle, e.torque_sum_q24);

    const protection_sample_t checked = {
        .current_max_q9 = e.current_max_q9,
        .bus_voltage_q6 = e.bus_voltage_q6,
        .speed_q22 = state->observer.speed_q22,
        .angle = e.angle,
        .missed_interrupts = sample->missed_interrupts,
        .command_age_us = sample->time_us - sample->command.time_us,
    };
    const state_machine_input_t input = {
        .checks = protection_check(&parameters->protection, &state->protection, &checked),
        .request = sample->command.request,
        .standing = fixed_abs(state->observer.speed_q22) < STANDING_Q22,
    };
    if (state_machine_step(machine, &input, parameters->initialise_ticks)) {
        complete_record(&machine->record, sample, &e, diagnostics);
    }
    if (before == DRIVE_STATE_FAULT && machine->state == DRIVE_STATE_READY) {
        /* Whatever the encoder did in between, believe it anew. */
        load_observer_reset(&state->observer, e.angle);
    }
    if (before != DRIVE_STATE_RUN && machine->state == DRIVE_STATE_RUN) {
        start_laws(parameters, state);
    }

    const bool run = machine->state == DRIVE_STATE_RUN;
    int32_t torque_reference_q24 = 0;
    *compare = (hal_pwm_compare_t){{0}, {0}};
    bool saturated = false;
    if (run) {
        const bool stopping = sample->command.request != COMMAND_RUN;
        follow_ramp(parameters, state, stopping ? 0 : sample->command.speed_reference_q22);
        /* This drive motors in one direction: less torque than none is not to be had. */
        torque_reference_q24 = fixed_clamp(regulate_speed(parameters, state), 0, INT32_MAX);
        int32_t duty_q15[HAL_PHASES_MAX] = {0};
        regulate_torque(parameters, state, &e, torque_reference_q24, duty_q15);
        for (unsigned phase = 0; phase < parameters->tables->phases; phase++) {
            pwm_set_phase(compare, phase, duty_q15[phase], parameters->period_ticks);
            saturated = saturated || duty_q15[phase] == DUTY_ONE_Q15;
        }
    } else {
        state->speed_reference_q22 = 0;
    }

    diagnostics->angle = e.angle;
    diagnostics->speed_q22 = state->observer.speed_q22;
    diagnostics->speed_reference_q22 = state->speed_reference_q22;
    diagnostics->torque_reference_q24 = torque_reference_q24;
    diagnostics->torque_q24 = e.torque_sum_q24;
    diagnostics->load_torque_q24 = state->observer.load_torque_q24;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        diagnostics->current_q9[phase] = (uint16_t)e.current_q9[phase];
    }
    diagnostics->bus_voltage_q6 = (uint16_t)e.bus_voltage_q6;
    diagnostics->duty_q15 = (int32_t)fixed_shift(state->duty.pid.duty_q30, 15);
    diagnostics->voltage_saturated = saturated;
    return run;
}
