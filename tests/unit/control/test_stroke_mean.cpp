// Whether the mean load of the strokes is constant.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>

#include <gtest/gtest.h>

extern "C" {
#include "control/stroke_mean.h"
}

#include "support/fixed_point.h"

namespace {

using namespace fixed_point;
constexpr uint32_t RATE_HZ = 10000;
constexpr unsigned PHASES = 3, ROTOR_POLES = 4;

// Share of the updates at which the load counted as constant, after the first `from_s`.
double constant_share(double rpm, const std::function<double(double time_s, double stroke)> &load_Nm, double torque_Nm,
                      double from_s = 1.0, double duration_s = 2.0) {
    const stroke_mean_parameters_t parameters = stroke_mean_configure(PHASES, RATE_HZ);
    stroke_mean_t mean{};
    unsigned constant = 0, updates = 0;
    for (uint32_t k = 0; k < uint32_t(duration_s * RATE_HZ); k++) {
        const double time_s = double(k) / RATE_HZ, electrical_rev = rpm / 60.0 * ROTOR_POLES * time_s;
        const double stroke = electrical_rev * PHASES;
        const bool now = stroke_mean_step(&parameters, &mean, angle_from_rev(electrical_rev),
                                          to_fixed(load_Nm(time_s, stroke), Q24), to_fixed(torque_Nm, Q24), false);
        if (stroke_mean_to_review(&mean)) {
            stroke_mean_review(&parameters, &mean);
        }
        if (time_s >= from_s) {
            constant += now;
            updates++;
        }
    }
    return double(constant) / updates;
}

TEST(StrokeMean, a_load_that_repeats_every_stroke_is_constant) {
    for (const double rpm : {20.0, 150.0, 600.0}) {
        const auto load = [](double, double stroke) { return 8.0 + 2.0 * std::sin(2.0 * PI * stroke); };
        EXPECT_EQ(constant_share(rpm, load, 8.0, 2.0, 4.0), 1.0) << rpm;
    }
}

TEST(StrokeMean, phases_of_different_means_are_a_constant_load) {
    const auto load = [](double, double stroke) {
        return 8.0 + 2.0 * std::sin(2.0 * PI * (std::floor(stroke) + 0.5) / PHASES);
    };
    for (const double rpm : {20.0, 150.0, 600.0}) {
        EXPECT_EQ(constant_share(rpm, load, 8.0, 2.5, 4.0), 1.0) << rpm;
    }
}

TEST(StrokeMean, a_load_that_moves_more_slowly_than_the_strokes_is_not_constant) {
    for (const double frequency_hz : {1.0, 7.0, 12.0}) {
        EXPECT_LT(constant_share(
                      150.0, [&](double t, double) { return 8.0 + 4.0 * std::sin(2.0 * PI * frequency_hz * t); }, 8.0),
                  0.2)
            << frequency_hz;
    }
}

TEST(StrokeMean, a_load_that_moves_by_little_from_stroke_to_stroke_is_not_constant) {
    const auto sine = [](double t, double) { return 8.0 + 4.0 * std::sin(2.0 * PI * t); };
    EXPECT_LT(constant_share(1500.0, sine, 8.0, 1.0, 3.0), 0.2);
}

constexpr double SLOW_STROKES_HZ = 50.0 / 60.0 * ROTOR_POLES * PHASES;

// At 50 r/min.
double constant_share_of_sine(double periods_per_stroke, double amplitude_Nm) {
    const auto sine = [=](double t, double) {
        return 8.0 + amplitude_Nm * std::sin(2.0 * PI * periods_per_stroke * SLOW_STROKES_HZ * t);
    };
    return constant_share(50.0, sine, 8.0, 1.0, 6.0);
}

TEST(StrokeMean, a_load_that_moves_with_nearly_the_frequency_of_slow_strokes_or_twice_that_is_hardly_ever_constant) {
    for (const double ratio : {0.9, 1.9, 2.1}) {
        EXPECT_LT(constant_share_of_sine(ratio, 3.0), 0.01) << ratio;
    }
    // Nearer to it, while its phase makes the halves of the stroke more equal.
    EXPECT_GT(constant_share_of_sine(1.06, 3.0), 0.05);
    EXPECT_LT(constant_share_of_sine(1.06, 3.0), 0.25);
    EXPECT_EQ(constant_share_of_sine(1.0, 3.0), 1.0);
}

TEST(StrokeMean, a_load_with_several_periods_in_a_slow_stroke_is_constant_below_the_tolerance_only) {
    for (const double ratio : {3.3, 4.0, 7.7, 20.0}) {
        EXPECT_LT(constant_share_of_sine(ratio, 3.0), 0.01) << ratio;
        EXPECT_LT(constant_share_of_sine(ratio, 2.0), 0.01) << ratio;
        EXPECT_EQ(constant_share_of_sine(ratio, 0.5), 1.0) << ratio;
    }
}

TEST(StrokeMean, an_amplitude_within_the_stroke_that_learning_reduces_is_that_of_a_constant_load) {
    const auto decaying = [](double amplitude_Nm, double decay_1_s) {
        return [=](double t, double stroke) {
            return 8.0 + amplitude_Nm * std::exp(-decay_1_s * t) * std::sin(2.0 * PI * stroke);
        };
    };
    for (const double rpm : {20.0, 50.0}) {
        EXPECT_EQ(constant_share(rpm, decaying(3.0, 1.0), 8.0, 2.0, 6.0), 1.0) << rpm;
        EXPECT_LT(constant_share(rpm, decaying(0.3, -0.7), 8.0, 2.0, 6.0), 0.9) << rpm;
    }
}

TEST(StrokeMean, a_load_step_counts_for_150_ms_after_the_first_whole_stroke) {
    const auto step = [](double t, double) { return t < 1.013 ? 0.0 : 8.0; };
    // Seen at the end of its stroke, 33 ms long at 150 r/min, and of the next one; phases that come later do not count.
    const double not_constant_s = 1.0 - constant_share(150.0, step, 8.0, 1.0, 2.0);
    EXPECT_GT(not_constant_s, 0.175);
    EXPECT_LT(not_constant_s, 0.19);
}

TEST(StrokeMean, of_a_load_that_moves_by_a_tenth_in_a_second_as_learning_moves_it_is_constant) {
    const auto ramp = [](double t, double) { return 8.0 - 0.8 * t; };
    for (const double rpm : {60.0, 150.0, 1500.0}) {
        EXPECT_EQ(constant_share(rpm, ramp, 8.0, 1.5, 4.0), 1.0) << rpm;
    }
    const auto faster = [](double t, double) { return 8.0 - 8.0 * t; };
    for (const double rpm : {60.0, 150.0, 1500.0}) {
        EXPECT_LT(constant_share(rpm, faster, 8.0, 0.5, 2.0), 0.2) << rpm;
    }
}

TEST(StrokeMean, a_change_below_0_1_Nm_and_a_16th_of_the_torque_is_constant) {
    const auto load = [](double change_Nm) {
        return [=](double t, double) { return t < 1.2 ? 8.0 : 8.0 + change_Nm; };
    };
    EXPECT_EQ(constant_share(150.0, load(0.58), 8.0), 1.0);
    EXPECT_LT(constant_share(150.0, load(0.62), 8.0), 1.0);
}

// Share of the updates of the last strokes in which the mean shows the load, by the given disturbance and mean load of
// a stroke.
double shown_share(const std::function<bool(unsigned stroke)> &disturbed,
                   const std::function<double(unsigned stroke)> &load_Nm) {
    const stroke_mean_parameters_t parameters = stroke_mean_configure(PHASES, RATE_HZ);
    stroke_mean_t mean{};
    unsigned shown = 0;
    for (unsigned stroke = 0; stroke < 96; stroke++) {
        for (unsigned update = 0; update < 100; update++) {
            const bool constant =
                stroke_mean_step(&parameters, &mean, angle_from_rev((stroke + update / 100.0) / PHASES),
                                 to_fixed(load_Nm(stroke), Q24), to_fixed(8.0, Q24), update == 40 && disturbed(stroke));
            shown += stroke >= 48 && constant && stroke_mean_shows_load(&mean);
        }
    }
    return shown / 4800.0;
}

TEST(StrokeMean, after_a_disturbance_the_mean_shows_the_load_from_the_end_of_an_undisturbed_stroke_on) {
    const auto constant = [](unsigned) { return 8.0; };
    EXPECT_EQ(shown_share([](unsigned) { return false; }, constant), 1.0);
    // In eight strokes from 40 % of the first to the end of the second not.
    EXPECT_NEAR(shown_share([](unsigned stroke) { return stroke % 8 == 0; }, constant), 1.0 - 1.6 / 8.0, 0.01);
}

TEST(StrokeMean, a_machine_whose_strokes_are_disturbed_at_a_constant_load_disturbs_itself_and_the_mean_shows_the_load) {
    const auto constant = [](unsigned) { return 8.0; };
    EXPECT_EQ(shown_share([](unsigned) { return true; }, constant), 1.0);
    EXPECT_EQ(shown_share([](unsigned stroke) { return stroke % 2 == 0; }, constant), 1.0);
}

TEST(StrokeMean, a_disturbed_load_that_moves_is_never_shown) {
    const auto alternating = [](unsigned stroke) { return stroke / 3 % 2 ? 8.0 : 4.0; };
    EXPECT_EQ(shown_share([](unsigned) { return true; }, alternating), 0.0);
}

TEST(StrokeMean, the_largest_loads_and_a_shaft_at_rest_overflow_nothing) {
    EXPECT_EQ(constant_share(
                  0.0, [](double, double) { return -64.0; }, -64.0, 35.0, 40.0),
              1.0);
    EXPECT_LT(constant_share(
                  3000.0, [](double t, double) { return std::fmod(t, 0.1) < 0.05 ? 64.0 : -64.0; }, 64.0),
              1.0);
}

// Strokes of 250 ms with a load of 8 N m and a swing of its own each.
TEST(StrokeMean, an_amplitude_grows_by_more_than_an_eighth_of_the_tolerated_change_or_not_at_all) {
    constexpr uint32_t UPDATES = RATE_HZ / 4;
    const stroke_mean_parameters_t parameters = stroke_mean_configure(PHASES, RATE_HZ);
    stroke_mean_t mean{};
    const double swing_Nm[] = {2.0, 2.0, 2.0, 2.1, 2.1, 2.5, 2.5, 2.5, 2.0, 2.0};
    const bool grown[] = {false, false, false, false, false, true, true, false, false, false};
    for (unsigned k = 0; k < 11 * UPDATES; k++) {
        const double stroke = double(k) / UPDATES;
        const unsigned number = k / UPDATES;
        const double load_Nm = 8.0 + swing_Nm[std::min(number, 9u)] * std::sin(2.0 * PI * stroke);
        stroke_mean_step(&parameters, &mean, angle_from_rev(stroke / PHASES), to_fixed(load_Nm, Q24),
                         to_fixed(8.0, Q24), false);
        if (stroke_mean_to_review(&mean)) {
            stroke_mean_review(&parameters, &mean);
            if (number >= 3) { // the first one, of a new load, counts for the second too
                EXPECT_EQ(mean.grown, grown[number - 1]) << number;
            }
        }
    }
}

TEST(StrokeMean, strokes_that_were_disturbed_are_those_of_the_present_load_alone) {
    constexpr uint32_t UPDATES = 100;
    const stroke_mean_parameters_t parameters = stroke_mean_configure(PHASES, RATE_HZ);
    stroke_mean_t mean{};
    bool changed = false;
    for (unsigned k = 0; k < 40 * UPDATES; k++) {
        const double load_Nm = k < 30 * UPDATES ? 8.0 : 12.0;
        stroke_mean_step(&parameters, &mean, angle_from_rev(double(k) / UPDATES / PHASES), to_fixed(load_Nm, Q24),
                         to_fixed(8.0, Q24), true);
        if (k == 30 * UPDATES - 1) {
            EXPECT_GE(mean.disturbed_strokes, 8u);
            EXPECT_TRUE(stroke_mean_shows_load(&mean)) << "the machine disturbs itself";
        }
        if (k > 30 * UPDATES && !changed && stroke_mean_ended(&mean) && mean.changed) {
            changed = true;
            EXPECT_EQ(mean.disturbed_strokes, 0u);
            EXPECT_FALSE(stroke_mean_shows_load(&mean));
        }
    }
    EXPECT_TRUE(changed);
}

} // namespace
