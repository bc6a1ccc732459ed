#include "drive/measure.h"

#include "control/phase_map.h"
#include "fixed/compiler.h"
#include "fixed/fixed.h"

/* 5 ns / (2 pi): rotation per tick, 2^-32 rev per rad/s Q9.22, in Q51. */
#define ANGLE_PER_TICK_Q51 1834931565

/* The count is the better measurement once an edge is older than this: two periods at 20 kHz. */
#define EDGE_AGE_MAX_TICKS 20000

/* Product of counts and scale, rounded to nearest, halves upwards; below 2^16. */
static int32_t scale_counts(uint16_t counts, int32_t scale_q18) {
    return fixed_multiply_high(counts << 14, scale_q18);
}

static void measure_angle(const control_parameters_t *parameters, const load_observer_t *observer,
                          const hal_encoder_sample_t *encoder, control_measurement_t *measured) {
    const uint32_t count_start = encoder->counts << parameters->encoder_shift;
    measured->encoder_angle = count_start;
    measured->predicted_speed_q22 = observer->speed_q22;
    measured->angle_from_edge = encoder->edge_known && encoder->edge_age_ticks <= EDGE_AGE_MAX_TICKS;
    if (!measured->angle_from_edge) {
        /* The middle of the count: its mean error is zero. */
        measured->angle = count_start + parameters->encoder_middle;
        return;
    }
    const uint32_t edge = encoder->edge_forward ? count_start : count_start + (1u << parameters->encoder_shift);
    const int32_t angle_per_tick_q19 = fixed_multiply_high(observer->speed_q22, ANGLE_PER_TICK_Q51);
    measured->angle = edge + (uint32_t)fixed_shift((int64_t)angle_per_tick_q19 * (int32_t)encoder->edge_age_ticks, 19);
}

void measure(const control_parameters_t *parameters, const load_observer_t *observer,
             const int32_t misalignment[HAL_PHASES_MAX], const predictive_torque_t *predictive,
             const control_sample_t *sample, control_measurement_t *measured) {
    measure_angle(parameters, observer, &sample->encoder, measured);
    measured->dc_link_voltage_q6 = scale_counts(sample->adc.bus_voltage_counts, parameters->voltage_scale_q18);
    const machine_tables_t *tables = (&machine_tables);
    const unsigned phases = tables->phases;
    const bool planned = parameters->torque_law == TORQUE_LAW_PREDICTIVE;
    if (planned) {
        measured->commutation.electrical = commutation_electrical(&parameters->commutation, measured->angle);
    } else {
        commutation_find(&parameters->commutation, measured->angle, &measured->commutation);
    }
    int32_t current_max_q9 = 0;
    int32_t torque_sum = 0;
    UNROLL(4)
    for (unsigned phase = 0; phase < phases; phase++) {
        const int32_t current_q9 = scale_counts(sample->adc.phase_current_counts[phase], parameters->current_scale_q18);
        int32_t torque = 0;
        int32_t flux = 0;
        if (current_q9 > 0) { /* false for most phases at any time */
            torque = planned ? predictive_torque_estimate(predictive, phase, current_q9, &flux)
                             : phase_map_torque(tables, measured_phase_angle(parameters, misalignment, measured, phase),
                                                current_q9);
            torque_sum = fixed_add(torque_sum, torque);
            current_max_q9 = current_q9 > current_max_q9 ? current_q9 : current_max_q9;
        }
        measured->current_q9[phase] = current_q9;
        measured->torque[phase] = torque;
        measured->flux_linkage[phase] = flux;
    }
    measured->current_max_q9 = current_max_q9;
    measured->torque_sum_q24 = phase_map_scale(&tables->torque_format, torque_sum);
}
