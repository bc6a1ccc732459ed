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

/* A tick over 2 pi, in 2^-32 turn per rad/s Q9.22, Q44. */
#define TURN_PER_TICK_Q44 INT64_C(14335402)

/* Two periods at 20 kHz. */
#define EDGE_AGE_MAX_TICKS 20000

/* The transducer's codes are offset binary, +-64 N m: 2^31 of Q7.24 over all of them. */
static int32_t load_torque_q24(const control_parameters_t *parameters, uint16_t code) {
    const unsigned bits = parameters->adc_bits;
    return (code - (1 << (bits - 1))) * (1 << (31 - bits));
}

void control_reset(control_state_t *state) {
    *state = (control_state_t){0};
    state_machine_reset(&state->machine);
}

/* What the sensors say, in the formats of the laws. */
typedef struct {
    uint32_t angle; /* 2^-32 turn */
    bool from_edge; /* the angle is that of an edge and its time */
    int32_t current_q9[HAL_PHASES_MAX];
    int32_t current_max_q9;
    int32_t bus_voltage_q6;
    commutation_t commutation; /* its angles less the phases' misalignment */
    int32_t torque_q24[HAL_PHASES_MAX];
    int32_t torque_sum_q24;
    int32_t flux_q29[HAL_PHASES_MAX]; /* salient controller */
} estimate_t;

/* A code in LSBs of which a 12-bit count has so many; finer codes are rounded to nearest, half upwards. */
static int32_t from_code(const control_parameters_t *parameters, uint16_t code, int32_t per_count) {
    const unsigned shift = parameters->adc_bits - (unsigned)HAL_ADC_BITS_MIN;
    return (code * per_count + ((1 << shift) >> 1)) >> shift;
}

/* The measured angle and whether it is an edge's; 2^-32 turn. Behind an edge the rotor turned on at the observer's
 * speed; an edge of long ago says less than the count does. */
static bool measure_angle(const control_parameters_t *parameters, const hal_encoder_sample_t *encoder,
                          int32_t speed_q22, uint32_t *angle) {
    const unsigned shift = parameters->encoder_shift;
    if (!encoder->edge_known || encoder->edge_age_ticks > EDGE_AGE_MAX_TICKS) {
        /* The middle of the count's interval, so that the mean error is zero; a 32-bit encoder has no interval. */
        *angle = (encoder->counts << shift) + (shift > 0 ? 1u << (shift - 1) : 0u);
        return false;
    }
    const uint32_t edge = (encoder->edge_forward ? encoder->counts : encoder->counts + 1) << shift;
    const int64_t way_q6 = ((int64_t)speed_q22 * (int32_t)encoder->edge_age_ticks) >> 16; /* 31 + 15 bits */
    *angle = edge + (uint32_t)fixed_shift(way_q6 * TURN_PER_TICK_Q44, 28);
    return true;
}

/* Written in place, what is not needed not at all: clearing and copying it costs more than some laws do. */
static void estimate(const control_parameters_t *parameters, const control_state_t *state,
                     const control_sample_t *sample, estimate_t *e) {
    const machine_tables_t *tables = parameters->tables;
    const bool salient = parameters->controller == DRIVE_CONTROLLER_SALIENT;
    const unsigned phases = tables->phases;
    e->from_edge = measure_angle(parameters, &sample->encoder, state->observer.speed_q22, &e->angle);
    e->bus_voltage_q6 = from_code(parameters, sample->adc.bus_voltage_counts, BUS_VOLTAGE_Q6_PER_COUNT);
    commutation_find(&parameters->commutation, phases, tables->rotor_poles, e->angle, &e->commutation);
    int32_t current_max_q9 = 0;
    int32_t torque_sum_q24 = 0;
    for (unsigned phase = 0; phase < phases; phase++) {
        const int32_t current_q9 = from_code(parameters, sample->adc.phase_current_counts[phase], CURRENT_Q9_PER_COUNT);
        int32_t torque_q24 = 0;
        int32_t flux_q29 = 0;
        e->commutation.angle[phase] -= (uint32_t)state->misalignment.phase[phase].offset;
        if (current_q9 > 0) { /* most of the time a phase has none */
            const phase_map_place_t place = phase_map_at(tables, e->commutation.angle[phase]);
            torque_q24 = phase_map_torque_q24(&place, current_q9);
            torque_sum_q24 = fixed_add(torque_sum_q24, torque_q24);
            current_max_q9 = current_q9 > current_max_q9 ? current_q9 : current_max_q9;
            if (salient) {
                flux_q29 = phase_map_flux_q29(&place, current_q9);
            }
        }
        e->current_q9[phase] = current_q9;
        e->torque_q24[phase] = torque_q24;
        e->flux_q29[phase] = flux_q29;
    }
    for (unsigned phase = phases; phase < HAL_PHASES_MAX; phase++) {
        e->current_q9[phase] = 0; /* for whoever watches */
    }
    e->current_max_q9 = current_max_q9;
    e->torque_sum_q24 = torque_sum_q24;
}

/* Entering RUN: the laws start afresh, the reference from the present speed. */
static void start_laws(const control_parameters_t *parameters, control_state_t *state) {
    const bool reverses = parameters->controller == DRIVE_CONTROLLER_SALIENT;
    state->speed_reference_q22 = fixed_clamp(state->observer.speed_q22, reverses ? INT32_MIN : 0, INT32_MAX);
    speed_pi_reset(&state->speed_pi);
    ditc_hysteresis_reset(&state->hysteresis);
    predictive_torque_reset(&state->predictive);
    /* A network is the dearest to start afresh: only the one that will be asked. */
    if (reverses) {
        torque_trim_reset(&parameters->trim, &state->trim, 0);
    }
    if (parameters->controller == DRIVE_CONTROLLER_PAPER) {
        ditc_duty_reset(&parameters->duty, &state->duty);
    } else {
        bp_pid_show_none(&state->duty.pid);
    }
}

static void follow_ramp(const control_parameters_t *parameters, control_state_t *state, int32_t target_q22) {
    const int32_t way_q22 = fixed_subtract(target_q22, state->speed_reference_q22);
    state->speed_reference_q22 = fixed_add(
        state->speed_reference_q22, fixed_clamp(way_q22, -parameters->speed_ramp_q22, parameters->speed_ramp_q22));
}

static int32_t regulate_speed(const control_parameters_t *parameters, control_state_t *state,
                              const hal_adc_sample_t *adc) {
    if (parameters->controller == DRIVE_CONTROLLER_TRADITIONAL) {
        return speed_pi_step(&parameters->speed_pi, &state->speed_pi,
                             fixed_subtract(state->speed_reference_q22, state->observer.speed_q22));
    }
    const int32_t load_q24 = parameters->load_from_transducer ? load_torque_q24(parameters, adc->load_torque_counts)
                                                              : state->observer.load_torque_q24;
    return speed_smc_step(&parameters->speed_smc, state->speed_reference_q22, state->observer.speed_q22, load_q24);
}

/* Traditional and paper: duty of every phase for a torque reference >= 0. */
static void switch_by_torque(const control_parameters_t *parameters, control_state_t *state, const estimate_t *e,
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

/* Salient: duty of every phase for a torque reference of either sign. The observer stands at the coming sample. */
static void predict_torque(const control_parameters_t *parameters, control_state_t *state, const estimate_t *e,
                           int32_t reference_q24, int32_t duty_q15[HAL_PHASES_MAX]) {
    const machine_tables_t *tables = parameters->tables;
    const load_observer_t *observer = &state->observer;
    const bool runs_out = state->predictive.missing_q24 != 0;
    const int32_t slip_q22 = fixed_abs(fixed_subtract(state->speed_reference_q22, observer->speed_q22));
    const misalignment_sample_t learned = {
        .current_q9 = e->current_q9,
        .angle = e->commutation.angle,
        .torque_q24 = reference_q24,
        .steady =
            observer_bandwidth_steady(&state->bandwidth) && slip_q22 < fixed_abs(observer->speed_q22) / 64 && !runs_out,
    };
    misalignment_step(&parameters->misalignment, &state->misalignment, tables, observer, &learned);

    /* From the sample to two periods behind it: to the observer's angle and one period on. */
    const uint32_t step = (uint32_t)fixed_shift((int64_t)observer->speed_q22 * parameters->observer.angle_step_q32, 32);
    const uint32_t ahead = ((uint32_t)(observer->angle_q64 >> 32) + step - e->angle) * tables->rotor_poles;
    uint32_t angle[HAL_PHASES_MAX];
    for (unsigned phase = 0; phase < tables->phases; phase++) {
        angle[phase] = e->commutation.angle[phase] + ahead;
    }
    const predictive_torque_sample_t sample = {
        .current_q9 = e->current_q9,
        .flux_q29 = e->flux_q29,
        .angle = angle,
        .bus_voltage_q6 = e->bus_voltage_q6,
        .torque_q24 = torque_trim_step(&parameters->trim, &state->trim, reference_q24, e->torque_sum_q24, runs_out),
        .backwards = observer->speed_q22 < 0,
        .turn = (uint32_t)fixed_abs((int32_t)step) * tables->rotor_poles,
    };
    predictive_torque_step(&parameters->predictive, &state->predictive, tables, &sample, duty_q15);
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
    estimate_t e;
    estimate(parameters, state, sample, &e);
    const uint32_t count_angle = sample->encoder.counts << parameters->encoder_shift;
    state_machine_t *machine = &state->machine;
    const drive_state_t before = machine->state;
    if (!state->started) {
        state->started = true;
        load_observer_reset(&state->observer, e.angle);
        observer_bandwidth_reset(&state->bandwidth);
        protection_reset(&state->protection, count_angle);
    }
    const int32_t innovation = load_observer_innovation(&state->observer, e.angle);
    const load_observer_gains_t *gains =
        observer_bandwidth_step(&parameters->bandwidth, &state->bandwidth, innovation, e.from_edge);
    load_observer_step(&parameters->observer, gains, &state->observer, innovation, e.torque_sum_q24);

    const protection_sample_t checked = {
        .current_max_q9 = e.current_max_q9,
        .bus_voltage_q6 = e.bus_voltage_q6,
        .speed_q22 = state->observer.speed_q22,
        .angle = count_angle,
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
        observer_bandwidth_reset(&state->bandwidth);
    }
    if (before != DRIVE_STATE_RUN && machine->state == DRIVE_STATE_RUN) {
        start_laws(parameters, state);
    }

    const bool run = machine->state == DRIVE_STATE_RUN;
    const bool salient = parameters->controller == DRIVE_CONTROLLER_SALIENT;
    int32_t torque_reference_q24 = 0;
    *compare = (hal_pwm_compare_t){{0}, {0}};
    bool saturated = false;
    if (run) {
        const bool stopping = sample->command.request != COMMAND_RUN;
        const int32_t asked_q22 = sample->command.speed_reference_q22;
        follow_ramp(parameters, state, stopping || (asked_q22 < 0 && !salient) ? 0 : asked_q22);
        torque_reference_q24 = regulate_speed(parameters, state, &sample->adc);
        int32_t duty_q15[HAL_PHASES_MAX] = {0};
        if (salient) {
            predict_torque(parameters, state, &e, torque_reference_q24, duty_q15);
            saturated = state->predictive.missing_q24 != 0;
        } else {
            /* These motor in one direction: less torque than none is not to be had. */
            torque_reference_q24 = fixed_clamp(torque_reference_q24, 0, INT32_MAX);
            switch_by_torque(parameters, state, &e, torque_reference_q24, duty_q15);
        }
        for (unsigned phase = 0; phase < parameters->tables->phases; phase++) {
            if (salient && parameters->two_pulses) {
                pwm_set_phase_twice(compare, phase, duty_q15[phase], parameters->period_ticks);
            } else {
                pwm_set_phase(compare, phase, duty_q15[phase], parameters->period_ticks);
            }
            saturated = saturated || (!salient && duty_q15[phase] == DUTY_ONE_Q15);
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
    diagnostics->duty_q15 = (state->duty.pid.duty_q23 + (1 << 7)) >> 8;
    diagnostics->voltage_saturated = saturated;
    diagnostics->trim_torque_q24 = run && salient ? state->trim.trim_q24 : 0;
    diagnostics->torque_missing_q24 = run && salient ? state->predictive.missing_q24 : 0;
    diagnostics->observer_bandwidth_rad_s = parameters->bandwidth.bandwidth_rad_s[state->bandwidth.stage];
    return run;
}
