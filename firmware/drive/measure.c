#include "drive/measure.h"

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

static inline int32_t measure_current_q9(int32_t scale_q18, const control_sample_t *sample, unsigned phase,
                                         control_measurement_t *measured) {
    const int32_t current_q9 = scale_counts(sample->adc->phase_current_counts[phase], scale_q18);
    measured->current_q9[phase] = current_q9;
    return current_q9;
}

/* Sums over the phases. */
typedef struct {
    int32_t current_max_q9;
    int32_t torque; /* in units of the tables */
} sums_t;

static inline void add_phase(sums_t *sums, int32_t current_q9, int32_t torque) {
    sums->torque = fixed_add(sums->torque, torque);
    sums->current_max_q9 = current_q9 > sums->current_max_q9 ? current_q9 : sums->current_max_q9;
}

/* Torque of each phase by the machine's tables, at the measured angle. */
static sums_t measure_by_map(const control_parameters_t *parameters, const int32_t misalignment[HAL_PHASES_MAX],
                             const control_sample_t *sample, control_measurement_t *measured) {
    sums_t sums = {0, 0};
    const int32_t scale_q18 = parameters->current_scale_q18;
    const unsigned phases = machine_tables.phases;
    UNROLL(4)
    for (unsigned phase = 0; phase < phases; phase++) {
        const int32_t current_q9 = measure_current_q9(scale_q18, sample, phase, measured);
        int32_t torque = 0;
        if (LIKELY(current_q9 > 0)) { /* though false for most phases at any time */
            const uint32_t angle = commutation_angle(&parameters->commutation, &measured->commutation, phase);
            torque = phase_map_torque(&machine_tables, angle - (uint32_t)misalignment[phase], current_q9);
            add_phase(&sums, current_q9, torque);
        }
        measured->torque[phase] = torque;
    }
    return sums;
}

/* Torque and flux linkage of each phase at the planned angle. */
static sums_t measure_by_plan(const control_parameters_t *parameters, const predictive_torque_t *predictive,
                              const control_sample_t *sample, control_measurement_t *measured) {
    sums_t sums = {0, 0};
    const phase_cell_t *cells = predictive_torque_cells(predictive);
    const int32_t scale_q18 = parameters->current_scale_q18;
    const unsigned phases = machine_tables.phases;
    UNROLL(4)
    for (unsigned phase = 0; phase < phases; phase++) {
        const int32_t current_q9 = measure_current_q9(scale_q18, sample, phase, measured);
        int32_t flux = 0;
        if (current_q9 > 0) { /* false for most phases at any time */
            add_phase(&sums, current_q9, predictive_torque_estimate(&cells[phase], current_q9, &flux));
        }
        measured->flux_linkage[phase] = flux;
    }
    return sums;
}

void measure(const control_parameters_t *parameters, const load_observer_t *observer,
             const deferred_results_t *deferred, const predictive_torque_t *predictive, const control_sample_t *sample,
             control_measurement_t *measured) {
    measure_angle(parameters, observer, &deferred->slow_counts, &sample->encoder, measured);
    measured->dc_link_voltage_q6 = scale_counts(sample->adc->bus_voltage_counts, parameters->voltage_scale_q18);
    sums_t sums;
    if (parameters->torque_law == TORQUE_LAW_PREDICTIVE) {
        measured->commutation.electrical = commutation_electrical(&parameters->commutation, measured->angle);
        sums = measure_by_plan(parameters, predictive, sample, measured);
    } else {
        commutation_find(&parameters->commutation, measured->angle, &measured->commutation);
        sums = measure_by_map(parameters, deferred->predictive.misalignment, sample, measured);
    }
    measured->current_max_q9 = sums.current_max_q9;
    measured->torque_sum_q24 = phase_map_scale(&machine_tables.torque_format, sums.torque);
}
