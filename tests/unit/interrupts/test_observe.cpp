// Observation step: an observer that slips, and one whose encoder counts slowly.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "interrupts/observe.h"
}

#include "support/configured.h"

namespace {

constexpr int32_t LIMIT_HIGH = (1 << 27) - 1, LIMIT_LOW = -(1 << 27); // of the innovation, load_observer.h

class Observe : public testing::Test {
  protected:
    Observe() { reset(); }

    void reset() {
        parameters = configured(DRIVE_CONTROLLER_PAPER, 40000, 17);
        control_reset(&parameters, &state);
        state.observer = {.angle_q64 = 77, .speed_q22 = 123, .load_torque_q24 = 456, .speed_correction_q22 = 0};
        state.bandwidth = {.stage = 5, .ticks = 99, .trigger = OBSERVER_TRIGGER_NONE};
    }

    // Periods of a rotor that turns by `step`; true when the observer is restarted in the last one.
    bool recover(uint32_t periods, uint32_t periods_per_ms, uint32_t step, int32_t innovation) {
        for (uint32_t k = 0; k < periods; k++) {
            EXPECT_EQ(state.observer.speed_q22, 123) << "before the time is over, period " << k;
            state.innovation = innovation;
            state.measurement.angle += step;
            observe_recover(&state, periods_per_ms);
        }
        return state.observer.speed_q22 != 123;
    }

    control_parameters_t parameters;
    control_state_t state;
};

TEST_F(Observe, an_observer_that_slips_begins_again_at_the_encoders_angle_and_its_speed_in_half_a_millisecond) {
    for (const uint32_t periods_per_ms : {20u, 40u, 100u, 1000u}) {
        machine_tables.speed_exponent = periods_per_ms == 100 ? 3 : 0; // a machine with a unit of speed of 8 rad/s
        for (const int32_t innovation : {LIMIT_LOW, LIMIT_HIGH}) {
            for (const int32_t rotation : {-100000000, -999000, 1000000, 134217000}) { // in half a millisecond
                reset();
                state.measurement.angle = 0xF0000000u;
                const uint32_t half = periods_per_ms / 2;
                const int32_t step = rotation / int32_t(half);
                ASSERT_TRUE(recover(half + 1, periods_per_ms, uint32_t(step), innovation));
                const double expected =
                    std::ldexp(2.0 * fixed_point::PI * 2000.0 * step * half, 22 - 32 - machine_tables.speed_exponent);
                EXPECT_NEAR(state.observer.speed_q22, expected, 5.0) << "10^-6 rad/s";
                load_observer_t begun;
                load_observer_reset(&begun, state.measurement.angle);
                EXPECT_EQ(state.observer.angle_q64, begun.angle_q64);
                EXPECT_EQ(state.observer.load_torque_q24, 0);
                EXPECT_EQ(state.bandwidth.stage, 0u) << "maximum bandwidth";
                EXPECT_EQ(state.bandwidth.ticks, 0u);
                EXPECT_EQ(state.slip.periods, 0u);
            }
        }
    }
}

TEST_F(Observe, an_observer_that_follows_is_left_alone) {
    for (const int32_t innovation : {LIMIT_LOW + 2, -1, 0, 1, LIMIT_HIGH - 1}) {
        reset();
        EXPECT_FALSE(recover(200, 40, 1000000, innovation)) << innovation;
        EXPECT_EQ(state.slip.periods, 0u) << innovation;
        EXPECT_EQ(state.observer.angle_q64, 77u);
        EXPECT_EQ(state.observer.load_torque_q24, 456);
        EXPECT_EQ(state.bandwidth.stage, 5u);
    }
}

TEST_F(Observe, an_observer_that_follows_after_half_a_millisecond_is_left_alone_and_the_next_slip_begins_anew) {
    EXPECT_FALSE(recover(20, 40, 1000000, LIMIT_HIGH));
    EXPECT_EQ(state.slip.periods, 20u);
    EXPECT_FALSE(recover(1, 40, 1000000, 0));
    EXPECT_EQ(state.slip.periods, 0u);
    EXPECT_FALSE(recover(20, 40, 1000000, LIMIT_HIGH));
    EXPECT_TRUE(recover(1, 40, 1000000, LIMIT_HIGH));
}

TEST_F(Observe, a_cleared_load_starts_at_the_maximum_bandwidth_with_angle_and_speed_kept) {
    const uint32_t before = state.deferred_request.generation;
    observe_forget_load(&state);
    EXPECT_EQ(state.observer.load_torque_q24, 0);
    EXPECT_EQ(state.observer.angle_q64, 77u);
    EXPECT_EQ(state.observer.speed_q22, 123);
    EXPECT_EQ(state.bandwidth.stage, 0u);
    EXPECT_EQ(state.deferred_request.generation, before + DEFERRED_OBSERVER_STEP);
}

TEST_F(Observe, the_innovation_is_noted_for_the_deferred_step_as_the_observer_sees_it) {
    for (const bool slow : {false, true}) {
        for (const int32_t ahead : {-1000, 0, 1 << 20, 1 << 30}) {
            reset();
            deferred_results_t results{};
            results.observer = load_observer_inertia(&parameters.observer, 0);
            results.slow_counts.slow = slow;
            state.measurement.angle = uint32_t(ahead);
            state.innovation = 99;
            observe(&parameters, &state, &results);
            EXPECT_EQ(state.innovation, std::min(ahead, LIMIT_HIGH)) << slow;
        }
    }
}

TEST_F(Observe, a_count_that_does_not_change_limits_the_speed_in_both_directions_and_one_that_does_not) {
    constexpr int32_t MAX_Q22 = 1 << 20;
    for (const bool same : {true, false}) {
        for (const int32_t speed_q22 : {-(1 << 24), -1000, 1000, 1 << 24}) {
            reset();
            parameters.observer.friction_q30 = 0;
            deferred_results_t results{};
            results.observer = load_observer_inertia(&parameters.observer, 0);
            results.slow_counts.slow = true;
            results.slow_counts.encoder_angle = 0x40000000u;
            results.slow_counts.speed_max_q22 = MAX_Q22;
            state.observer = {.angle_q64 = uint64_t(0x40000000u) << 32,
                              .speed_q22 = speed_q22,
                              .load_torque_q24 = 0,
                              .speed_correction_q22 = 0};
            state.measurement.angle = 0x40000000u; // as predicted
            state.measurement.encoder_angle = same ? 0x40000000u : 0x40008000u;
            observe(&parameters, &state, &results);
            const int32_t limited_q22 = std::min(std::max(speed_q22, -MAX_Q22), MAX_Q22);
            EXPECT_NEAR(state.observer.speed_q22, same ? limited_q22 : speed_q22, 2);
            EXPECT_EQ(state.bandwidth.stage, OBSERVER_BANDWIDTH_STEADY_STAGE);
            EXPECT_EQ(state.innovation, 0);
        }
    }
}

} // namespace
