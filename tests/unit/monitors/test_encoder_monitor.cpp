// Encoder against flux linkage and against its own counts, on a phase whose state is known exactly.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "control/load_observer.h"
#include "control/machine_tables.h"
#include "monitors/encoder_monitor.h"
}

#include "support/fixed_point.h"
#include "support/phase_map_results.h"

namespace {

using namespace fixed_point;
constexpr uint32_t RATE_HZ = 40000;
constexpr double PERIOD_S = 1.0 / RATE_HZ, DEGREE = 0x1p32 / 360.0;
constexpr uint32_t PHASES = 3, POLES = 4;

class EncoderMonitor : public testing::Test {
  protected:
    EncoderMonitor() {
        const load_observer_model_t model = load_observer_model(RATE_HZ, to_fixed(0.02, Q30), 0);
        const commutation_angles_t angles = {.turn_on = 1u << 31, .turn_off = 0xD5555555u, .outgoing_off = 0xF7000000u};
        parameters.commutation = commutation_configure(&angles, PHASES, POLES);
        parameters.half_count = (1u << 14) * POLES;
        parameters.middle = 1u << 14;
        parameters.advance_min = int32_t(0x1p32 / PHASES / POLES / ENCODER_MONITOR_ADVANCE_STROKES) +
                                 int32_t(ENCODER_MONITOR_ADVANCE_COUNTS * 2 * parameters.middle);
        parameters.angle_max = uint32_t(2 * DEGREE) * POLES;
        parameters.flux_error_q29 = encoder_monitor_flux_error_q29(
            load_observer_acceleration(to_fixed(19.1, Q24), to_fixed(0.02, Q30)), 26 << 9, model.angle_step_q32, POLES);
        parameters.rate_hz = RATE_HZ;
        parameters.current_min_q9 = 6 << 9;
        parameters.over_speed_q22 = to_fixed(rad_s(3600.0), Q22);
        parameters.travel = int32_t(3600.0 / 60.0 * PERIOD_S * 0x1p32);
        input.run = true;
        std::fill_n(input.known, PHASES, true);
        input.flux_step_max_q29 = to_fixed(240.0 * PERIOD_S, Q29);
        input.period = 100;
        monitor_step();
    }

    void monitor_step() { encoder_monitor_step(&parameters, &monitor, &input); }

    // One period: the phase carries a current at a true rotor angle, the encoder shows another; in degrees, A.
    void step(double encoder_deg, double true_deg, double current_A, unsigned phase = 0) {
        input.period++;
        input.encoder_angle = uint32_t(int64_t(encoder_deg * DEGREE)) & ~((1u << 15) - 1u);
        for (unsigned k = 0; k < PHASES; k++) {
            input.current_q9[k] = 0;
            input.flux_q29[k] = 0;
            input.zero_at[k] = k == phase ? input.zero_at[k] : input.period;
        }
        const uint32_t angle = uint32_t(int64_t(true_deg * DEGREE)) * POLES - phase * parameters.commutation.stroke;
        input.current_q9[phase] = to_fixed(current_A, Q9);
        input.flux_q29[phase] =
            phase_map_results::flux_q29(machine_tables, angle, input.current_q9[phase]) + flux_offset_q29;
        monitor_step();
    }

    encoder_monitor_parameters_t parameters{};
    encoder_monitor_t monitor{};
    encoder_monitor_input_t input{};
    int32_t flux_offset_q29 = 0; // of the integral
};

TEST_F(EncoderMonitor, the_tolerated_error_of_the_voltage_is_half_of_the_back_emf_after_2_degrees) {
    // Saturating: 0.34 Wb aligned less 0.017 unaligned at 26 A over pi / 4; 8.2 rad/s after 2 degrees at 955 rad/s^2.
    const double volts = parameters.flux_error_q29 / Q29 / PERIOD_S;
    EXPECT_GT(volts, 1.4);
    EXPECT_LT(volts, 1.9);
}

TEST_F(EncoderMonitor, a_rotor_that_accelerates_while_the_encoder_does_not_count_is_found_after_1_to_4_degrees) {
    for (const double start_deg : {55.0, 65.0, 75.0}) {
        monitor = {};
        double moved_deg = 0.0;
        for (int k = 0; !monitor.frozen; k++) {
            ASSERT_LT(k, 1000) << start_deg;
            moved_deg = 0.5 * 955.0 * (k * PERIOD_S) * (k * PERIOD_S) * 57.3;
            step(start_deg, start_deg + moved_deg, 25.0);
        }
        EXPECT_GT(moved_deg, 0.5) << start_deg;
        EXPECT_LT(moved_deg, 4.0) << start_deg;
        for (int k = 0; k < 1000; k++) {
            step(start_deg, start_deg, 0.0);
        }
        EXPECT_TRUE(monitor.frozen) << "until it counts";
        step(start_deg + 0.1, start_deg, 0.0);
        EXPECT_FALSE(monitor.frozen);
    }
}

TEST_F(EncoderMonitor, a_rotor_at_rest_is_no_evidence_whatever_the_current_and_a_gain_of_the_sensor) {
    for (const double gain : {0.95, 1.0, 1.05}) {
        monitor = {};
        for (int k = 0; k < 8000; k++) {
            const double current_A = std::min(25.0, 0.5 * k) + 5.0 * std::sin(k * 0.3);
            step(65.0, 65.0, std::max(0.0, current_A));
            input.current_q9[0] = int32_t(input.current_q9[0] * gain);
            input.period++;
            monitor_step();
            ASSERT_FALSE(monitor.frozen || monitor.angle) << gain << " " << k;
        }
    }
}

TEST_F(EncoderMonitor, an_angle_that_two_phases_contradict_is_a_fault_and_one_within_the_tolerance_is_none) {
    for (const double error_deg : {-10.0, -6.0, -2.0, 0.0, 2.0, 6.0, 10.0}) {
        monitor = {};
        for (int k = 0; k < 2000; k++) {
            const double true_deg = k * PERIOD_S * 3600.0;
            const unsigned phase = unsigned(true_deg / 30.0) % PHASES;
            const double since_deg = std::fmod(true_deg, 30.0);
            if (since_deg < 0.05) {
                input.zero_at[phase] = input.period;
            }
            // Phase j is unaligned at 45 + 30 j degrees.
            const double rotor_deg = 48.0 + true_deg;
            step(rotor_deg + error_deg, rotor_deg, 20.0, phase);
        }
        EXPECT_EQ(monitor.angle, std::fabs(error_deg) > 5.0) << error_deg;
        input.run = false;
        input.period++;
        monitor_step();
        EXPECT_FALSE(monitor.angle);
        input.run = true;
    }
}

TEST_F(EncoderMonitor, one_phase_that_contradicts_the_angle_for_4_ms_is_enough_while_no_other_conducts) {
    for (const auto &[error_deg, fails] : {std::pair{12.0, true}, std::pair{-12.0, true}, std::pair{1.0, false}}) {
        monitor = {};
        input.zero_at[0] = input.period + 1;
        int periods = 0;
        for (; periods < 250 && !monitor.angle; periods++) {
            step(65.0 + error_deg, 65.0, 25.0);
        }
        EXPECT_EQ(monitor.angle, fails) << error_deg;
        EXPECT_GT(periods, RATE_HZ / 256) << error_deg;
        EXPECT_LT(fails ? periods : 0, RATE_HZ / 200) << error_deg;
    }
}

TEST_F(EncoderMonitor, one_phase_alone_is_no_evidence_while_the_rotor_advances_with_the_torque_and_brings_the_next) {
    for (const double torque : {1.0, -1.0}) {
        for (const double rotor : {1.0, -1.0}) { // 24 r/min
            monitor = {};
            input.run = false;
            monitor_step();
            input.run = true;
            input.torque_q24 = int32_t(torque * (1 << 24));
            input.zero_at[0] = input.period + 1;
            for (int k = 0; k < 250; k++) {
                step(77.0 + rotor * k * 144.0 / RATE_HZ, 65.0 + rotor * k * 144.0 / RATE_HZ, 25.0);
            }
            EXPECT_EQ(monitor.angle, torque != rotor) << torque << ", " << rotor;
        }
    }
}

TEST_F(EncoderMonitor, a_contradiction_waits_for_the_next_phase_for_a_64th_of_a_second) {
    input.torque_q24 = 1 << 24;
    // The rotor swings: it comes with the torque, shows 6 ms of a contradiction, and turns back.
    int periods = 0;
    for (; periods < RATE_HZ / 20 && !monitor.angle; periods++) {
        const int swing = periods % (RATE_HZ / 100);
        if (swing == 0) {
            input.zero_at[0] = input.period + 1;
        }
        const bool comes = swing < RATE_HZ * 6 / 1000;
        const double turned_deg = (comes ? swing : RATE_HZ * 6 / 1000) * 144.0 / RATE_HZ;
        step(77.0 + turned_deg, 65.0 + turned_deg, comes ? 25.0 : 0.0);
    }
    EXPECT_GT(periods, RATE_HZ / 64);
    EXPECT_LT(periods, RATE_HZ / 32);
}

// Phase 1 is lost; phase 2 agrees, as its turn comes, and phase 0 alone contradicts for longer than 1/256 s.
TEST_F(EncoderMonitor, one_phase_alone_is_no_evidence_when_all_others_but_a_lost_one_have_agreed_for_a_millisecond) {
    for (const auto &[lost, agrees_ms] : {std::pair{true, 2.0}, {true, 1.1}, {true, 0.8}, {false, 2.0}}) {
        monitor = {};
        input.run = false;
        monitor_step();
        input.run = true;
        input.lost_phases = lost ? 2u : 0u;
        input.zero_at[2] = input.period + 1;
        for (int k = 0; k < RATE_HZ * agrees_ms / 1000; k++) {
            step(125.0, 125.0, 25.0, 2);
        }
        input.zero_at[0] = input.period + 1;
        for (int k = 0; k < RATE_HZ / 150; k++) {
            step(77.0, 65.0, 25.0);
        }
        EXPECT_EQ(monitor.angle, !lost || agrees_ms < 1.0) << lost << ", " << agrees_ms << " ms";
    }
}

TEST_F(EncoderMonitor, a_phase_has_company_while_another_has_contradicted_the_angle_within_a_quarter_of_a_second) {
    EXPECT_FALSE(encoder_monitor_suspects(&parameters, &monitor, 0));
    input.zero_at[1] = input.period + 1;
    for (int k = 0; k < 10; k++) {
        step(65.0 + 30.0, 65.0 + 30.0 - 12.0, 25.0, 1);
    }
    EXPECT_TRUE(encoder_monitor_suspects(&parameters, &monitor, 1));
    EXPECT_FALSE(encoder_monitor_suspects(&parameters, &monitor, 2));
    for (int k = 0; k < RATE_HZ / 4 + 10; k++) {
        step(65.0, 65.0, 0.0, 0);
    }
    EXPECT_FALSE(encoder_monitor_suspects(&parameters, &monitor, 1));
}

TEST_F(EncoderMonitor,
       an_encoder_that_turns_round_within_a_millisecond_is_suspect_and_a_rotor_that_does_so_in_ten_is_not) {
    for (const int turning_ms : {0, 10}) { // between 300 r/min one way and the other
        monitor = {};
        double angle_deg = 0.0, speed_deg_s = 1800.0;
        for (int k = 0; k < 30 * RATE_HZ / 1000; k++) {
            const bool after = k >= 10 * RATE_HZ / 1000;
            speed_deg_s = !after            ? 1800.0
                          : turning_ms == 0 ? -1800.0
                                            : std::max(-1800.0, speed_deg_s - 3600.0 / (turning_ms * RATE_HZ / 1000));
            angle_deg += speed_deg_s / RATE_HZ;
            step(angle_deg, angle_deg, 0.0);
        }
        EXPECT_EQ(encoder_monitor_suspects(&parameters, &monitor, 7), turning_ms == 0);
    }
}

TEST_F(EncoderMonitor,
       a_rotor_that_turns_by_more_than_half_a_turn_while_triggers_are_lost_is_no_encoder_that_turns_round) {
    for (const bool lost : {true, false}) {
        monitor = {};
        double angle_deg = 0.0; // 300 r/min
        for (int k = 0; k < 20 * RATE_HZ / 1000; k++) {
            const bool gap = k == 10 * RATE_HZ / 1000;
            angle_deg += 1800.0 / RATE_HZ + (gap ? 270.0 : 0.0);
            input.lost = gap && lost;
            step(angle_deg, angle_deg, 0.0);
        }
        EXPECT_EQ(encoder_monitor_suspects(&parameters, &monitor, 7), !lost);
    }
}

TEST_F(EncoderMonitor, the_first_direction_of_the_encoder_after_a_reset_is_no_turn_round) {
    monitor = {};
    input.period = 0;
    for (int k = 0; k < 10 * RATE_HZ / 1000; k++) {
        const double angle_deg = 90.0 - k * 1800.0 / RATE_HZ;
        step(angle_deg, angle_deg, 0.0);
    }
    EXPECT_FALSE(encoder_monitor_suspects(&parameters, &monitor, 7));
}

TEST_F(EncoderMonitor, a_rotor_that_is_light_enough_to_turn_round_within_a_millisecond_is_not_suspect) {
    // Between 300 r/min one way and the other, 1800 degrees a second: in 1.4 ms by 2.5e6 degrees/s^2.
    for (const auto &[deg_s2, suspect] : {std::pair{2.8e6, false}, std::pair{2.2e6, true}}) {
        monitor = {};
        parameters.travel_change = int32_t(deg_s2 * PERIOD_S * PERIOD_S * DEGREE);
        double angle_deg = 0.0;
        for (int k = 0; k < 20 * RATE_HZ / 1000; k++) {
            angle_deg += (k < 10 * RATE_HZ / 1000 ? 1800.0 : -1800.0) / RATE_HZ;
            step(angle_deg, angle_deg, 0.0);
        }
        EXPECT_EQ(encoder_monitor_suspects(&parameters, &monitor, 7), suspect) << deg_s2;
    }
}

TEST_F(EncoderMonitor, integral_that_parts_faster_than_a_rotor_can_turn_is_no_frozen_encoder) {
    // Of the link voltage's 6 mWb a period: of an open winding nearly all; of a rotor that turns at a twentieth of the
    // speed of full back-EMF a twentieth.
    for (const auto &[part, frozen] : {std::pair{0.9, false}, std::pair{0.05, true}}) {
        monitor = {};
        double excess_Wb = 0.0;
        for (int k = 0; k < 400; k++) {
            excess_Wb += k < 50 || excess_Wb > 0.1 ? 0.0 : part * 240.0 * PERIOD_S;
            flux_offset_q29 = to_fixed(excess_Wb, Q29);
            step(75.0, 75.0, 25.0);
        }
        EXPECT_EQ(monitor.frozen, frozen) << part;
    }
}

TEST_F(EncoderMonitor, flux_linkage_that_a_warm_or_a_cold_winding_explains_does_not_contradict_the_angle) {
    const struct {
        double excess_Wb, drop_Wb;
        bool fails;
    } cases[] = {{0.1, 0.0, true},  {0.1, 0.05, true}, {0.1, 0.2, false},
                 {-0.1, 0.0, true}, {-0.1, 0.1, true}, {-0.1, 0.4, false}};
    for (const auto &one : cases) {
        monitor = {};
        flux_offset_q29 = to_fixed(one.excess_Wb, Q29);
        for (int k = 0; k < 400; k++) {
            const unsigned phase = k / 100 % 2;
            input.zero_at[phase] = k % 100 == 0 ? input.period : input.zero_at[phase];
            std::fill_n(input.drop_q29, PHASES, to_fixed(one.drop_Wb, Q29));
            step(65.0 + 30.0 * phase, 65.0 + 30.0 * phase, 25.0, phase);
        }
        EXPECT_EQ(monitor.angle, one.fails) << one.excess_Wb << " " << one.drop_Wb;
    }
}

TEST_F(EncoderMonitor, an_integral_that_drifts_by_a_warm_or_a_cold_winding_is_no_frozen_encoder) {
    parameters.resistance_period_q40 = int32_t(0.4 * PERIOD_S * 0x1p40); // 10 V at 25 A
    for (const auto &[factor, frozen] : {std::pair{0.4, true}, {0.72, false}, {1.55, false}, {2.3, true}}) {
        monitor = {};
        for (int k = 0; k < 2000; k++) {
            flux_offset_q29 = to_fixed((factor - 1.0) * 10.0 * PERIOD_S * std::min(k, 400), Q29);
            step(75.0, 75.0, 25.0);
        }
        EXPECT_EQ(monitor.frozen, frozen) << factor;
    }
}

TEST_F(EncoderMonitor, flux_linkage_that_no_angle_explains_is_no_error_of_the_encoder) {
    // Aligned, 25 A are 0.34 Wb; the integral of two phases says far more, or less than unaligned.
    for (const double excess_Wb : {0.35, -0.3}) {
        monitor = {};
        for (int k = 0; k < 1000; k++) {
            const unsigned phase = k / 200 % 2;
            input.zero_at[phase] = k % 200 == 0 ? input.period : input.zero_at[phase];
            flux_offset_q29 = to_fixed(excess_Wb, Q29);
            step(excess_Wb > 0 ? 80.0 : 48.0, excess_Wb > 0 ? 80.0 : 48.0, 25.0, phase);
            ASSERT_FALSE(monitor.angle || monitor.frozen) << excess_Wb << " " << k;
        }
    }
}

TEST_F(EncoderMonitor, counts_faster_than_the_limit_are_over_speed_within_a_millisecond_in_either_direction) {
    for (const double sign : {1.0, -1.0}) {
        for (const auto &[rpm, fails] : {std::pair{3600.0, false}, std::pair{3800.0, false}, std::pair{3950.0, true}}) {
            monitor = {};
            int periods = 0;
            for (double deg = 0.0; periods < 400 && !monitor.over_speed; periods++) {
                deg += sign * rpm * 6.0 * PERIOD_S;
                step(deg, deg, 0.0);
            }
            EXPECT_EQ(monitor.over_speed, fails) << sign * rpm;
            EXPECT_LT(fails ? periods : 0, RATE_HZ / 1000) << sign * rpm;
            EXPECT_GT(periods, 10);
            for (int k = 0; k < 100; k++) {
                step(0.0, 0.0, 0.0);
            }
            EXPECT_FALSE(monitor.over_speed) << "at rest again";
        }
    }
}

// A check in each period or in each tenth: windows of 48 and 50 periods. At the first speeds beyond the limit, and at
// those at which a window nearly has a turn less the travel at the limit.
TEST_F(EncoderMonitor, over_speed_of_the_fastest_machine_is_found_at_100_khz_and_its_highest_speed_is_none) {
    constexpr double LIMIT_RPM = 38400.0, FAST_PERIOD_S = 1e-5;
    parameters.rate_hz = 100000;
    parameters.travel = int32_t(LIMIT_RPM / 60.0 * FAST_PERIOD_S * 0x1p32);
    for (const double sign : {1.0, -1.0}) {
        for (const int spacing : {1, 10}) {
            for (const auto &[part, fails] :
                 {std::pair{0.9, false}, std::pair{1.0, false}, std::pair{1.05, false}, std::pair{1.08, true},
                  std::pair{1.3, true}, std::pair{1.5, true}, std::pair{1.9, true}}) {
                monitor = {};
                bool failed = false;
                for (int k = 0; k < 200; k += spacing) {
                    step(sign * part * LIMIT_RPM * 6.0 * FAST_PERIOD_S * k, 0.0, 0.0);
                    input.period += uint32_t(spacing) - 1u;
                    failed = failed || monitor.over_speed;
                }
                EXPECT_EQ(failed, fails) << sign * part << " " << spacing;
            }
        }
    }
}

TEST_F(EncoderMonitor, the_observer_shows_over_speed_when_the_counts_do_to_a_thirty_second) {
    for (const auto &[observed_rpm, counted_rpm, fails] :
         {std::tuple{3601.0, 3550.0, true}, std::tuple{3601.0, 3400.0, false}, std::tuple{-3601.0, 3550.0, true},
          std::tuple{3599.0, 3599.0, false}, std::tuple{7200.0, 0.0, false}}) {
        monitor = {};
        input.speed_q22 = to_fixed(rad_s(observed_rpm), Q22);
        bool failed = false;
        for (int k = 0; k < 100; k++) {
            step(counted_rpm * 6.0 * PERIOD_S * k, 0.0, 0.0);
            failed = failed || monitor.over_speed;
        }
        EXPECT_EQ(failed, fails) << observed_rpm << " " << counted_rpm;
    }
}

TEST_F(EncoderMonitor, a_jump_that_the_observer_follows_to_any_speed_is_no_over_speed) {
    input.speed_q22 = to_fixed(rad_s(6000.0), Q22);
    for (int k = 0; k < 100; k++) {
        step(k < 50 ? 0.0 : 0.75 * 3600.0 * 6.0 * PERIOD_S * 20, 0.0, 0.0); // three quarters of a window at the limit
        ASSERT_FALSE(monitor.over_speed) << k;
    }
}

} // namespace
