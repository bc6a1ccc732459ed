// Misalignment by flux linkage, on strokes of a machine whose flux linkage, resistance and voltage are not the
// tables'.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include <gtest/gtest.h>

extern "C" {
#include "control/flux_angle.h"
#include "control/phase_map.h"
}

#include "support/fixed_point.h"
#include "support/flipped_bits.h"

namespace {

using namespace fixed_point;

constexpr double SAMPLE_S = 1e-4;
constexpr double RESISTANCE_OHM = 0.05, VOLTAGE_V = 240.0;

double psi_Wb(double rev, double current_A) {
    return phase_map_flux_q29(&machine_tables, phase_map_distance(uint32_t(int64_t(std::floor(rev * REV)))),
                              to_fixed(current_A, 512.0)) /
           Q29;
}

// One phase, in strokes from the unaligned to the aligned position.
class FluxAngle : public testing::Test {
  protected:
    // Time in s. The voltage is what the flux linkage of the machine needs, and the integral what the drive makes of
    // it.
    void run(double seconds) {
        double since_s = 0.0, drift_Wb = 0.0;
        for (int k = 0; k < int(seconds / SAMPLE_S); k++) {
            const double measured = 0.52 + rpm / 60.0 * machine_tables.rotor_poles * since_s;
            if (measured > 0.9) {
                since_s = drift_Wb = 0.0;
                add({});
                continue;
            }
            since_s += SAMPLE_S;
            const double current_A = 4.0 + load_Nm(k * SAMPLE_S) * (1.0 + 4.0 * std::pow(measured - 0.7, 2.0));
            const double true_rev = measured - misalignment_deg / 360.0 * machine_tables.rotor_poles;
            drift_Wb += (RESISTANCE_OHM * (resistance_gain - 1.0) * current_A + drop_V) * SAMPLE_S;
            const double corrected = measured - learned_deg / 360.0 * machine_tables.rotor_poles;
            flux_residual_phase_t sample = {};
            sample.angle = uint32_t(int64_t(std::floor(corrected * REV)));
            sample.misalignment = to_fixed(learned_deg / 360.0 * machine_tables.rotor_poles, REV);
            sample.current_q9 = to_fixed(current_A, 512.0);
            sample.voltage_q29 = to_fixed(flux_gain * psi_Wb(true_rev, current_A) + drift_Wb, Q29);
            sample.table_q29 = to_fixed(psi_Wb(corrected, current_A), Q29);
            sample.step_drop_q29 = to_fixed(RESISTANCE_OHM * current_A * SAMPLE_S, Q29);
            if (add(sample)) {
                solved_deg = flux_angle_solve(&state) / REV / machine_tables.rotor_poles * 360.0;
                solutions++;
            }
        }
    }

    // A sample of a phase that conducts, its voltage known, on a rotor that turns.
    bool add(const flux_residual_phase_t &sample) {
        flux_residual_t residual{};
        residual.sample.speed_q22 = 1 << 24;
        residual.sample.period_flux_q29 = period_flux_q29;
        residual.elapsed = elapsed;
        residual.phase[0] = sample;
        residual.phase[0].known = true;
        return flux_angle_add(&state, &residual, 0);
    }

    double load_Nm(double time_s) const { return 12.0 + moving_A * std::sin(2.0 * PI * 37.0 * time_s); }

    flux_angle_t state{};
    int32_t period_flux_q29 = to_fixed(VOLTAGE_V * SAMPLE_S / 4.0, Q29);
    uint32_t elapsed = 4;
    double rpm = 150.0;
    double misalignment_deg = 0.0, learned_deg = 0.0;
    double flux_gain = 1.0, resistance_gain = 1.0, drop_V = 0.0, moving_A = 0.0;
    double solved_deg = 0.0;
    int solutions = 0;
};

TEST_F(FluxAngle, is_that_of_the_encoder_to_0_05_degrees_whatever_gain_resistance_drops_and_load_are) {
    for (const double speed_rpm : {20.0, 150.0, 1500.0}) {
        for (const double gain : {0.9, 1.1}) {
            for (const double off_deg : {-2.0, -0.3, 0.0, 0.3, 2.0}) {
                state = {};
                rpm = speed_rpm;
                flux_gain = gain;
                resistance_gain = gain > 1.0 ? 1.5 : 0.8;
                drop_V = gain > 1.0 ? 1.7 : 0.0;
                moving_A = 4.0;
                misalignment_deg = off_deg;
                learned_deg = off_deg - 0.1;
                run(3.0);
                EXPECT_NEAR(solved_deg, off_deg, 0.05) << rpm << " r/min, gain " << gain;
            }
        }
    }
}

TEST_F(FluxAngle, of_a_large_misalignment_is_found_in_steps) {
    misalignment_deg = moving_A = 4.0;
    for (int k = 0; k < 4; k++) {
        run(2.0);
        learned_deg = solved_deg;
    }
    EXPECT_NEAR(solved_deg, 4.0, 0.05);
}

TEST_F(FluxAngle, is_not_solved_in_the_first_half_second) {
    run(0.5);
    EXPECT_EQ(solutions, 0);
    run(1.0);
    EXPECT_GT(solutions, 0);
}

// 4.5 ms of 10, each with ten samples.
TEST_F(FluxAngle, of_a_phase_that_conducts_for_nearly_half_of_the_time_is_solved_from_1_1_s_on_each_57_ms) {
    flux_residual_phase_t conducting = {};
    conducting.angle = 0xb0000000u;
    conducting.current_q9 = 10 * 512;
    conducting.voltage_q29 = conducting.table_q29 = 1 << 26;
    std::vector<double> solved_s;
    for (int k = 0; k < 30000; k++) {
        if (add(k % 100 < 45 ? conducting : flux_residual_phase_t{})) {
            solved_s.push_back(k * SAMPLE_S);
        }
    }
    ASSERT_GT(solved_s.size(), 20u);
    EXPECT_NEAR(solved_s.front(), 1.1, 0.05);
    EXPECT_NEAR((solved_s.back() - solved_s.front()) / double(solved_s.size() - 1), 0.057, 0.001);
}

TEST_F(FluxAngle, is_unknown_while_a_conduction_lasts_longer_than_it_is_remembered) {
    rpm = 5.0;
    misalignment_deg = 0.3;
    run(1.5);
    solutions = 0;
    run(4.0);
    EXPECT_GT(solutions, 10);
    EXPECT_EQ(solved_deg, 0.0);
}

TEST_F(FluxAngle, is_unknown_from_a_conduction_that_has_become_too_long_until_a_whole_shorter_one_has_ended) {
    const auto conduct = [&](double speed_rpm, double seconds) { // from the start of a conduction
        add({});
        rpm = speed_rpm;
        run(seconds);
        return flux_angle_solve(&state) / REV / machine_tables.rotor_poles * 360.0;
    };
    misalignment_deg = 0.3;
    EXPECT_NEAR(conduct(150.0, 2.0), 0.3, 0.05);
    EXPECT_NE(conduct(5.0, 0.40), 0.0) << "4,000 samples";
    EXPECT_EQ(conduct(5.0, 0.42), 0.0) << "more than 4,096, after a shorter one";
    EXPECT_EQ(conduct(150.0, 0.01), 0.0) << "a part of a conduction, after a longer one";
    EXPECT_NEAR(conduct(150.0, 1.0), 0.3, 0.05);
}

TEST_F(FluxAngle, is_unknown_without_a_course_of_its_own) {
    period_flux_q29 = 0;
    for (int k = 0; k < 4096; k++) {
        flux_residual_phase_t constant = {};
        constant.angle = 0xb0000000u;
        constant.current_q9 = 10 * 512;
        constant.voltage_q29 = k % 1000 == 0 ? 0 : 1 << 26;
        constant.table_q29 = 1 << 25;
        add(constant);
    }
    EXPECT_EQ(flux_angle_solve(&state), 0);
}

// Without each of what a sample needs: a rotor that turns, a known integral, switches that are on, a current.
TEST_F(FluxAngle, samples_that_show_no_angle_are_not_counted) {
    const auto samples = [&](auto change) {
        flux_residual_t residual{};
        residual.elapsed = 4;
        residual.sample.speed_q22 = 1 << 24;
        residual.phase[0].known = true;
        residual.phase[0].voltage_q29 = residual.phase[0].table_q29 = 1 << 26;
        residual.phase[0].current_q9 = 10 * 512;
        change(residual);
        state = {};
        flux_angle_add(&state, &residual, 0);
        return state.samples;
    };
    EXPECT_EQ(samples([](flux_residual_t &) {}), 1u);
    for (const double direction : {1.0, -1.0}) {
        const auto at_rad_s = [&](double speed_rad_s) {
            return samples(
                [=](flux_residual_t &residual) { residual.sample.speed_q22 = to_fixed(direction * speed_rad_s, Q22); });
        };
        EXPECT_EQ(at_rad_s(0.5), 0u);
        EXPECT_EQ(at_rad_s(0.51), 1u);
    }
    EXPECT_EQ(samples([](flux_residual_t &residual) { residual.phase[0].known = false; }), 0u);
    EXPECT_EQ(samples([](flux_residual_t &residual) { residual.phase[0].off = true; }), 0u);
    EXPECT_EQ(samples([](flux_residual_t &residual) { residual.phase[0].current_q9 = 512; }), 0u);
}

TEST_F(FluxAngle, overflows_nothing) {
    period_flux_q29 = INT32_MAX;
    elapsed = 255;
    for (const int32_t sign : {1, -1}) {
        state = {};
        for (uint32_t k = 0; k < 20000; k++) {
            const bool end = k % 100 == 0;
            flux_residual_phase_t sample = {};
            sample.angle = 0x80000000u + k * 0x01234567u;
            sample.misalignment = sign * (1 << 29);
            sample.current_q9 = 79 * 512;
            sample.voltage_q29 = end ? 0 : INT32_MAX;
            sample.table_q29 = k % 2 == 0 ? INT32_MAX : 0;
            sample.step_drop_q29 = INT32_MAX / 2;
            if (add(sample)) {
                flux_angle_solve(&state);
            }
        }
    }
}

// A word that has changed in memory: a sum of squares may be negative, and no loop depends on it.
TEST_F(FluxAngle, is_solved_in_a_bounded_time_with_any_bit_changed) {
    run(1.5);
    with_each_bit_flipped(state, [](const flux_angle_t &flipped) { flux_angle_solve(&flipped); });
    flux_angle_t negative = state;
    negative.sum[0][0] = -1;
    EXPECT_EQ(flux_angle_solve(&negative), 0);
    negative.sum[0][0] = INT64_MIN;
    EXPECT_EQ(flux_angle_solve(&negative), 0);
}

} // namespace
