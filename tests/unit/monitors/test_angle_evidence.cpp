// Encoder against flux linkage, on a phase whose state is known exactly. [SR-22]
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

#include <gtest/gtest.h>

extern "C" {
#include "control/applied_flux.h"
#include "control/load_observer.h"
#include "control/machine_tables.h"
#include "monitors/flux_monitor.h"
}

#include "support/fixed_point.h"
#include "support/phase_map_results.h"

namespace {

using namespace fixed_point;
constexpr uint32_t RATE_HZ = 40000;
constexpr double PERIOD_S = 1.0 / RATE_HZ, DEGREE = 0x1p32 / 360.0;
constexpr uint32_t PHASES = 3, POLES = 4;

class AngleEvidence : public testing::Test {
  protected:
    AngleEvidence() {
        const load_observer_model_t model = load_observer_model(RATE_HZ, to_fixed(0.02, Q30), 0);
        const commutation_angles_t angles = {.turn_on = 1u << 31, .turn_off = 0xD5555555u, .outgoing_off = 0xF7000000u};
        parameters.commutation = commutation_configure(&angles, PHASES, POLES);
        parameters.half_count = (1u << 14) * POLES;
        parameters.middle = 1u << 14;
        parameters.advance_min = int32_t(0x1p32 / PHASES / POLES / ANGLE_EVIDENCE_ADVANCE_STROKES) +
                                 int32_t(ANGLE_EVIDENCE_ADVANCE_COUNTS * 2 * parameters.middle);
        parameters.angle_max = uint32_t(2 * DEGREE) * POLES;
        parameters.flux_error_q29 = angle_evidence_flux_error_q29(
            load_observer_acceleration(to_fixed(19.1, Q24), to_fixed(0.02, Q30)), 26 << 9, model.angle_step_q32, POLES);
        parameters.rate_hz = RATE_HZ;
        parameters.current_min_q9 = 6 << 9;
        input.run = true;
        std::fill_n(input.known, HAL_PHASES_MAX, true);
        input.flux_step_max_q29 = to_fixed(240.0 * PERIOD_S, Q29);
        input.period = 100;
        monitor_step();
    }

    // Sum of the evidence of samples. frozen: until the encoder counts; angle: until the run ends.
    struct Monitor {
        bool frozen, angle;
        uint32_t period;
        angle_evidence_t state;
        flux_evidence_t evidence;
    };
    struct Input {
        bool run;
        uint32_t period;
        int32_t flux_step_max_q29; // DC-link voltage times the control period
        uint32_t encoder_angle;
        int32_t torque_q24;
        uint32_t lost_phases;
        int32_t current_q9[HAL_PHASES_MAX], flux_q29[HAL_PHASES_MAX], drop_q29[HAL_PHASES_MAX];
        uint32_t zero_at[HAL_PHASES_MAX];
        bool known[HAL_PHASES_MAX];
    };

    void monitor_step() {
        flux_residual_t residual{};
        residual.phases = phases;
        residual.sample.run = input.run;
        residual.sample.encoder_angle = input.encoder_angle;
        residual.sample.torque_q24 = input.torque_q24;
        residual.sample.lost_phases = input.lost_phases;
        residual.sample.periods = input.period;
        residual.elapsed = input.period - monitor.period;
        residual.sample.period_flux_q29 = input.flux_step_max_q29;
        residual.shortest_q29 =
            applied_flux_shortest_pulse_q29(input.flux_step_max_q29, machine_tables.minimum_pulse_ns, RATE_HZ / 1000u);
        for (unsigned k = 0; k < phases; k++) {
            residual.phase[k].current_q9 = input.current_q9[k];
            residual.phase[k].voltage_q29 = input.flux_q29[k];
            residual.phase[k].drop_q29 = input.drop_q29[k];
            residual.phase[k].step_drop_q29 =
                fixed_multiply_high(input.current_q9[k] << 12, resistance_period_q40) * int32_t(residual.elapsed);
            residual.phase[k].zero_at = input.zero_at[k];
            residual.phase[k].known = input.known[k];
        }
        if (residual.elapsed == 0) {
            return;
        }
        monitor.period = input.period;
        monitor.evidence = {};
        angle_evidence_step(&parameters, &monitor.state, &residual, &monitor.evidence);
        monitor.frozen = flux_monitor_verdict(&monitor.evidence, 0) == FAULT_ENCODER;
        flux_evidence_t of_angle = monitor.evidence;
        of_angle.parted = false;
        monitor.angle = input.run && (monitor.angle || flux_monitor_verdict(&of_angle, 0) == FAULT_ENCODER_ANGLE);
    }

    // A fault of phase 2 is the encoder's, when these phases have had faults of their own.
    bool suspects(uint32_t phases) const {
        flux_evidence_t evidence = monitor.evidence;
        evidence.excess_moves = 4u;
        return flux_monitor_verdict(&evidence, phases) == FAULT_ENCODER_ANGLE;
    }

    // One period: the phase carries a current at a true rotor angle, the encoder shows another; in degrees, A.
    void step(double encoder_deg, double true_deg, double current_A, unsigned phase = 0) {
        input.period += spacing;
        input.encoder_angle = uint32_t(int64_t(encoder_deg * DEGREE)) & ~((1u << 15) - 1u);
        for (unsigned k = 0; k < phases; k++) {
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

    angle_evidence_parameters_t parameters{};
    Monitor monitor{};
    Input input{};
    int32_t resistance_period_q40 = 0;
    int32_t flux_offset_q29 = 0; // of the integral
    unsigned phases = PHASES;
    uint32_t spacing = 1; // periods between samples
};

// [SR-21]
TEST_F(AngleEvidence, the_tolerated_error_of_the_voltage_is_half_of_the_back_emf_after_2_degrees) {
    // Saturating: 0.34 Wb aligned less 0.017 unaligned at 26 A over pi / 4; 8.2 rad/s after 2 degrees at 955 rad/s^2.
    const double volts = parameters.flux_error_q29 / Q29 / PERIOD_S;
    EXPECT_GT(volts, 1.4);
    EXPECT_LT(volts, 1.9);
}

// [SR-21]
TEST_F(AngleEvidence, the_tolerated_error_grows_with_the_acceleration_up_to_a_million_rad_s2_and_no_further) {
    const load_observer_model_t model = load_observer_model(RATE_HZ, to_fixed(0.02, Q30), 0);
    const auto error_q29 = [&](int64_t acceleration) {
        return angle_evidence_flux_error_q29(acceleration, 26 << 9, model.angle_step_q32, POLES);
    };
    const int64_t most = INT64_C(1) << 20;
    EXPECT_NEAR(double(error_q29(most)), 2.0 * double(error_q29(most / 4)), 64.0 + double(error_q29(most)) * 1e-3);
    EXPECT_GT(error_q29(most), error_q29(most - most / 16));
    for (const int64_t more : {most + 1, 2 * most, int64_t(INT32_MAX), INT64_MAX}) {
        EXPECT_EQ(error_q29(more), error_q29(most)) << more;
    }
}

// [SR-21]
TEST_F(AngleEvidence, a_rotor_that_accelerates_while_the_encoder_does_not_count_is_found_after_1_to_4_degrees) {
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

// [SR-21]
TEST_F(AngleEvidence, a_rotor_at_rest_is_no_evidence_whatever_the_current_and_a_gain_of_the_sensor) {
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

TEST_F(AngleEvidence, an_angle_that_two_phases_contradict_is_a_fault_and_one_within_the_tolerance_is_none) {
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

TEST_F(AngleEvidence, one_phase_that_contradicts_the_angle_for_4_ms_is_enough_while_no_other_conducts) {
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

TEST_F(AngleEvidence, one_phase_alone_is_no_evidence_while_the_rotor_advances_with_the_torque_and_brings_the_next) {
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

TEST_F(AngleEvidence, a_contradiction_waits_for_the_next_phase_for_a_64th_of_a_second) {
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
TEST_F(AngleEvidence, one_phase_alone_is_no_evidence_when_all_others_but_a_lost_one_have_agreed_for_a_millisecond) {
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

TEST_F(AngleEvidence, a_phase_has_company_while_another_has_contradicted_the_angle_within_a_quarter_of_a_second) {
    EXPECT_FALSE(suspects(0));
    input.zero_at[1] = input.period + 1;
    for (int k = 0; k < 10; k++) {
        step(65.0 + 30.0, 65.0 + 30.0 - 12.0, 25.0, 1);
    }
    EXPECT_TRUE(suspects(1));
    EXPECT_FALSE(suspects(2));
    for (int k = 0; k < RATE_HZ / 4 + 10; k++) {
        step(65.0, 65.0, 0.0, 0);
    }
    EXPECT_FALSE(suspects(1));
}

// [SR-21]
TEST_F(AngleEvidence, integral_that_parts_faster_than_a_rotor_can_turn_is_no_frozen_encoder) {
    // By the link voltage's 6 mWb a period: of an open winding nearly all; of a rotor that turns at a twentieth of the
    // speed of full back-EMF a twentieth.
    const struct {
        double part;
        int begins;
        bool frozen;
    } cases[] = {{0.9, 50, false}, {0.05, 50, true}, {0.12, 1, false}, {0.05, 1, true}};
    for (const auto &[part, begins, frozen] : cases) {
        monitor = {};
        double excess_Wb = 0.0;
        for (int k = 0; k < 400; k++) {
            excess_Wb += k < begins || excess_Wb > 0.1 ? 0.0 : part * 240.0 * PERIOD_S;
            flux_offset_q29 = to_fixed(excess_Wb, Q29);
            step(75.0, 75.0, 25.0);
        }
        EXPECT_EQ(monitor.frozen, frozen) << part << " " << begins;
    }
}

// At nine tenths of the tolerated error of the voltage, for longer than the time constant of the leak. [SR-21]
TEST_F(AngleEvidence, an_integral_that_drifts_by_less_than_the_tolerated_error_for_long_is_no_frozen_encoder) {
    for (const auto &[part, frozen] : {std::pair{0.9, false}, std::pair{-0.9, false}, std::pair{2.0, true}}) {
        monitor = {};
        for (int k = 0; k < RATE_HZ / 40; k++) {
            flux_offset_q29 = int32_t(part * k * parameters.flux_error_q29);
            step(75.0, 75.0, 25.0);
        }
        EXPECT_EQ(monitor.frozen, frozen) << part;
    }
}

// [SR-21]
TEST_F(AngleEvidence, integral_that_jumps_after_the_current_has_fallen_is_no_frozen_encoder) {
    for (const bool jumps : {true, false}) {
        monitor = {};
        for (int k = 0; k < 400; k++) {
            const double current_A = std::clamp(25.0 - 0.1 * (k - 50), 13.0, 25.0);
            const double excess_Wb = k < 170 ? 0.0 : std::min(0.03, 0.05 * 240.0 * PERIOD_S * (jumps ? 1e3 : k - 170));
            flux_offset_q29 = to_fixed(excess_Wb, Q29);
            step(75.0, 75.0, current_A);
        }
        EXPECT_EQ(monitor.frozen, !jumps);
    }
}

// A sensor that fails for a sample: its current moves, the integral of the voltage does not. [SR-22] [SR-30]
TEST_F(AngleEvidence, a_current_that_moves_without_a_voltage_is_no_evidence_until_the_phase_was_without_current) {
    for (const bool fails : {true, false}) {
        monitor = {};
        input.zero_at[0] = input.period;
        const auto contradicted = [&](bool wrong) {
            for (int k = 0; k < (wrong ? 240 : 20); k++) {
                step(wrong ? 77.0 : 65.0, 65.0, 25.0);
            }
            return (monitor.evidence.contradicts & 1u) != 0;
        };
        EXPECT_FALSE(contradicted(false));
        if (fails) {
            const int32_t flux_q29 = input.flux_q29[0];
            step(65.0, 65.0, 8.0);
            flux_offset_q29 = flux_q29 - input.flux_q29[0];
            step(65.0, 65.0, 8.0);
            flux_offset_q29 = 0;
            step(65.0, 65.0, 25.0);
        }
        EXPECT_EQ(contradicted(true), !fails);
        monitor.state.phase[0].shown = false;
        input.zero_at[0] = input.period;
        EXPECT_TRUE(contradicted(true)) << fails;
    }
}

// [SR-22] [SR-30]
TEST_F(AngleEvidence, flux_linkage_that_a_warm_or_a_cold_winding_explains_does_not_contradict_the_angle) {
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

// [SR-21] [SR-30]
TEST_F(AngleEvidence, an_integral_that_drifts_by_a_warm_or_a_cold_winding_is_no_frozen_encoder) {
    resistance_period_q40 = int32_t(0.4 * PERIOD_S * 0x1p40); // 10 V at 25 A
    for (const auto &[factor, frozen] : {std::pair{0.4, true}, {0.72, false}, {1.55, false}, {2.3, true}}) {
        monitor = {};
        for (int k = 0; k < 2000; k++) {
            flux_offset_q29 = to_fixed((factor - 1.0) * 10.0 * PERIOD_S * std::min(k, 400), Q29);
            step(75.0, 75.0, 25.0);
        }
        EXPECT_EQ(monitor.frozen, frozen) << factor;
    }
}

// [SR-22] [SR-30]
TEST_F(AngleEvidence, flux_linkage_that_no_angle_explains_is_no_error_of_the_encoder) {
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

// Phase 0 contradicts the angle for longer than 1/256 s, alone, a time after phases 1 and 2 have agreed for 2 ms each.
TEST_F(AngleEvidence, an_agreement_speaks_for_the_encoder_for_a_quarter_of_a_second_and_within_its_run) {
    const struct {
        double since_s;
        bool in_run, fails;
    } cases[] = {{0.01, true, false}, {0.2, true, false}, {0.3, true, true}, {0.01, false, true}};
    for (const auto &one : cases) {
        monitor = {};
        for (const unsigned phase : {1u, 2u}) {
            input.zero_at[phase] = input.period + 1;
            const double aligned_deg = 65.0 + 30.0 * phase;
            for (int k = 0; k < RATE_HZ / 500; k++) {
                step(aligned_deg, aligned_deg, 25.0, phase);
            }
        }
        input.run = one.in_run;
        for (int k = 0; k < RATE_HZ * one.since_s; k++) {
            step(77.0, 65.0, 0.0);
        }
        input.run = true;
        input.zero_at[0] = input.period + 1;
        for (int k = 0; k < RATE_HZ / 150; k++) {
            step(77.0, 65.0, 25.0);
        }
        EXPECT_EQ(monitor.angle, one.fails) << one.since_s << " " << one.in_run;
    }
}

TEST_F(AngleEvidence, the_end_of_a_run_changes_nothing_beyond_the_last_phase) {
    struct {
        angle_evidence_t state;
        angle_evidence_phase_t beyond;
    } memory{};
    std::memset(&memory, 1, sizeof memory); // each bool of it is true
    flux_residual_t residual{};
    residual.phases = phases;
    flux_evidence_t evidence{};
    angle_evidence_step(&parameters, &memory.state, &residual, &evidence);
    EXPECT_FALSE(memory.state.phase[HAL_PHASES_MAX - 1].agreed);
    EXPECT_TRUE(memory.beyond.agreed);
    EXPECT_TRUE(memory.state.advanced);
}

TEST_F(AngleEvidence, a_contradiction_of_the_run_before_is_no_company_of_a_faulty_phase) {
    input.zero_at[1] = input.period + 1;
    for (int k = 0; k < 10; k++) {
        step(95.0, 83.0, 25.0, 1);
    }
    ASSERT_TRUE(suspects(1));
    input.run = false;
    step(95.0, 95.0, 0.0);
    input.run = true;
    step(95.0, 95.0, 0.0);
    EXPECT_FALSE(suspects(1));
}

// A phase that agreed, one that contradicted, and a rotor that advanced 2^32 periods ago have not done so now.
TEST_F(AngleEvidence, what_is_long_ago_does_not_count_again_when_the_number_of_the_period_comes_round) {
    input.torque_q24 = 1 << 24;
    input.zero_at[1] = input.period + 1;
    for (int k = 0; k < 10; k++) {
        step(95.0 + k * 0.3, 83.0 + k * 0.3, 25.0, 1);
    }
    ASSERT_TRUE(suspects(1));
    ASSERT_TRUE(monitor.state.advanced);
    const uint32_t then = input.period;
    for (int k = 0; k < RATE_HZ; k++) {
        step(98.0, 98.0, 0.0);
    }
    input.period = then;
    step(98.0, 98.0, 0.0);
    EXPECT_FALSE(suspects(1));
    EXPECT_FALSE(monitor.state.advanced);
}

TEST_F(AngleEvidence, a_contradiction_lasts_from_its_first_sample_on_however_far_apart_samples_are) {
    for (const uint32_t each : {1u, 2u, 4u, 10u}) {
        monitor = {};
        spacing = each;
        input.zero_at[0] = input.period + 1;
        const uint32_t before = input.period;
        step(77.0, 65.0, 25.0);
        EXPECT_EQ(monitor.evidence.contradicts, 0u) << "one sample, " << each;
        const uint32_t first = input.period;
        while (monitor.evidence.contradicts == 0 && input.period - first < 100) {
            step(77.0, 65.0, 25.0);
        }
        EXPECT_GE(input.period - first, 2u) << each;
        EXPECT_LT(input.period - first, 2u + each) << "three periods, " << each;
        while (!monitor.angle && input.period - before < 1000) {
            step(77.0, 65.0, 25.0);
        }
        EXPECT_GE(input.period - first, RATE_HZ / 256u) << each;
        EXPECT_LE(input.period - first, RATE_HZ / 256u + each) << each;
    }
}

// Phase 3 has the angles of phase 0, and never conducts.
TEST_F(AngleEvidence, of_four_phases_two_that_have_agreed_speak_for_the_encoder_and_one_alone_does_not) {
    phases = 4;
    for (const unsigned agreeing : {1u, 2u}) {
        monitor = {};
        for (unsigned phase = 1; phase <= agreeing; phase++) {
            input.zero_at[phase] = input.period + 1;
            const double aligned_deg = 65.0 + 30.0 * phase;
            for (int k = 0; k < RATE_HZ / 500; k++) {
                step(aligned_deg, aligned_deg, 25.0, phase);
            }
        }
        input.zero_at[0] = input.period + 1;
        for (int k = 0; k < RATE_HZ / 150; k++) {
            step(77.0, 65.0, 25.0);
        }
        EXPECT_EQ(monitor.angle, agreeing < 2) << agreeing;
    }
}

// The flux linkage of an integral that parts by a twentieth of the DC-link voltage. [SR-21]
TEST_F(AngleEvidence, an_integral_that_parts_from_its_first_sample_on_is_found_as_soon_as_one_that_does_so_later) {
    int first = 0;
    for (const int begins : {1, 200}) {
        monitor = {};
        input.zero_at[0] = input.period + 1;
        int k = 0;
        for (; !monitor.frozen && k < 1000; k++) {
            flux_offset_q29 = to_fixed(0.05 * 240.0 * PERIOD_S * std::max(0, k - begins), Q29);
            step(75.0, 75.0, 25.0);
        }
        ASSERT_TRUE(monitor.frozen);
        const int found = k - begins;
        first = begins == 1 ? found : first;
        EXPECT_LE(first, found);
        const uint32_t moved = monitor.state.phase[0].moved;
        EXPECT_GT(moved, RATE_HZ / 2048.0) << "not before this time";
        EXPECT_LE(moved - 1, RATE_HZ / 2048.0) << "and with the first sample after it";
    }
}

} // namespace
