// Measurement step: the angle by the encoder's edges and counts, the largest current, the torque that the currents
// imply.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "control/phase_map.h"
#include "interrupts/measure.h"
#include "interrupts/torque_control.h"
}

#include "support/configured.h"
#include "support/whole_sample.h"

namespace {

constexpr unsigned ENCODER_BITS = 12;
constexpr uint32_t COUNT = 1u << (32 - ENCODER_BITS);

class Measure : public testing::Test {
  protected:
    Measure() { reset(DRIVE_CONTROLLER_TRADITIONAL); }

    void reset(drive_controller_t controller, uint32_t timer_clock_hz = fixed_point::TIMER_CLOCK_HZ) {
        parameters = configured(controller, 40000, ENCODER_BITS, 12, {}, timer_clock_hz);
        control_reset(&parameters, &state);
        sample = whole_sample_t{};
    }

    void step() { measure(&parameters, &state, deferred_in_effect(&state), &sample); }

    static const deferred_results_t *deferred_in_effect(const control_state_t *state) {
        return deferred_results(&state->deferred_request, &state->deferred.response);
    }

    control_parameters_t parameters;
    control_state_t state;
    whole_sample_t sample;
};

TEST_F(Measure, the_speed_before_the_sample_is_kept_beside_the_start_of_the_count) {
    for (const int32_t speed_q22 : {-(1 << 28), 0, 54321}) {
        state.observer.speed_q22 = speed_q22;
        sample.encoder.counts = 5;
        step();
        EXPECT_EQ(state.measurement.predicted_speed_q22, speed_q22);
        EXPECT_EQ(state.measurement.encoder_angle, 5 * COUNT);
        EXPECT_EQ(state.measurement.angle, 5 * COUNT + COUNT / 2);
        EXPECT_FALSE(state.measurement.angle_from_edge);
    }
}

TEST_F(Measure, an_edge_is_extrapolated_at_the_speed_of_the_observer_in_both_directions_with_every_clock) {
    for (const uint32_t clock_hz : {1000000u, 16000000u, 200000000u, 400000000u}) {
        reset(DRIVE_CONTROLLER_TRADITIONAL, clock_hz);
        sample.encoder.counts = 100;
        sample.encoder.edge_known = true;
        for (const int32_t speed_rad_s : {-300, -20, 0, 20, 300}) {
            state.observer.speed_q22 = speed_rad_s * (1 << 22);
            for (const uint32_t age :
                 {0u, 1u, parameters.edge_age_max_ticks / 2u, 1u * parameters.edge_age_max_ticks}) {
                sample.encoder.edge_forward = speed_rad_s >= 0;
                sample.encoder.edge_age_ticks = age;
                step();
                const double turned = std::ldexp(double(speed_rad_s) * age / clock_hz / (2.0 * fixed_point::PI),
                                                 32 + machine_tables.speed_exponent);
                const uint32_t edge = sample.encoder.edge_forward ? 100 * COUNT : 101 * COUNT;
                EXPECT_NEAR(int32_t(state.measurement.angle - edge), turned, 2.0 + 1e-3 * std::fabs(turned))
                    << clock_hz << " Hz, " << speed_rad_s << " rad/s, " << age;
                EXPECT_TRUE(state.measurement.angle_from_edge);
            }
        }
    }
}

TEST_F(Measure, an_edge_that_is_too_old_limits_the_predicted_angle_to_its_count) {
    sample.encoder.counts = 100;
    sample.encoder.edge_known = true;
    sample.encoder.edge_age_ticks = parameters.edge_age_max_ticks + 1u;
    const uint32_t first = 100 * COUNT, last = 101 * COUNT - 1;
    for (const uint32_t predicted :
         {first - COUNT, first - 1, first, first + 1, last - 1, last, last + 1, last + COUNT}) {
        state.observer.angle_q64 = uint64_t(predicted) << 32;
        step();
        EXPECT_EQ(state.measurement.angle, std::clamp(predicted, first, last)) << int32_t(predicted - first);
        EXPECT_FALSE(state.measurement.angle_from_edge);
    }
}

TEST_F(Measure, the_largest_current_is_that_of_any_phase_and_0_without_current) {
    step();
    EXPECT_EQ(state.measurement.current_max_q9, 0);
    for (unsigned largest = 0; largest < machine_tables.phases; largest++) {
        for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
            sample.adc.phase_current_counts[phase] = phase == largest ? 2000 : uint16_t(100 * phase);
        }
        step();
        EXPECT_EQ(state.measurement.current_max_q9, 20000);
        for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
            EXPECT_EQ(state.measurement.current_q9[phase], 10 * sample.adc.phase_current_counts[phase]) << phase;
        }
    }
}

TEST_F(Measure, torque_is_that_of_the_tables_at_the_angle_of_each_phase_and_0_when_a_check_has_failed) {
    const int32_t misalignment[HAL_PHASES_MAX] = {0, 1 << 24, -(1 << 24)};
    for (unsigned k = 0; k < 64; k++) {
        sample.encoder.counts = k * 61;
        for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
            sample.adc.phase_current_counts[phase] = phase == k % 3 ? 0 : uint16_t(500 + 300 * phase);
        }
        step();
        state.measurement.current_q9[machine_tables.phases] = 15 << 9; // no phase
        state.measurement.torque[machine_tables.phases] = 99;
        measure_torque(&parameters, &state, misalignment, false);
        EXPECT_EQ(state.measurement.torque[machine_tables.phases], 99);
        int32_t sum = 0;
        for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
            const uint32_t angle = commutation_angle(&parameters.commutation, &state.measurement.commutation, phase);
            const int32_t torque = phase_map_torque(&machine_tables, angle - uint32_t(misalignment[phase]),
                                                    state.measurement.current_q9[phase]);
            EXPECT_EQ(state.measurement.torque[phase], phase == k % 3 ? 0 : torque) << phase;
            sum += state.measurement.torque[phase];
        }
        EXPECT_NE(sum, 0);
        EXPECT_NEAR(state.measurement.torque_sum_q24, phase_map_scale(&machine_tables.torque_format, sum), 2);
        measure_torque(&parameters, &state, misalignment, true);
        EXPECT_EQ(state.measurement.torque_sum_q24, 0);
    }
}

TEST_F(Measure, channels_without_a_phase_are_not_looked_at) {
    for (unsigned phase = machine_tables.phases; phase < HAL_PHASES_MAX; phase++) {
        sample.adc.phase_current_counts[phase] = 4000;
    }
    step();
    EXPECT_EQ(state.measurement.current_max_q9, 0);
    for (unsigned phase = machine_tables.phases; phase < HAL_PHASES_MAX; phase++) {
        EXPECT_EQ(state.measurement.current_q9[phase], 0) << phase;
    }
}

TEST_F(Measure, torque_and_flux_linkage_of_predictive_control_are_those_of_the_planned_cells_in_a_failed_period_too) {
    reset(DRIVE_CONTROLLER_SALIENT);
    deferred_results_t results = *deferred_in_effect(&state);
    state.measurement.dc_link_voltage_q6 = 240 << 6;
    state.torque_reference_q24 = 8 << 24;
    state.observer.angle_q64 = uint64_t(5) << 59;
    for (int k = 0; k < 4; k++) {
        torque_control(&parameters, &state, &results); // plans the cells, of two samples in turn
    }
    unsigned with_torque = 0;
    const int32_t misalignment[HAL_PHASES_MAX] = {};
    const phase_cell_t *cells = predictive_torque_cells(&state.predictive);
    for (unsigned only = 0; only < machine_tables.phases; only++) {
        std::fill_n(state.measurement.current_q9, HAL_PHASES_MAX, 0);
        std::fill_n(state.measurement.flux_linkage, HAL_PHASES_MAX, 99);
        state.measurement.current_q9[only] = 20 << 9;
        for (const bool failed : {false, true}) {
            measure_torque(&parameters, &state, misalignment, failed);
            int32_t flux = 0;
            const int32_t torque = predictive_torque_estimate(&cells[only], 20 << 9, &flux);
            with_torque += torque != 0;
            EXPECT_NEAR(state.measurement.torque_sum_q24, phase_map_scale(&machine_tables.torque_format, torque), 2);
            for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
                EXPECT_EQ(state.measurement.flux_linkage[phase], phase == only ? flux : 0) << phase;
            }
            for (unsigned phase = machine_tables.phases; phase < HAL_PHASES_MAX; phase++) {
                EXPECT_EQ(state.measurement.flux_linkage[phase], 99) << "no phase " << phase;
            }
        }
    }
    EXPECT_GE(with_torque, 2u);
}

} // namespace
