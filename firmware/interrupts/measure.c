#include "interrupts/measure.h"

#include "control/applied_flux.h"
#include "control/phase_map.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"

/* Product of counts and scale, rounded to nearest, halves upwards. Saturated to 16 bits, which only a scale that has
 * changed in memory exceeds: the look-ups stay within the tables until the self-test finds it. */
static int32_t scale_counts(uint16_t counts, int32_t scale_q18) {
    return fixed_saturate_u16(fixed_multiply_high(counts << 14, scale_q18));
}

/* The angle of the count that is nearest to the predicted one. The last edge was exact, and since then the count is
 * only a limit: its middle would draw the estimate away from what the edges have told. */
static uint32_t nearest_in_count(const control_parameters_t *parameters, const load_observer_t *observer,
                                 uint32_t count_start) {
    const int32_t predicted = (int32_t)((uint32_t)(observer->angle_q64 >> 32) - count_start);
    const int32_t last = (int32_t)((1u << parameters->encoder_shift) - 1);
    return count_start + (uint32_t)fixed_clamp(predicted, 0, last);
}

static void measure_angle(const control_parameters_t *parameters, const load_observer_t *observer,
                          const slow_counts_results_t *slow_counts, const hal_encoder_sample_t *encoder,
                          control_measurement_t *measured) {
    const uint32_t count_start = encoder->counts << parameters->encoder_shift;
    measured->encoder_angle = count_start;
    measured->predicted_speed_q22 = observer->speed_q22;
    if (!encoder->edge_known) {
        measured->angle_from_edge = false;
        measured->angle = slow_counts->slow
                              ? slow_counts_angle(slow_counts, observer, count_start, parameters->encoder_shift)
                              : count_start + parameters->encoder_middle; /* its mean error is zero */
        return;
    }
    if (encoder->edge_age_ticks > parameters->edge_age_max_ticks) {
        measured->angle_from_edge = false;
        measured->angle = nearest_in_count(parameters, observer, count_start);
        return;
    }
    measured->angle_from_edge = true;
    const uint32_t edge = encoder->edge_forward ? count_start : count_start + (1u << parameters->encoder_shift);
    const int32_t angle_per_tick_q19 = fixed_multiply_high(observer->speed_q22, parameters->edge_angle_per_tick_q51);
    measured->angle = edge + (uint32_t)fixed_multiply_high(
                                 angle_per_tick_q19, (int32_t)(encoder->edge_age_ticks << parameters->edge_age_shift));
}

/* Currents of the phases, the largest one, and the flux linkage that the voltage builds up in the period that now
 * begins, for the background's monitor of the phases; a period in which the run ends counts as one of the run. In one
 * loop, which saves a load for each phase. */
static void measure_phases(const control_parameters_t *parameters, const control_sample_t *sample,
                           control_state_t *state) {
    control_measurement_t *measured = &state->measurement;
    const applied_flux_period_t period =
        applied_flux_period(measured->dc_link_voltage_q6, parameters->predictive.period_q40,
                            parameters->predictive.flux.resistance_period_q40, machine_tables.current_range_q9);
    const int32_t scale_q18 = parameters->current_scale_q18;
    const unsigned phases = machine_tables.phases;
    int32_t max_q9 = 0;
    UNROLL(4)
    for (unsigned phase = 0; phase < phases; phase++) {
        const int32_t current_q9 = scale_counts(sample->adc->phase_current_counts[phase], scale_q18);
        measured->current_q9[phase] = current_q9;
        /* No current is below 0. */
        max_q9 = phase == 0 ? current_q9 : fixed_max(current_q9, max_q9);
        applied_flux_step(&state->applied_flux, &period, phase, state->duty_q15[phase], current_q9);
    }
    measured->current_max_q9 = max_q9;
}

void measure(const control_parameters_t *parameters, control_state_t *state, const deferred_results_t *deferred,
             const control_sample_t *sample) {
    control_measurement_t *measured = &state->measurement;
    measure_angle(parameters, &state->observer, &deferred->slow_counts, &sample->encoder, measured);
    measured->commutation.electrical = commutation_electrical(&parameters->commutation, measured->angle);
    measured->dc_link_voltage_q6 = scale_counts(sample->adc->bus_voltage_counts, parameters->voltage_scale_q18);
    measure_phases(parameters, sample, state);
}

/* Sum of the torques of the phases by the machine's tables, in their units. */
static int32_t torque_by_map(const control_parameters_t *parameters, const int32_t misalignment[HAL_PHASES_MAX],
                             control_measurement_t *measured) {
    int32_t sum = 0;
    const unsigned phases = machine_tables.phases;
    UNROLL(4)
    for (unsigned phase = 0; phase < phases; phase++) {
        const int32_t current_q9 = measured->current_q9[phase];
        int32_t torque = 0;
        if (LIKELY(current_q9 > 0)) { /* though false for most phases at any time */
            const uint32_t angle = commutation_angle(&parameters->commutation, &measured->commutation, phase);
            torque = phase_map_torque(&machine_tables, angle - (uint32_t)misalignment[phase], current_q9);
            sum = fixed_add(sum, torque);
        }
        measured->torque[phase] = torque;
    }
    return sum;
}

/* The same of the planned cells, and the flux linkage of each phase. */
static int32_t torque_by_plan(const predictive_torque_t *predictive, control_measurement_t *measured) {
    int32_t sum = 0;
    const phase_cell_t *cells = predictive_torque_cells(predictive);
    const unsigned phases = machine_tables.phases;
    UNROLL(4)
    for (unsigned phase = 0; phase < phases; phase++) {
        const int32_t current_q9 = measured->current_q9[phase];
        int32_t flux = 0;
        if (current_q9 > 0) { /* false for most phases at any time */
            sum = fixed_add(sum, predictive_torque_estimate(&cells[phase], current_q9, &flux));
        }
        measured->flux_linkage[phase] = flux;
    }
    return sum;
}

void measure_torque(const control_parameters_t *parameters, control_state_t *state,
                    const int32_t misalignment[HAL_PHASES_MAX], bool failed) {
    control_measurement_t *measured = &state->measurement;
    int32_t sum = 0;
    if (parameters->torque_law == TORQUE_LAW_PREDICTIVE) {
        sum = torque_by_plan(&state->predictive, measured);
    } else if (!failed) {
        sum = torque_by_map(parameters, misalignment, measured);
    }
    measured->torque_sum_q24 =
        table_scale_multiply(phase_map_scale(&machine_tables.torque_format, sum), state->table_scale.excess_q31);
}
