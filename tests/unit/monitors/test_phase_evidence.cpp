// Plausibility of the phase currents, at the limits of its tolerances, and its verdicts. Machine: saturating, 40 kHz,
// 240 V. [SR-25] [SR-26] [SR-27]
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <utility>

extern "C" {
#include "monitors/flux_monitor.h"
#include "storage/fault.h"
}

#include "support/flux_samples.h"

namespace {

class PhaseEvidence : public FluxSamples {
  protected:
    void SetUp() override {
        parameters.angle.current_min_q9 = INT32_MAX; // the encoder's angle is not judged
    }

    uint32_t step() {
        input.periods++;
        const uint32_t failed_now = flux_monitor_step(&parameters, &monitor, &input);
        flux_residual_follow(&monitor.residual, correction_q29);
        return failed_now;
    }

    // Periods until a check fails, at most `limit`; before each, `change` with the number of periods.
    template <typename Change> int periods_to_fault(int limit, Change change) {
        for (int k = 0; k <= limit; k++) {
            change(k);
            failed = step();
            if (failed != 0) {
                return k;
            }
        }
        return -1;
    }

    flux_monitor_parameters_t parameters{};
    flux_monitor_t monitor{};
    uint32_t failed = 0;
};

// [SR-25]
TEST_F(PhaseEvidence, voltage_without_current_is_phase_open_in_the_third_period_and_not_before_45_us) {
    EXPECT_EQ(periods_to_fault(20, [&](int k) { set(0, 0.0, k * 6e-3); }), 3);
    EXPECT_EQ(failed, FAULT_BIT(FAULT_PHASE_OPEN));
    EXPECT_EQ(monitor.phases, 1u);
}

// [SR-30]
TEST_F(PhaseEvidence, small_voltage_without_current_is_the_drop_of_the_devices) {
    EXPECT_EQ(periods_to_fault(4000, [&](int k) { set(0, 0.0, k * 6e-3 / 33.0); }), -1);
}

// [SR-29]
TEST_F(PhaseEvidence, a_fault_remains_until_the_end_of_the_run) {
    ASSERT_GT(periods_to_fault(20, [&](int k) { set(2, 0.0, k * 6e-3); }), 0);
    set(2, 0.0, 0.0);
    EXPECT_EQ(step(), FAULT_BIT(FAULT_PHASE_OPEN));
    input.run = false;
    EXPECT_EQ(step(), 0u);
    EXPECT_EQ(monitor.phases, 4u);
}

// [SR-30]
TEST_F(PhaseEvidence, current_and_flux_linkage_within_the_tolerances_agree) {
    input.electrical = MIDDLE;
    for (const double flux_error : {0.87, 1.0, 1.15}) {
        for (const double current_error : {0.95, 1.0, 1.05}) {
            EXPECT_EQ(periods_to_fault(400,
                                       [&](int k) {
                                           input.electrical += 1u << 22;
                                           const double current_A = k < 200 ? 0.1 * k : 20.0;
                                           set(0, current_A * current_error, table_Wb(current_A) * flux_error);
                                       }),
                      -1);
            input.electrical = MIDDLE;
            monitor = {};
        }
    }
}

// R i is up to 0.8 of the DC-link voltage. The current rises and falls; the integral with the parameter's resistance
// errs by what the winding's has taken more or less than that, and follows the tables. [SR-30]
TEST_F(PhaseEvidence, a_winding_from_minus_40_to_155_C_is_no_fault_while_its_current_falls_and_one_far_beyond_is) {
    constexpr double OHM = 10.0, PERIOD_S = 25e-6;
    input.resistance_period_q40 = int32_t(OHM * PERIOD_S * 0x1p40);
    input.electrical = 0; // aligned: no other angle explains more
    const struct {
        double factor;
        uint32_t failed;
    } windings[] = {{0.72, 0}, {1.0, 0}, {1.55, 0}, {1.9, FAULT_BIT(FAULT_PHASE_OPEN)}};
    for (const auto &winding : windings) {
        monitor = {};
        double error_Wb = 0.0;
        const int periods = periods_to_fault(330, [&](int k) {
            const double current_A = k < 200 ? 0.1 * k : 20.0 - 0.13 * (k - 200);
            error_Wb += correction_q29[0] / Q29;
            set(0, current_A, std::max(0.0, table_Wb(current_A) + error_Wb));
            error_Wb += (winding.factor - 1.0) * OHM * current_A * PERIOD_S;
        });
        EXPECT_EQ(failed, winding.failed) << winding.factor;
        EXPECT_EQ(periods > 0, winding.failed != 0) << winding.factor << " " << periods;
    }
}

// [SR-26]
TEST_F(PhaseEvidence, constant_current_at_rest_is_the_sensor_s_after_a_quarter_of_a_millisecond) {
    const int periods = periods_to_fault(100, [&](int) { input.current_q9[1] = 5 * 512; });
    EXPECT_EQ(failed, FAULT_BIT(FAULT_CURRENT_SENSOR));
    EXPECT_GE(periods, 10);
    EXPECT_LE(periods, 13);
    EXPECT_EQ(monitor.phases, 2u);
}

// [SR-26]
TEST_F(PhaseEvidence, constant_current_with_noise_is_the_sensor_s_after_8_ms_also_outside_a_run) {
    input.run = false;
    const int periods = periods_to_fault(1000, [&](int k) { input.current_q9[1] = 5 * 512 + k % 7; });
    EXPECT_EQ(failed, FAULT_BIT(FAULT_CURRENT_SENSOR));
    EXPECT_GE(periods, 320);
    EXPECT_LE(periods, 325);
}

// [SR-26]
TEST_F(PhaseEvidence, constant_current_with_noise_that_ends_after_half_a_millisecond_was_the_sensor_s) {
    const auto pulse = [&](int periods) {
        return periods_to_fault(100, [&](int k) { input.current_q9[1] = k < periods ? 5 * 512 + k % 7 : 0; });
    };
    EXPECT_EQ(pulse(18), -1) << "shorter than 20 periods and the one in which it begins";
    EXPECT_EQ(pulse(24), 24) << "in the sample in which it has ended";
    EXPECT_EQ(failed, FAULT_BIT(FAULT_CURRENT_SENSOR));
    EXPECT_EQ(monitor.phases, 2u);
}

// [SR-30]
TEST_F(PhaseEvidence, currents_that_the_voltage_ends_between_samples_are_no_corrections_of_the_integral) {
    // A current up to a period of opposite voltage, seen once while the switches are open, never at its end.
    double most_Wb = 0.0;
    for (int k = 0; k < 400; k++) {
        const bool ends = k % 4 == 3;
        set(1, ends ? 2.0 : 8.0, ends ? 5e-3 : 20e-3);
        input.off[1] = ends;
        input.next_q29[1] = ends ? 0 : int32_t(20e-3 * Q29);
        ASSERT_EQ(step(), 0u) << k;
        most_Wb = std::max(most_Wb, std::fabs(monitor.residual.phase[1].followed_q29 / Q29));
        ASSERT_LE(monitor.residual.sample.periods - monitor.residual.phase[1].zero_at, 4u) << k;
    }
    EXPECT_LT(most_Wb, 1e-3);
    // The duty that still acts drives it further: the integral goes on.
    set(1, 2.0, 5e-3);
    input.off[1] = true;
    input.next_q29[1] = int32_t(11e-3 * Q29);
    ASSERT_EQ(step(), 0u);
    EXPECT_LT(std::abs(correction_q29[1]), int32_t(0.1e-3 * Q29));
}

// [SR-30]
TEST_F(PhaseEvidence, an_offset_within_the_tolerance_is_none) {
    EXPECT_EQ(periods_to_fault(1000, [&](int) { input.current_q9[1] = 512; }), -1);
}

// [SR-27]
TEST_F(PhaseEvidence, current_that_moves_at_rest_is_a_shorted_phase) {
    const int periods = periods_to_fault(1000, [&](int k) { input.current_q9[1] = 20 * 512 + 64 * k; });
    EXPECT_EQ(failed, FAULT_BIT(FAULT_PHASE_SHORTED));
    EXPECT_GE(periods, 10);
    EXPECT_LE(periods, 13);
}

// [SR-26]
TEST_F(PhaseEvidence, current_of_a_phase_that_is_read_in_another_is_the_sensors) {
    EXPECT_GT(periods_to_fault(40,
                               [&](int k) {
                                   set(0, 0.0, k < 8 ? 0.0 : (k - 8) * 6e-3);
                                   input.current_q9[1] = k < 8 ? 0 : (k - 8) * 4 * 512;
                               }),
              8);
    EXPECT_EQ(failed, FAULT_BIT(FAULT_CURRENT_SENSOR));
    EXPECT_EQ(monitor.phases, 3u);
}

// The current of phase 0 ends at once, or does not begin although there is voltage; phase 1, which is off, has one.
// [SR-26]
TEST_F(PhaseEvidence, a_current_that_ends_or_does_not_begin_is_the_sensors_when_another_phase_has_one_that_moves) {
    input.electrical = MIDDLE;
    for (const bool ends : {true, false}) {
        monitor = {};
        const int periods = periods_to_fault(100, [&](int k) {
            input.current_q9[1] = k < 20 ? 0 : (10 + k - 20) * 512;
            if (ends && k < 20) {
                set(0, 10.0, table_Wb(10.0));
            } else if (ends) {
                set(0, 0.0, k == 20 ? table_Wb(10.0) : 0.0);
                input.off[0] = true;
            } else {
                set(0, 0.0, k < 20 ? 0.0 : 8e-3); // within the drop of the devices
            }
        });
        EXPECT_GT(periods, 20) << ends;
        EXPECT_EQ(failed, FAULT_BIT(FAULT_CURRENT_SENSOR)) << ends;
        EXPECT_EQ(monitor.phases, 3u) << ends;
    }
}

// The same as it ends, and phase 1 some time later. [SR-26] [SR-27]
TEST_F(PhaseEvidence, a_current_that_has_ended_explains_another_for_2_ms_and_not_again_when_the_periods_come_round) {
    input.electrical = MIDDLE;
    for (const uint32_t later : {4u, 60u, 100u, 8000u, UINT32_MAX}) {
        monitor = {};
        for (int k = 0; k < 20; k++) {
            set(0, 10.0, table_Wb(10.0));
            input.current_q9[1] = 0;
            ASSERT_EQ(step(), 0u);
        }
        set(0, 0.0, table_Wb(10.0));
        input.off[0] = true;
        ASSERT_EQ(step(), 0u);
        const uint32_t ended = input.periods;
        set(0, 0.0, 0.0);
        input.off[0] = true;
        for (uint32_t to = 1; to < later; to += to < later - to ? to : later - to) {
            input.periods = ended + to - 1;
            ASSERT_EQ(step(), 0u) << later;
        }
        input.periods = ended + later - 1;
        const int periods = periods_to_fault(100, [&](int k) { input.current_q9[1] = (10 + k) * 512; });
        EXPECT_GE(periods, 9) << later;
        EXPECT_LE(periods, 13) << later;
        EXPECT_EQ(failed, FAULT_BIT(later <= 60 ? FAULT_CURRENT_SENSOR : FAULT_PHASE_SHORTED)) << later;
    }
}

// Its switches are on; the unaligned position has the least flux linkage. [SR-27]
TEST_F(PhaseEvidence, a_current_without_the_flux_linkage_that_it_has_at_any_angle_is_a_shorted_phase) {
    for (const double part : {0.0, 0.9}) {
        monitor = {};
        const int periods = periods_to_fault(100, [&](int k) {
            const double current_A = 50.0 + 0.125 * k;
            set(0, current_A, part * table_Wb(current_A));
        });
        EXPECT_EQ(periods > 0, part < 0.5) << part;
        EXPECT_EQ(failed, part < 0.5 ? FAULT_BIT(FAULT_PHASE_SHORTED) : 0u) << part;
        if (part < 0.5) {
            EXPECT_GE(periods, 10);
            EXPECT_LE(periods, 13);
            EXPECT_EQ(monitor.phases, 1u);
        }
    }
}

// Both switches open at the aligned position: parts of what the voltage removes, less its tolerance for delays. [SR-27]
TEST_F(PhaseEvidence, a_current_that_falls_by_less_than_a_quarter_of_what_the_voltage_removes_is_a_shorted_phase) {
    for (const double part : {0.1, 0.21, 0.26, 0.5}) {
        monitor = {};
        input.electrical = 0;
        const double flux_Wb = table_Wb(20.0);
        periods_to_fault(80, [&](int k) {
            const double removed = std::clamp((k - 20) / 50.0, 0.0, 0.7);
            const double seen_Wb = flux_Wb * (1.0 - part * removed);
            double current_A = 20.0;
            while (table_Wb(current_A) > seen_Wb) {
                current_A -= 0.01;
            }
            set(0, current_A, flux_Wb * (1.0 - removed));
            input.off[0] = k >= 20;
        });
        EXPECT_EQ(failed, part < 0.25 ? FAULT_BIT(FAULT_PHASE_SHORTED) : 0u) << part;
    }
}

// Differences that an angle explains: `differ` of three phases, of which `conduct` conduct in turn, over more than four
// electrical revolutions.
class PhaseEvidenceInTurn : public PhaseEvidence {
  protected:
    int periods_with(unsigned differ, unsigned conduct, int step_of_revolution, int until = 1100, int each = 1) {
        return periods_to_fault(1100 + 250 * (each - 1), [&](int k) {
            input.electrical += uint32_t(step_of_revolution * (1 << 24)); // 256 periods in a revolution
            for (unsigned phase = 0; phase < conduct; phase++) {
                const uint32_t angle = input.electrical - phase * input.stroke;
                const bool conducts = angle >= MIDDLE - (1u << 29) && angle < MIDDLE;
                const double flux_Wb = phase_map_results::flux_q29(machine_tables, angle, 10 * 512) / Q29;
                set(phase, conducts ? 10.0 : 0.0,
                    conducts ? (phase < differ && k < until && k / 256 % each == 0 ? 1.8 : 1.0) * flux_Wb : 0.0);
                input.off[phase] = !conducts;
            }
        });
    }
};

// [SR-25] [SR-27]
TEST_F(PhaseEvidenceInTurn, one_phase_that_differs_at_its_angle_for_20_ms_is_a_fault) {
    for (const int direction : {1, -1}) {
        monitor = {};
        const int periods = periods_with(1, 3, direction);
        EXPECT_GT(periods, 20 * 40) << direction;
        EXPECT_LT(periods, 22 * 40) << direction;
        EXPECT_EQ(failed, FAULT_BIT(FAULT_PHASE_OPEN)) << direction;
    }
}

// [SR-30]
TEST_F(PhaseEvidenceInTurn, one_phase_that_differs_in_its_first_stroke_only_is_none) {
    for (const int direction : {1, -1}) {
        monitor = {};
        EXPECT_EQ(periods_with(1, 3, direction, 256), -1) << direction;
        EXPECT_EQ(monitor.phases_by_current.doubted, 0u) << direction;
    }
}

// [SR-30]
TEST_F(PhaseEvidenceInTurn, one_phase_that_differs_in_each_second_stroke_only_is_none) {
    for (const int direction : {1, -1}) {
        monitor = {};
        EXPECT_EQ(periods_with(1, 3, direction, 2200, 2), -1) << direction;
    }
}

// [SR-30]
TEST_F(PhaseEvidenceInTurn, two_phases_that_differ_at_their_angles_are_none) {
    EXPECT_EQ(periods_with(2, 3, 1), -1);
}

// [SR-30]
TEST_F(PhaseEvidenceInTurn, one_phase_that_differs_while_another_does_not_conduct_is_none) {
    EXPECT_EQ(periods_with(1, 2, 1), -1);
}

// Differences that change their side every few periods, of 256 in a revolution: too much flux linkage and too little.
// [SR-30]
TEST_F(PhaseEvidence, a_difference_that_changes_its_side_within_a_32nd_of_a_revolution_is_no_doubt) {
    for (const int periods : {4, 7, 12}) {
        monitor = {};
        uint32_t doubted = 0;
        EXPECT_EQ(periods_to_fault(500,
                                   [&](int k) {
                                       doubted |= monitor.phases_by_current.doubted;
                                       input.electrical += 1u << 24;
                                       const uint32_t angle = input.electrical;
                                       const bool conducts = angle >= MIDDLE && angle < MIDDLE + (1u << 29);
                                       const double factor = k / periods % 2 == 0 ? 1.5 : 0.1;
                                       set(0, conducts ? 10.0 : 0.0, conducts ? factor * table_Wb(10.0) : 0.0);
                                       input.off[0] = !conducts;
                                   }),
                  -1);
        EXPECT_EQ(doubted, periods > 8 ? 1u : 0u) << periods;
    }
}

// [SR-30]
TEST_F(PhaseEvidence, after_a_lost_trigger_the_integral_is_that_of_the_tables_and_no_fault) {
    input.electrical = MIDDLE;
    set(0, 10.0, table_Wb(10.0));
    EXPECT_EQ(step(), 0u);
    set(0, 10.0, 4.0 * table_Wb(10.0));
    input.late_interrupts++;
    EXPECT_EQ(step(), 0u);
    EXPECT_NEAR(correction_q29[0] / Q29, -3.0 * table_Wb(10.0), 1e-6);
}

// [SR-30]
TEST_F(PhaseEvidence, an_input_of_the_same_period_changes_nothing) {
    set(0, 10.0, 0.1);
    step();
    EXPECT_NE(correction_q29[0], 0);
    EXPECT_EQ(flux_monitor_step(&parameters, &monitor, &input), 0u);
    flux_residual_follow(&monitor.residual, correction_q29);
    EXPECT_EQ(correction_q29[0], 0);
}

// Phase b differs, c conducts at every angle, so that it agrees in each sample; a conducts in its turn or not at all.
// [SR-30]
TEST_F(PhaseEvidence, one_phase_that_differs_for_long_is_none_until_each_of_the_others_has_agreed) {
    // 20 ms end between two strokes of b, or in one.
    for (const auto &[a, in_a_revolution] :
         {std::pair{0u, 256.0}, {1u, 256.0}, {2u, 256.0}, {0u, 264.0}, {1u, 264.0}, {2u, 264.0}}) {
        for (const bool conducts_too : {false, true}) {
            monitor = {};
            const unsigned b = (a + 1) % 3;
            const int periods = periods_to_fault(2000, [&](int) {
                input.electrical += uint32_t(0x1p32 / in_a_revolution);
                for (unsigned phase = 0; phase < 3; phase++) {
                    const uint32_t angle = input.electrical - phase * input.stroke;
                    const bool in_turn = angle >= MIDDLE - (1u << 29) && angle < MIDDLE;
                    const bool conducts = phase == a ? in_turn && conducts_too : phase != b || in_turn;
                    const double flux_Wb = phase_map_results::flux_q29(machine_tables, angle, 10 * 512) / Q29;
                    set(phase, conducts ? 10.0 : 0.0, conducts ? (phase == b ? 1.8 : 1.0) * flux_Wb : 0.0);
                    input.off[phase] = !conducts;
                }
            });
            EXPECT_EQ(periods > 0, conducts_too) << a;
            EXPECT_EQ(failed, conducts_too ? FAULT_BIT(FAULT_PHASE_OPEN) : 0u) << a;
        }
    }
}

} // namespace
