// Learning the misalignment of each phase, against the reference model, on a machine with displaced phases.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/misalignment.h"
#include "control/phase_map.h"
#include "interrupts/configure.h"
#include "interrupts/deferred.h"
}

#include "support/phase_map_results.h"
#include "support/reference_builders.h"
#include "support/wide_integer.h"

namespace {

using namespace fixed_point;
constexpr uint32_t RATE_HZ = 40000 / DEFERRED_LEARNING_PERIODS; // of the updates
constexpr double BANDWIDTH_RAD_S = 250.0;
constexpr unsigned PHASES = 3;
constexpr double PROBE_RAD = 0.01;
using offsets_t = std::array<double, PHASES>; // degrees

misalignment_parameters_t parameters_of(int32_t rate_1_s,
                                        drive_controller_t controller = DRIVE_CONTROLLER_TRADITIONAL) {
    parameters_t p;
    parameters_init(&p);
    p.values[PARAMETER_CONTROLLER] = controller;
    p.values[PARAMETER_ANGLE_ADAPTATION] = rate_1_s != 0;
    if (rate_1_s != 0) {
        p.values[PARAMETER_ANGLE_ADAPTATION_1_S] = rate_1_s;
    }
    return configure_control(&p, &machine_tables, 40000, 17, 12, fixed_point::TIMER_CLOCK_HZ).misalignment;
}

double electrical_rev_of(double rad) {
    return rad / (2.0 * PI) * machine_tables.rotor_poles;
}

double degrees(double rad) {
    return rad * 180.0 / PI;
}

// Phases that conduct one after the other at constant current and whose torque is displaced by some degrees. The load
// observer is modelled as two lags of about its bandwidth, without its speed correction.
class Machine {
  public:
    explicit Machine(int32_t rate_1_s, const offsets_t &off_deg) : parameters(parameters_of(rate_1_s)), off(off_deg) {
        model = reference_model::model_of(parameters, PHASES, RATE_HZ);
    }

    void step(double torque_Nm, double load_Nm, bool steady) {
        step(torque_Nm, load_Nm, steady ? MISALIGNMENT_STEADY : MISALIGNMENT_UNSTEADY);
    }

    void step(double torque_Nm, double load_Nm, misalignment_condition_t condition) {
        const double electrical_rev = rpm / 60.0 * machine_tables.rotor_poles / RATE_HZ;
        position += electrical_rev;
        int32_t current_q9[HAL_PHASES_MAX] = {};
        uint32_t angle[HAL_PHASES_MAX] = {};
        std::array<double, PHASES> slope{};
        double torque_error = 0.0; // torque from the tables less true torque
        for (unsigned phase = 0; phase < PHASES; phase++) {
            const double assumed = position - double(phase) / PHASES;
            const double corrected = assumed - state.phase[phase].offset / REV;
            angle[phase] = angle_from_rev(corrected);
            const double wrapped = corrected - std::floor(corrected);
            if (wrapped > 0.6 && wrapped < 0.95) {
                current_q9[phase] = 15 * 512;
            }
            const auto torque = [&](double rev) {
                return phase_map_results::torque_q24(machine_tables, angle_from_rev(rev), current_q9[phase]) / Q24;
            };
            if (current_q9[phase] > 0) {
                slope[phase] = phase_map_torque_slope_q24(&machine_tables, angle[phase], current_q9[phase],
                                                          2 * parameters.probe_angle) /
                               Q24 / (2.0 * PROBE_RAD);
                torque_error += torque(corrected) - torque(assumed - electrical_rev_of(off[phase] / 180.0 * PI));
            }
        }
        const double lag_gain = model.filter_factor * BANDWIDTH_RAD_S / RATE_HZ;
        lag[0] += lag_gain * (torque_error - lag[0]);
        lag[1] += lag_gain * (lag[0] - lag[1]);
        const unsigned learned = state.phase_index;
        const misalignment_sample_t sample = {.current_q9 = current_q9[learned],
                                              .angle = angle[learned],
                                              .disturbance_q24 = to_fixed(load_Nm + lag[1], Q24),
                                              .torque_q24 = to_fixed(torque_Nm, Q24),
                                              .bandwidth_rad_s = uint32_t(BANDWIDTH_RAD_S),
                                              .condition = condition,
                                              .flux_misalignment = by_flux[learned]};
        misalignment_step(&parameters, &state, &machine_tables, &sample);
        model.step(sample.disturbance_q24 / Q24, BANDWIDTH_RAD_S, condition == MISALIGNMENT_STEADY, torque_Nm,
                   [&](unsigned phase) { return slope[phase]; });
        const unsigned each = DEFERRED_COMMON_PERIODS / DEFERRED_LEARNING_PERIODS;
        if (common && ++updates % each == 0) {
            misalignment_common_step(&parameters, &state, PHASES, sample.torque_q24,
                                     to_fixed(electrical_rev * PHASES * each, 65536.0));
        }
    }

    double offset_deg(unsigned phase) const {
        const double electrical_rev = state.phase[phase].offset / REV;
        return electrical_rev / machine_tables.rotor_poles * 360.0;
    }

    misalignment_parameters_t parameters;
    misalignment_t state{};
    reference_model::misalignment_t model{};
    offsets_t off;
    double rpm = 150.0;
    bool common = false;                   // the common angle is learned, too
    std::array<int32_t, PHASES> by_flux{}; // 2^-32 electrical rev
    unsigned updates = 0;
    double position = 0.0;
    std::array<double, 2> lag{};
};

// By the equations of the header, for a machine with a unit of speed of 1 rad/s.
TEST(Misalignment, parameters_are_those_of_the_rate_and_the_update_intervals) {
    for (const int32_t rate_1_s : {8, 100}) {
        for (const uint32_t rate_hz : {20000u, 40000u, 100000u}) {
            const misalignment_settings_t settings = {.rate_1_s = rate_1_s,
                                                      .control_rate_hz = rate_hz,
                                                      .periods_per_update = 4,
                                                      .periods_per_common_update = 16,
                                                      .inertia_q30 = to_fixed(0.02, Q30),
                                                      .phases = PHASES,
                                                      .rotor_poles = 4,
                                                      .encoder_bits = 17,
                                                      .bandwidth_rad_s = 250,
                                                      .speed_exponent = 0};
            const misalignment_parameters_t p = misalignment_configure(&settings);
            const double phase_s = 4.0 * PHASES / rate_hz, common_s = 16.0 / rate_hz;
            const auto near = [&](const char *what, double got, double exact) {
                EXPECT_NEAR(got, exact, 1.0 + 1e-3 * exact) << what << " " << rate_1_s << " " << rate_hz;
            };
            near("rate of a phase", p.rate_q30, rate_1_s * phase_s * Q30);
            near("rate of the common angle", p.common_rate_q30, rate_1_s / 2.0 * common_s * Q30);
            near("rate by the flux linkage", p.flux_rate_q8,
                 rate_1_s / 2.0 * phase_s * Q40 / (2.0 * p.probe_angle) * Q8);
            near("filter", p.filter_q32, 1.6 * phase_s * Q32);
            near("mean", p.mean_q16, 10.0 * phase_s * Q16);
            near("J / Ts", p.inertia_rate_q8, 0.02 * rate_hz * Q8);
            near("settling", p.settle_updates, 0.150 / 4.0 * rate_hz);
        }
    }
}

TEST(Misalignment, that_of_every_phase_is_learned_to_0_02_degrees_in_1_5_s_as_by_the_reference_model) {
    for (const offsets_t &off : {offsets_t{0.2, 0.2, 0.2}, offsets_t{-0.3, 0.1, 0.2}, offsets_t{0.0, 0.5, 0.0}}) {
        Machine machine(12, off);
        double worst = 0.0;
        for (int k = 0; k < int(1.5 * RATE_HZ); k++) {
            machine.step(8.0, 8.0, true);
            for (unsigned phase = 0; phase < PHASES; phase++) {
                worst =
                    std::max(worst, std::fabs(machine.offset_deg(phase) - degrees(machine.model.offset_rad[phase])));
            }
        }
        for (unsigned phase = 0; phase < PHASES; phase++) {
            EXPECT_NEAR(machine.offset_deg(phase), off[phase], 0.02 + 0.05 * std::fabs(off[phase])) << phase;
        }
        EXPECT_LT(worst, 0.01) << "degrees between firmware and model";
        EXPECT_GT(worst, 1e-6);
    }
}

TEST(Misalignment, is_not_learned_while_unsteady_below_1_Nm_or_before_settling) {
    Machine unsteady(12, {0.3, 0.3, 0.3}), idle(12, {0.3, 0.3, 0.3}), settling(12, {0.3, 0.3, 0.3});
    for (int k = 0; k < int(RATE_HZ); k++) {
        unsteady.step(8.0, 8.0, false);
        idle.step(0.99, 0.99, true);
        settling.step(8.0, 8.0, uint32_t(k) % (settling.parameters.settle_updates + 1) != 0);
    }
    for (unsigned phase = 0; phase < PHASES; phase++) {
        EXPECT_EQ(unsteady.offset_deg(phase), 0.0);
        EXPECT_EQ(idle.offset_deg(phase), 0.0);
        EXPECT_EQ(settling.offset_deg(phase), 0.0);
    }
}

TEST(Misalignment, is_learned_between_interruptions_once_150_ms_without_them_have_added_up) {
    Machine machine(12, {1.0, 1.0, 1.0});
    const auto interrupted = [](int k) { return k % 400 < 100 ? MISALIGNMENT_INTERRUPTED : MISALIGNMENT_STEADY; };
    const int settling = int(machine.parameters.settle_updates) * 4 / 3;
    for (int k = 0; k < settling; k++) {
        machine.step(8.0, 8.0, interrupted(k));
        EXPECT_EQ(machine.offset_deg(0), 0.0) << k;
    }
    for (int k = 0; k < 2 * int(RATE_HZ); k++) {
        const double before = machine.offset_deg(0);
        machine.step(8.0, 8.0, interrupted(k));
        if (interrupted(k) == MISALIGNMENT_INTERRUPTED) {
            EXPECT_EQ(machine.offset_deg(0), before) << k;
        }
    }
    for (unsigned phase = 0; phase < PHASES; phase++) {
        EXPECT_NEAR(machine.offset_deg(phase), 1.0, 0.1);
    }
}

TEST(Misalignment, is_learned_between_times_without_torque_as_between_interruptions) {
    Machine machine(12, {1.0, 1.0, 1.0});
    for (int k = 0; k < 4 * int(RATE_HZ); k++) {
        const double before = machine.offset_deg(0);
        const double torque_Nm = k % 400 < 100 ? 0.9 : 8.0;
        machine.step(torque_Nm, 8.0, true);
        if (torque_Nm < 1.0) {
            EXPECT_EQ(machine.offset_deg(0), before) << k;
        }
    }
    for (unsigned phase = 0; phase < PHASES; phase++) {
        EXPECT_NEAR(machine.offset_deg(phase), 1.0, 0.1);
    }
}

TEST(Misalignment, is_kept_while_unsteady_and_with_a_learning_rate_of_zero) {
    Machine machine(12, {0.3, -0.2, 0.1});
    for (int k = 0; k < int(RATE_HZ); k++) {
        machine.step(8.0, 8.0, true);
    }
    offsets_t learned{};
    for (unsigned phase = 0; phase < PHASES; phase++) {
        learned[phase] = machine.offset_deg(phase);
        EXPECT_NE(learned[phase], 0.0);
    }
    for (int k = 0; k < int(RATE_HZ); k++) {
        machine.step(8.0, 3.0, false);
    }
    machine.parameters.rate_q30 = 0;
    for (int k = 0; k < int(RATE_HZ); k++) {
        machine.step(8.0, 3.0, true);
    }
    for (unsigned phase = 0; phase < PHASES; phase++) {
        EXPECT_EQ(machine.offset_deg(phase), learned[phase]);
    }
    EXPECT_EQ(parameters_of(0).rate_q30, 0) << "switched off";
}

TEST(Misalignment, an_aligned_machine_learns_less_than_0_01_degrees_from_a_load_unlike_its_torque) {
    Machine machine(12, {0.0, 0.0, 0.0});
    for (int k = 0; k < int(RATE_HZ); k++) {
        machine.step(8.0, 5.0, true);
    }
    for (unsigned phase = 0; phase < PHASES; phase++) {
        EXPECT_NEAR(machine.offset_deg(phase), 0.0, 0.01);
    }
}

TEST(Misalignment, at_600_rpm_the_common_angle_is_learned_in_1_s_and_the_phases_alone_take_longer) {
    for (const double off : {0.5, -0.5, 2.0}) {
        Machine with(8, {off, off, off}), without(8, {off, off, off});
        with.common = true;
        with.rpm = without.rpm = 600.0;
        with.parameters.noise_q22 = 0;
        for (int k = 0; k < int(RATE_HZ); k++) {
            with.step(8.0, 8.0, true);
            without.step(8.0, 8.0, true);
        }
        for (unsigned phase = 0; phase < PHASES; phase++) {
            EXPECT_NEAR(with.offset_deg(phase) / off, 1.0, 0.08) << off << ", phase " << phase;
            EXPECT_LT(without.offset_deg(phase) / off, 0.6) << off << ", phase " << phase;
        }
    }
}

TEST(Misalignment, at_1500_rpm_where_sampling_folds_the_steps_of_the_slopes_the_common_angle_is_learned_in_3_s) {
    Machine machine(8, {1.0, 1.0, 1.0});
    machine.common = true;
    machine.parameters.noise_q22 = 0;
    machine.rpm = 1500.0;
    for (int k = 0; k < int(3 * RATE_HZ); k++) {
        machine.step(8.0, 8.0, true);
    }
    for (unsigned phase = 0; phase < PHASES; phase++) {
        EXPECT_NEAR(machine.offset_deg(phase), 1.0, 0.05) << phase;
    }
}

// Rounding makes a y of 3 J w0^2 of the error of each angle.
TEST(Misalignment, of_the_rounding_to_counts_the_common_angle_makes_at_most_0_03_degrees) {
    const double count_rad = 2.0 * PI / std::ldexp(1.0, 17);
    const double stiffness_Nm = 0.02 * 250.0 * 250.0; // J w0^2 of the saturating machine
    const auto worst_deg = [&](bool noise) {
        Machine machine(8, {0.0, 0.0, 0.0});
        machine.parameters.noise_q22 = noise ? parameters_of(8, DRIVE_CONTROLLER_SALIENT).noise_q22 : 0;
        machine.common = true;
        machine.rpm = 1300.0;
        std::mt19937 random(5);
        std::uniform_real_distribution<double> rounding(-0.5 * count_rad, 0.5 * count_rad);
        double worst = 0.0;
        for (int k = 0; k < int(8 * RATE_HZ); k++) {
            machine.step(8.0, 8.0 + 3.0 * stiffness_Nm * rounding(random), true);
            const double common_rad = 0.02 * std::ldexp(double(machine.state.common_sum_q40), -40);
            worst = std::max(worst, std::fabs(degrees(common_rad)));
        }
        return worst;
    };
    const double count_Nm = stiffness_Nm * count_rad;
    EXPECT_NEAR(parameters_of(8, DRIVE_CONTROLLER_SALIENT).noise_q22 / std::ldexp(1.0, 22),
                75.0 * 8.0 / 40000.0 * count_Nm * count_Nm, 1e-6);
    const double limited = worst_deg(true);
    EXPECT_GT(limited, 0.001);
    EXPECT_LT(limited, 0.03); // twice s
    EXPECT_GT(worst_deg(false), 2.0 * limited);
}

TEST(Misalignment, under_a_load_that_moves_each_phase_takes_that_of_the_flux_linkage_within_1_s) {
    const offsets_t off{0.5, -2.0, 1.0};
    Machine machine(12, {0.0, 0.0, 0.0}), unknown(12, off);
    for (unsigned phase = 0; phase < PHASES; phase++) {
        machine.by_flux[phase] = to_fixed(electrical_rev_of(off[phase] / 180.0 * PI), REV);
    }
    for (int k = 0; k < int(RATE_HZ); k++) {
        const double load_Nm = 8.0 + 4.0 * std::sin(2.0 * PI * 30.0 * k / RATE_HZ);
        machine.step(8.0, load_Nm, false);
        unknown.step(8.0, load_Nm, false);
        if (k % 100 == 0) {
            misalignment_end_stroke(&machine.state, true, true);
        }
    }
    for (unsigned phase = 0; phase < PHASES; phase++) {
        EXPECT_NEAR(machine.offset_deg(phase), off[phase], 0.02 * std::fabs(off[phase])) << phase;
        EXPECT_EQ(unknown.offset_deg(phase), 0.0) << phase;
    }
}

TEST(Misalignment, a_load_that_moves_with_the_strokes_teaches_little_more_than_what_the_flux_linkage_contradicts) {
    const auto worst_deg = [](bool by_flux) {
        Machine machine(12, {0.0, 0.0, 0.0});
        machine.by_flux.fill(by_flux ? 1 : 0);
        double worst = 0.0;
        for (int k = 0; k < int(3 * RATE_HZ); k++) {
            const double strokes = 150.0 / 60.0 * machine_tables.rotor_poles * PHASES * k / RATE_HZ;
            machine.step(8.0, 8.0 + 2.0 * std::sin(2.0 * PI * strokes / PHASES), true);
            for (unsigned phase = 0; phase < PHASES; phase++) {
                worst = std::max(worst, std::fabs(machine.offset_deg(phase)));
            }
        }
        return worst;
    };
    EXPECT_LT(worst_deg(true), 0.35);
    EXPECT_GT(worst_deg(false), 1.0);
}

TEST(Misalignment, what_the_ripple_shows_within_0_29_degrees_of_the_flux_linkage_is_learned) {
    Machine machine(12, {0.2, 0.2, 0.2});
    machine.by_flux.fill(1);
    for (int k = 0; k < int(1.5 * RATE_HZ); k++) {
        machine.step(8.0, 8.0, true);
    }
    for (unsigned phase = 0; phase < PHASES; phase++) {
        EXPECT_NEAR(machine.offset_deg(phase), 0.2, 0.02) << phase;
    }
}

TEST(Misalignment, of_a_load_step_at_3000_rpm_the_common_angle_learns_less_than_0_02_degrees_within_a_stroke) {
    Machine machine(8, {0.0, 0.0, 0.0});
    machine.parameters.rate_q30 = 0; // the phases learn nothing
    machine.common = true;
    machine.rpm = 3000.0;
    for (int k = 0; k < int(RATE_HZ); k++) {
        machine.step(8.0, 8.0, true);
    }
    for (int k = 0; k < int(0.0017 * RATE_HZ); k++) {
        machine.step(8.0, 0.0, true);
    }
    for (unsigned phase = 0; phase < PHASES; phase++) {
        EXPECT_NEAR(machine.offset_deg(phase), 0.0, 0.02);
    }
}

TEST(Misalignment,
     what_was_learned_in_the_last_two_strokes_is_forgotten_when_the_load_has_changed_and_its_amplitude_grown) {
    // Before those strokes, and after them.
    const auto learned_deg = [](bool changed, bool grown) {
        Machine machine(12, {0.3, 0.3, 0.3});
        const auto stroke = [&](bool steady, bool at_end) {
            for (int k = 0; k < int(RATE_HZ / 30.0); k++) {
                machine.step(8.0, 8.0, steady);
            }
            misalignment_end_stroke(&machine.state, at_end, grown);
        };
        for (unsigned k = 0; k < 8; k++) {
            stroke(true, false);
        }
        const double before_deg = machine.offset_deg(1);
        stroke(true, false);
        stroke(true, changed);
        stroke(false, false);
        return std::array<double, 2>{before_deg, machine.offset_deg(1)};
    };
    const auto forgotten = learned_deg(true, true), reduced = learned_deg(true, false), same = learned_deg(false, true);
    EXPECT_GT(forgotten[0], 0.02);
    EXPECT_NEAR(forgotten[1], forgotten[0], 1e-6);
    EXPECT_GT(same[1], same[0] + 0.02);
    EXPECT_EQ(reduced, same);
}

TEST(Misalignment, the_common_angle_is_not_learned_while_unsteady) {
    Machine machine(12, {0.3, 0.3, 0.3});
    machine.common = true;
    for (int k = 0; k < int(RATE_HZ); k++) {
        machine.step(8.0, 8.0, false);
    }
    for (unsigned phase = 0; phase < PHASES; phase++) {
        EXPECT_EQ(machine.offset_deg(phase), 0.0);
    }
}

TEST(Misalignment, is_limited_to_four_degrees_and_overflows_nothing) {
    const misalignment_parameters_t p = parameters_of(100);
    for (const int32_t sign : {1, -1}) {
        misalignment_t state{};
        for (uint32_t k = 0; k < 2 * RATE_HZ; k++) {
            const bool on = k / 400 % 2 == 0;
            const misalignment_sample_t sample = {
                .current_q9 = on ? 79 * 512 : 0,
                .angle = on ? 0x90000000u : 0x81000000u,
                .disturbance_q24 = misalignment_disturbance_q24(p.inertia_rate_q8, sign * (on ? 60 << 24 : -(60 << 24)),
                                                                on == (sign > 0) ? INT32_MIN : INT32_MAX),
                .torque_q24 = 8 << 24,
                .bandwidth_rad_s = 250,
                .condition = MISALIGNMENT_STEADY,
            };
            misalignment_step(&p, &state, &machine_tables, &sample);
            misalignment_common_step(&p, &state, PHASES, sample.torque_q24, int32_t(k) << 14);
        }
        for (unsigned phase = 0; phase < PHASES; phase++) {
            const double deg = state.phase[phase].offset / REV / machine_tables.rotor_poles * 360.0;
            EXPECT_LE(std::fabs(deg), 4.02);
            EXPECT_GT(std::fabs(deg), 1.0);
        }
    }
}

// The ripple teaches nothing: the phases in turn, each by its own angle, with its slope at hand.
TEST(Misalignment, by_the_flux_linkage_alone_each_phase_approaches_its_angle_at_half_of_the_rate) {
    const misalignment_parameters_t parameters = parameters_of(8);
    misalignment_t state{};
    state.steady_updates = 100;
    const auto told = int32_t(electrical_rev_of(0.01) * REV);
    const int updates = int(RATE_HZ) / 4;
    for (int k = 0; k < updates; k++) {
        const unsigned phase = state.phase_index;
        EXPECT_EQ(phase, unsigned(k) % PHASES);
        misalignment_follow_flux(&parameters, &state, &machine_tables, angle_from_rev(0.75), 15 * 512,
                                 phase == 1 ? told : 0);
    }
    EXPECT_NEAR(state.phase[1].offset / double(told), 1.0 - std::exp(-8.0 / 2.0 / 4.0), 0.02);
    EXPECT_EQ(state.phase[0].offset, 0) << "0: unknown";
    EXPECT_EQ(state.steady_updates, 0u) << "learning from the ripple begins again";
    const int32_t slope_q24 =
        phase_map_torque_slope_q24(&machine_tables, angle_from_rev(0.75), 15 * 512, 2 * parameters.probe_angle);
    EXPECT_EQ(misalignment_slope_q24(&state), int32_t(PHASES) * slope_q24);
    EXPECT_NE(slope_q24, 0);
    for (unsigned phase = 0; phase < PHASES; phase++) {
        misalignment_follow_flux(&parameters, &state, &machine_tables, angle_from_rev(0.75), 0, 0);
    }
    EXPECT_EQ(misalignment_slope_q24(&state), 0) << "without current";
}

// A low-pass with a gain below 1: its change is the product rounded to 2 LSB.
void expect_low_pass(int32_t before, int32_t target, int32_t gain_q16, int32_t after, const char *of) {
    using namespace wide_integer;
    const wide_t change_q16 = (wide_t(target) - before) * gain_q16;
    const wide_t found_q16 = (wide_t(after) - before) * power_of_2(16);
    ASSERT_LE(std::llabs(int64_t(found_q16 - change_q16)), int64_t(1) << 16) << of;
}

misalignment_t any_state(std::mt19937 &random) {
    misalignment_t state{};
    const auto up_to = [&](int32_t most) { return wide_integer::any_up_to(random, 2 * most) - most; };
    for (unsigned phase = 0; phase < PHASES; phase++) {
        misalignment_phase_t &of = state.phase[phase];
        of.slope_lag1_q24 = up_to(4 << 24);
        of.slope_lag2_q24 = up_to(4 << 24);
        of.slope_mean_q24 = up_to(1 << 24);
        of.offset_q40 = int64_t(up_to(1 << 29)) * 2048;
    }
    state.disturbance_mean_q24 = up_to(1 << 24);
    state.power_q24 = wide_integer::any_up_to(random, 8 << 24);
    state.common_power_q40 = int64_t(wide_integer::any_up_to(random, 1 << 30)) << (random() % 12);
    state.common_slope = {up_to(1 << 24), up_to(1 << 24)};
    state.common_disturbance = {up_to(1 << 24), up_to(1 << 24)};
    state.learning = true;
    return state;
}

TEST(MisalignmentRounding, a_step_of_a_phase_rounds_products_and_low_passes_as_its_header_states) {
    using namespace wide_integer;
    std::mt19937 random(4);
    misalignment_parameters_t parameters = parameters_of(100);
    int limited = 0, learned = 0;
    for (int i = 0; i < 20000; i++) {
        parameters.mean_q16 = 1 + any_up_to(random, 65534);
        misalignment_t state = any_state(random);
        state.steady_updates = parameters.settle_updates;
        // Sums and means without a rounding of their own.
        const int32_t mean_q24 = 4 * (any_up_to(random, 1 << 22) - (1 << 21));
        const misalignment_sample_t sample = {.current_q9 = any_up_to(random, 20 * 512),
                                              .angle = uint32_t(random()),
                                              .disturbance_q24 = int32_t(PHASES) * mean_q24,
                                              .torque_q24 = (1 << 24) + 1 + any_up_to(random, 1 << 26),
                                              .bandwidth_rad_s = 20 + uint32_t(any_up_to(random, 1500)),
                                              .condition = MISALIGNMENT_STEADY};
        const misalignment_t before = state;
        misalignment_step(&parameters, &state, &machine_tables, &sample);
        const misalignment_phase_t &was = before.phase[0], &is = state.phase[0];
        const wide_t filter_q16 =
            nearest(wide_t(sample.bandwidth_rad_s) * 65536 * parameters.filter_q32, power_of_2(32));
        const auto lag_q16 = int32_t(filter_q16 < 65535 ? filter_q16 : 65535);
        expect_low_pass(was.slope_lag1_q24, is.slope_q24, lag_q16, is.slope_lag1_q24, "first filter");
        expect_low_pass(was.slope_lag2_q24, is.slope_lag1_q24, lag_q16, is.slope_lag2_q24, "second filter");
        expect_low_pass(was.slope_mean_q24, is.slope_lag2_q24, parameters.mean_q16, is.slope_mean_q24, "mean");
        const int32_t alternating_q24 = is.slope_lag2_q24 - is.slope_mean_q24;
        const wide_t square_q24 = nearest(wide_t(alternating_q24) * alternating_q24, power_of_2(24));
        const int32_t gain_q16 = parameters.mean_q16 / int32_t(PHASES) + 1;
        expect_low_pass(before.power_q24, saturated(PHASES * square_q24), gain_q16, state.power_q24, "power");
        expect_low_pass(before.disturbance_mean_q24, sample.disturbance_q24, gain_q16, state.disturbance_mean_q24, "y");

        const int32_t error_q24 = mean_q24 - state.disturbance_mean_q24;
        const wide_t torque_square_q24 =
            saturated(nearest(wide_t(sample.torque_q24) * sample.torque_q24, power_of_2(24)));
        const wide_t floor_q24 = nearest(torque_square_q24 * (21 << 12), power_of_2(32)); // 0.05 of (0.02 rad)^2
        const wide_t divisor_q20 = rounded_down(saturated(state.power_q24 + floor_q24), 16) + 1;
        const wide_t product_q30 = nearest(wide_t(error_q24) * alternating_q24, power_of_2(18));
        if (!fits(2 * product_q30)) {
            continue; // saturates, to within some LSB of the end
        }
        const wide_t step_q10 = std::clamp<wide_t>(product_q30 / divisor_q20, -4096, 4096); // 0.08 rad
        ASSERT_EQ(is.offset_q40 - was.offset_q40, int64_t(step_q10 * parameters.rate_q30)) << i;
        const wide_t offset_q28 = nearest(is.offset_q40, power_of_2(12));
        ASSERT_EQ(is.offset, int32_t(nearest(offset_q28 * parameters.probe_angle, power_of_2(27)))) << i;
        limited += step_q10 == 4096 || step_q10 == -4096;
        learned += step_q10 != 0;
    }
    EXPECT_GT(learned, 2000);
    EXPECT_GT(limited, 20);
    EXPECT_LT(limited, learned);
}

TEST(MisalignmentRounding, a_step_of_the_common_angle_rounds_products_and_low_passes_as_its_header_states) {
    using namespace wide_integer;
    std::mt19937 random(5);
    misalignment_parameters_t parameters = parameters_of(100);
    parameters.noise_q22 = 0;
    int learned = 0;
    for (int i = 0; i < 20000; i++) {
        misalignment_t state = any_state(random);
        const misalignment_t before = state;
        state.disturbance_sum_q24 = 4 * int64_t(any_up_to(random, 1 << 25) - (1 << 24));
        const int32_t torque_q24 = any_up_to(random, 1 << 30), part_q16 = any_up_to(random, 1 << 14);
        misalignment_common_step(&parameters, &state, PHASES, torque_q24, part_q16);
        const int32_t gain_q16 = 4 * std::min(part_q16, 1 << 13); // of a stroke
        int32_t sum_q24 = 0;
        for (unsigned phase = 0; phase < PHASES; phase++) {
            sum_q24 += before.phase[phase].slope_lag2_q24 / 4;
        }
        const auto expect_band = [&](const misalignment_band_t &was, const misalignment_band_t &is, int32_t value_q24) {
            expect_low_pass(was.mean_q24, value_q24, gain_q16, is.mean_q24, "mean of the band");
            expect_low_pass(was.value_q24, value_q24 - is.mean_q24, gain_q16, is.value_q24, "band");
        };
        expect_band(before.common_slope, state.common_slope, sum_q24);
        expect_band(before.common_disturbance, state.common_disturbance, int32_t(state.disturbance_sum_q24 / 4));
        const wide_t quarter_q24 = state.common_slope.value_q24;
        const wide_t square_q40 = rounded_down(quarter_q24 * quarter_q24, power_of_2(8));
        ASSERT_EQ(state.common_power_q40 - before.common_power_q40,
                  int64_t(rounded_down(square_q40 - before.common_power_q40, power_of_2(8))));
        const wide_t torque_q9 = torque_q24 >> 15;
        const wide_t floor_q22 = rounded_down(torque_q9 * torque_q9, power_of_2(25)) + 1;
        const wide_t power_q22 = saturated(rounded_down(state.common_power_q40, power_of_2(18)));
        const wide_t product_q30 = nearest(quarter_q24 * state.common_disturbance.value_q24, power_of_2(18));
        if (!fits(2 * product_q30)) {
            continue; // saturates, to within some LSB of the end
        }
        const wide_t step_q10 = std::clamp<wide_t>(product_q30 / saturated(power_q22 + floor_q22), -4096, 4096);
        ASSERT_EQ(state.common_sum_q40, int64_t(step_q10 * parameters.common_rate_q30)) << i;
        learned += step_q10 != 0;
    }
    EXPECT_GT(learned, 2000);
}

TEST(MisalignmentRounding, a_step_by_the_flux_linkage_is_rounded_down_to_2_to_the_minus_40) {
    using namespace wide_integer;
    std::mt19937 random(6);
    const misalignment_parameters_t parameters = parameters_of(8);
    for (int i = 0; i < 20000; i++) {
        misalignment_t state = any_state(random);
        state.phase[0].offset = any_up_to(random, 1 << 24);
        const misalignment_phase_t was = state.phase[0];
        const int32_t told = any_up_to(random, 1 << 25) - (1 << 24);
        misalignment_follow_flux(&parameters, &state, &machine_tables, uint32_t(random()), 0, told);
        const wide_t error = told != 0 ? wide_t(told) - was.offset : 0;
        ASSERT_EQ(state.phase[0].offset_q40 - was.offset_q40,
                  int64_t(rounded_down(error * parameters.flux_rate_q8, power_of_2(8))));
    }
}

TEST(MisalignmentDisturbance, is_load_torque_less_the_rounded_product_for_any_arguments) {
    using namespace wide_integer;
    std::mt19937 random(3);
    int exact = 0, saturating = 0;
    for (int i = 0; i < 200000; i++) {
        const int32_t rate_q8 = any_up_to(random, INT32_MAX), load_q24 = any(random), correction_q22 = any(random);
        const int32_t found_q24 = misalignment_disturbance_q24(rate_q8, load_q24, correction_q22);
        const wide_t product_q24 = nearest(wide_t(correction_q22) * rate_q8, power_of_2(6));
        const int32_t expected_q24 = saturated(wide_t(load_q24) - saturated(product_q24));
        if (fits(product_q24)) {
            ASSERT_EQ(found_q24, expected_q24) << rate_q8 << " " << load_q24 << " " << correction_q22;
            exact++;
        } else {
            ASSERT_LT(std::llabs(int64_t(found_q24) - expected_q24), 4 << 24);
            saturating++;
        }
    }
    EXPECT_GT(exact, 50000);
    EXPECT_GT(saturating, 10000);
}

// A sum of a quarter of each; as many as there are, and no more than the state has.
TEST(Misalignment, the_common_slope_is_of_all_phases_of_a_machine_of_three_to_six) {
    const misalignment_parameters_t parameters{};
    const auto mean_q24 = [&](unsigned phases) {
        misalignment_t state{};
        for (misalignment_phase_t &phase : state.phase) {
            phase.slope_lag2_q24 = 1 << 24;
        }
        misalignment_common_step(&parameters, &state, phases, 0, 1 << 14);
        return double(state.common_slope.mean_q24);
    };
    for (unsigned phases = 3; phases <= HAL_PHASES_MAX; phases++) {
        EXPECT_NEAR(mean_q24(phases), mean_q24(3) * phases / 3.0, 4.0) << phases;
    }
    EXPECT_EQ(mean_q24(HAL_PHASES_MAX + 1), mean_q24(HAL_PHASES_MAX));
    EXPECT_GT(mean_q24(3), 1000.0);
}

} // namespace
