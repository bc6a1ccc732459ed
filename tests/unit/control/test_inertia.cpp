// Inertia by powers of two, from the regression of the acceleration on the torque.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>
#include <map>

#include <gtest/gtest.h>

extern "C" {
#include "control/inertia.h"
#include "control/machine_tables.h"
}

#include "support/fixed_point.h"

namespace {

using namespace fixed_point;
constexpr double J0 = 0.004, TORQUE_MAX = 19.0;
constexpr double REACHING_GAIN = 0.5;
constexpr int32_t RATE_Q8 = 40960;
constexpr load_observer_model_t MODEL{.acceleration_q32 = 1 << 28, .friction_q30 = 0, .angle_step_q32 = 1};
constexpr unsigned POLES = 4, PERIODS = 8;

inertia_settings_t settings(unsigned encoder_bits = 17, uint32_t rate_hz = 40000) {
    return {.control_rate_hz = rate_hz,
            .periods_per_update = PERIODS,
            .encoder_bits = encoder_bits,
            .rotor_poles = POLES,
            .inertia_q30 = to_fixed(J0 * std::ldexp(1.0, machine_tables.speed_exponent), Q30),
            .torque_max_q24 = to_fixed(TORQUE_MAX, Q24),
            .reaching_gain_q24 = to_fixed(REACHING_GAIN, Q24),
            .rate_q8 = RATE_Q8};
}

// Torque and load in N m over time in s.
using torque_t = std::function<double(double)>;

// Shift after half a second of a shaft of `gain` times the inertia J0, whose speed has settled after settled_s. last:
// state of an earlier run, and after this one. accelerates: any torque changes the speed, as in position mode.
int32_t shift_after(const inertia_settings_t &of, double gain, const torque_t &torque, const torque_t &load,
                    inertia_t *last = nullptr, double settled_s = 1.0, bool fine = false, bool accelerates = false) {
    const inertia_parameters_t parameters = inertia_configure(&of);
    inertia_t inertia = last != nullptr ? *last : inertia_t{};
    const double step_s = double(of.periods_per_update) / of.control_rate_hz;
    const double counts = std::ldexp(1.0, int(of.encoder_bits));
    double rev = 0.1, rev_s = 0.0;
    inertia_restart(&parameters, &MODEL, &inertia, angle_from_rev(rev) * POLES);
    for (double t = 0.0; t < 0.5; t += step_s) {
        const uint32_t angle = angle_from_rev(std::floor(rev * counts) / counts) * POLES;
        inertia_step(&parameters, &inertia, angle, to_fixed(0.5 * (torque(t - step_s) + torque(t)), Q24),
                     torque(t) >= TORQUE_MAX || (accelerates && torque(t) != 0.0), t < settled_s);
        if (fine) {
            inertia_refine(&parameters, &MODEL, &inertia);
        }
        const double mean_Nm = 0.5 * (torque(t) - load(t) + torque(t + step_s) - load(t + step_s));
        const double change = mean_Nm / (gain * J0 * 2.0 * PI) * step_s;
        rev += (rev_s + 0.5 * change) * step_s;
        rev_s += change;
    }
    if (last != nullptr) {
        *last = inertia;
    }
    return inertia.shift;
}

double constant_8(double) {
    return 8.0;
}

// A start at the largest torque for 20 ms, then the load alone.
double start(double t) {
    return t > 0.1 && t < 0.12 ? TORQUE_MAX : 8.0;
}

TEST(Inertia, a_start_under_load_identifies_a_fifth_to_five_times_to_the_nearest_powers_of_two) {
    for (const auto &[gain, shift] :
         {std::pair{0.2, 2}, {0.25, 2}, {0.5, 1}, {0.7, 0}, {1.0, 0}, {1.4, 0}, {2.0, -1}, {4.0, -2}, {5.0, -2}}) {
        for (const uint32_t rate_hz : {20000u, 40000u, 100000u, 1000000u}) {
            EXPECT_EQ(shift_after(settings(17, rate_hz), gain, start, constant_8), shift) << gain << ", " << rate_hz;
        }
        for (const unsigned bits : {14u, 20u, 32u}) {
            EXPECT_EQ(shift_after(settings(bits), gain, start, constant_8), shift) << gain << ", " << bits << " bits";
        }
    }
}

// One count of the angle as torque: J0 d2(angle) / window^2.
TEST(Inertia, beyond_a_quarter_and_four_times_the_shift_is_the_last_one_whatever_is_missing_to_the_next) {
    for (const bool fine : {false, true}) {
        for (const auto &[gain, shift] : {std::pair{0.12, 2}, {0.15, 2}, {6.0, -2}, {7.0, -2}, {7.6, -2}}) {
            EXPECT_EQ(shift_after(settings(), gain, start, constant_8, nullptr, 1.0, fine), shift) << gain << fine;
            inertia_t inertia{};
            const auto longer = [](double t) { return t > 0.1 && std::fmod(t, 0.02) < 0.01 ? TORQUE_MAX : 8.0; };
            EXPECT_EQ(shift_after(settings(), gain, longer, constant_8, &inertia, 1.0, fine), shift) << gain << fine;
            const double part = shift > 0 ? 0.25 / gain : 4.0 / gain; // of which the rest is at most half and twice
            if (fine) {
                EXPECT_NEAR(inertia.rest_q14 / 16384.0, std::clamp(part, 0.5, 2.0), 0.05) << gain;
            }
        }
    }
}

TEST(Inertia, a_window_is_as_short_as_0_8_ms_and_the_24th_of_the_largest_torque_that_a_count_is_at_most_allow) {
    int by_count = 0, by_time = 0;
    for (const unsigned bits : {10u, 14u, 17u}) {
        for (double inertia = 1e-3; inertia < 0.05; inertia *= 1.01) {
            inertia_settings_t of = settings(bits);
            of.inertia_q30 = to_fixed(inertia, Q30);
            const double update_s = double(of.periods_per_update) / of.control_rate_hz;
            const unsigned shift = inertia_configure(&of).window_shift;
            const auto window_s = [&](unsigned k) { return std::ldexp(update_s, int(k)); };
            const auto count_Nm = [&](unsigned k) {
                return inertia * 2.0 * PI / std::ldexp(1.0, int(bits)) / (window_s(k) * window_s(k));
            };
            EXPECT_GE(window_s(shift), 0.8e-3);
            EXPECT_LT(count_Nm(shift), TORQUE_MAX / 24.0 * 1.01) << bits << " bits, " << inertia;
            const bool shorter = window_s(shift - 1) >= 0.8e-3;
            EXPECT_TRUE(!shorter || count_Nm(shift - 1) > TORQUE_MAX / 24.0 * 0.99) << bits << " bits, " << inertia;
            by_count += shorter;
            by_time += !shorter;
        }
    }
    EXPECT_GT(by_count, 200);
    EXPECT_GT(by_time, 200);
}

TEST(Inertia, a_torque_that_follows_a_load_identifies_nothing) {
    const auto limited = [](double torque_Nm) { return std::min(torque_Nm, TORQUE_MAX); };
    const torque_t step = [](double t) { return t < 0.1 ? 0.0 : 15.0; };
    for (const double delay_s : {0.0005, 0.002, 0.005}) {
        // With an overshoot to the limit, as long as the delay.
        const torque_t after = [=](double t) {
            return step(t - delay_s) > 0.0 && t < 0.1 + 2.0 * delay_s ? TORQUE_MAX : step(t - delay_s);
        };
        EXPECT_EQ(shift_after(settings(), 1.0, after, step), 0) << delay_s;
    }
    for (const double frequency_hz : {1.0, 5.0, 20.0, 50.0, 100.0}) {
        const torque_t sine = [=](double t) { return limited(11.0 + 9.0 * std::sin(2.0 * PI * frequency_hz * t)); };
        const torque_t after = [=](double t) { return sine(t - 0.001); };
        EXPECT_EQ(shift_after(settings(), 1.0, after, sine), 0) << frequency_hz << " Hz";
    }
}

TEST(Inertia, a_torque_at_its_limit_identifies_nothing_after_the_speed_has_settled) {
    // The load of a ramp, as steep as a change of the inertia would look.
    const torque_t ramp = [](double t) { return std::clamp((t - 0.13) * 4000.0, 0.0, 16.0); };
    const torque_t answer = [&](double t) { return t < 0.12 ? start(t) - 8.0 : t > 0.131 ? TORQUE_MAX : 0.0; };
    EXPECT_LT(shift_after(settings(), 1.0, answer, ramp), 0);
    EXPECT_EQ(shift_after(settings(), 1.0, answer, ramp, nullptr, 0.125), 0);
    for (const double gain : {0.2, 5.0}) {
        EXPECT_EQ(shift_after(settings(), gain, start, constant_8, nullptr, 0.1), 0) << gain;
    }
}

TEST(Inertia, a_short_torque_identifies_nothing) {
    const torque_t none = [](double) { return 0.0; };
    for (const auto &[duration_s, shift] : std::map<double, int32_t>{{0.00015, 0}, {0.006, 2}}) {
        const torque_t pulse = [=](double t) { return t > 0.1 && t < 0.1 + duration_s ? TORQUE_MAX : 0.0; };
        EXPECT_EQ(shift_after(settings(), 0.2, pulse, none), shift) << duration_s;
    }
}

TEST(Inertia, torques_below_the_limit_identify_nothing) {
    for (const double gain : {0.2, 5.0}) {
        for (const double ratio : {0.99, 1.0}) {
            const torque_t scaled = [=](double t) { return ratio * start(t); };
            EXPECT_EQ(shift_after(settings(), gain, scaled, constant_8) != 0, ratio == 1.0) << gain << ", " << ratio;
        }
    }
}

TEST(Inertia, a_load_that_begins_with_the_rotation_is_no_other_inertia) {
    const torque_t run = [](double t) { return t > 0.001 ? TORQUE_MAX : 0.0; };
    for (const double length_s : {0.02, 0.1, 1.0}) {
        for (const double friction_Nm : {2.0, 8.0, 15.0}) {
            const torque_t friction = [=](double t) { return t > 0.001 ? friction_Nm : 0.0; };
            const torque_t ended = [=](double t) { return t < length_s ? run(t) : friction_Nm; };
            EXPECT_EQ(shift_after(settings(), 1.0, ended, friction), 0) << friction_Nm << ", " << length_s;
        }
    }
}

TEST(Inertia, the_end_of_a_start_identifies_an_inertia_under_a_load_that_began_with_the_rotation) {
    const torque_t friction = [](double t) { return t > 0.001 ? 8.0 : 0.0; };
    const torque_t run = [=](double t) { return t > 0.001 && t < 0.05 ? TORQUE_MAX : friction(t); };
    for (const auto &[gain, shift] :
         std::map<double, int32_t>{{0.2, 2}, {0.5, 1}, {0.7, 0}, {1.4, 0}, {2.0, -1}, {5.0, -2}}) {
        EXPECT_EQ(shift_after(settings(), gain, run, friction), shift) << gain;
    }
}

TEST(Inertia, what_pulls_for_a_millisecond_at_the_end_of_a_short_start_is_no_other_inertia) {
    // The regression begins again after 4 windows of 0.8 ms.
    for (const double end_s : {0.0026, 0.003, 0.0034}) {
        const torque_t run = [=](double t) { return t < end_s ? TORQUE_MAX : 0.0; };
        const torque_t load = [=](double t) { return t > end_s && t < end_s + 0.0012 ? -12.0 : 0.0; };
        EXPECT_EQ(shift_after(settings(), 1.0, run, load), 0) << end_s;
    }
}

TEST(Inertia, a_restart_keeps_the_shift_unless_the_parameters_have_another_inertia) {
    const inertia_settings_t of = settings();
    inertia_settings_t doubled = settings();
    doubled.inertia_q30 *= 2;
    const inertia_parameters_t parameters = inertia_configure(&of), others = inertia_configure(&doubled);
    inertia_t inertia{};
    inertia_restart(&parameters, &MODEL, &inertia, 0);
    inertia.shift = -2;
    inertia_restart(&parameters, &MODEL, &inertia, 5);
    EXPECT_EQ(inertia.shift, -2);
    inertia_restart(&others, &MODEL, &inertia, 5);
    EXPECT_EQ(inertia.shift, 0);
}

TEST(Inertia, a_run_identifies_the_same_whatever_turned_before) {
    const torque_t at_once = [](double t) { return t < 0.02 ? TORQUE_MAX : 8.0; };
    for (const double gain : {0.2, 0.7, 1.0, 1.4, 5.0}) {
        inertia_t before{};
        shift_after(
            settings(), 3.0, constant_8, [](double) { return 0.0; }, &before);
        ASSERT_EQ(before.shift, 0);
        EXPECT_EQ(shift_after(settings(), gain, at_once, constant_8, &before),
                  shift_after(settings(), gain, at_once, constant_8))
            << gain;
    }
}

TEST(Inertia, the_laws_follow_the_shift_and_saturate) {
    const inertia_settings_t of = settings();
    const inertia_parameters_t parameters = inertia_configure(&of);
    inertia_t inertia{};
    inertia_restart(&parameters, &MODEL, &inertia, 0);
    for (int32_t shift = -2; shift <= 2; shift++) {
        inertia.shift = shift;
        inertia_restart(&parameters, &MODEL, &inertia, 0);
        const double ratio = std::ldexp(1.0, shift); // J0 / J
        EXPECT_EQ(inertia.laws.observer.acceleration_q32, std::min(MODEL.acceleration_q32 * ratio, double(INT32_MAX)));
        EXPECT_EQ(inertia.laws.observer.load_shift, 2 + shift);
        EXPECT_EQ(inertia.laws.reaching_gain_q24, of.reaching_gain_q24 / ratio);
        EXPECT_EQ(inertia.laws.rate_q8, of.rate_q8 / ratio);
    }
    load_observer_model_t light = MODEL;
    light.acceleration_q32 = INT32_MAX / 3;
    inertia_parameters_t heavy = parameters;
    heavy.reaching_gain_q24 = heavy.rate_q8 = INT32_MAX / 3;
    inertia.shift = 2;
    inertia_restart(&heavy, &light, &inertia, 0);
    EXPECT_GT(inertia.laws.observer.acceleration_q32, INT32_MAX - 4);
    inertia.shift = -2;
    inertia_restart(&heavy, &light, &inertia, 0);
    EXPECT_GT(inertia.laws.reaching_gain_q24, INT32_MAX - 4);
    EXPECT_GT(inertia.laws.rate_q8, INT32_MAX - 4);
}

TEST(Inertia, a_shift_that_has_changed_in_memory_gives_laws_within_the_limits) {
    const inertia_settings_t of = settings();
    const inertia_parameters_t parameters = inertia_configure(&of);
    for (unsigned bit = 0; bit < 32; bit++) {
        inertia_t inertia{};
        inertia_restart(&parameters, &MODEL, &inertia, 0);
        for (unsigned step = 0; step < 8u << parameters.window_shift; step++) {
            if (step == 20) {
                inertia.shift = int32_t(UINT32_C(1) << bit);
            }
            inertia_step(&parameters, &inertia, 0, 0, true, true);
        }
        EXPECT_GE(inertia.laws.observer.load_shift, 0) << bit;
        EXPECT_LE(inertia.laws.observer.load_shift, 4) << bit;
        EXPECT_EQ(inertia.shift, bit < 2 ? 1 << bit : 0);
    }
}

TEST(Inertia, a_position_is_followed_with_the_inertia_within_three_percent) {
    const torque_t swing = [](double t) {
        return t < 0.1 ? 0.0 : t < 0.13 ? TORQUE_MAX : t < 0.16 ? -TORQUE_MAX : 0.0;
    };
    const torque_t none = [](double) { return 0.0; };
    for (const double gain : {0.2, 0.3, 0.5, 0.6, 0.8, 1.0, 1.3, 1.9, 3.0, 5.0}) {
        for (const torque_t &load : {none, torque_t(constant_8)}) {
            inertia_t inertia{};
            const torque_t torque = [&](double t) { return swing(t) + load(t); };
            shift_after(settings(), gain, torque, load, &inertia, 1.0, true);
            EXPECT_NEAR(std::ldexp(inertia.ratio_q14, -14), gain, 0.03 * gain);
            EXPECT_NEAR(inertia.laws.reaching_gain_q24,
                        std::ldexp(inertia.ratio_q14, -14) * to_fixed(REACHING_GAIN, Q24), 2000.0);
            EXPECT_NEAR(inertia.laws.rate_q8, std::ldexp(inertia.ratio_q14, -14) * RATE_Q8, 8.0);
            EXPECT_NEAR(inertia.laws.observer.acceleration_q32 * std::ldexp(inertia.ratio_q14, -14),
                        MODEL.acceleration_q32, 0.002 * MODEL.acceleration_q32);
        }
    }
}

// Forwards and backwards with a part of the largest torque, after each other.
torque_t way(double part, double duration_s) {
    return [=](double t) {
        const double since = t - 0.1;
        const double sign = since < 0.0 || since >= 2.0 * duration_s ? 0.0 : since < duration_s ? 1.0 : -1.0;
        return sign * part * TORQUE_MAX;
    };
}

double ratio_after(double gain, const torque_t &torque, inertia_t *inertia) {
    shift_after(
        settings(), gain, torque, [](double) { return 0.0; }, inertia, 1.0, true, true);
    return std::ldexp(inertia->ratio_q14, -14);
}

TEST(Inertia, a_first_move_with_a_twentieth_of_the_torque_shows_a_light_rotor_within_its_half) {
    for (const double duration_s : {0.002, 0.004, 0.006}) {
        for (const double part : {0.05, 0.06, 0.08}) {
            inertia_t inertia{};
            EXPECT_NEAR(ratio_after(0.3, way(part, duration_s), &inertia), 0.3, 0.15) << part << ", " << duration_s;
        }
        inertia_t inertia{};
        EXPECT_EQ(ratio_after(0.3, way(0.01, duration_s), &inertia), 1.0) << "too little for any rest";
        EXPECT_EQ(ratio_after(5.0, way(0.05, duration_s), &inertia), 1.0) << "of counts, more than of the torque";
    }
}

TEST(Inertia, a_coarse_encoder_shows_the_power_of_two_alone) {
    const torque_t slow = [](double t) { return t > 0.1 && t < 0.2 ? TORQUE_MAX : 0.0; };
    for (const auto &[bits, fine] : {std::pair{17u, true}, {14u, true}, {10u, false}, {9u, false}}) {
        inertia_t inertia{};
        shift_after(
            settings(bits), 0.3, slow, [](double) { return 0.0; }, &inertia, 1.0, true);
        EXPECT_EQ(inertia.rest_q14 != 1 << 14, fine) << bits;
        EXPECT_EQ(inertia.ratio_q14 == std::ldexp(1 << 14, -inertia.shift), !fine)
            << bits << ", " << inertia.ratio_q14 << ", " << inertia.shift;
    }
}

TEST(Inertia, a_run_begins_with_the_power_of_two_alone) {
    const inertia_settings_t of = settings();
    const inertia_parameters_t parameters = inertia_configure(&of);
    inertia_t inertia{}, coarse{};
    shift_after(of, 0.3, start, constant_8, &coarse);
    shift_after(of, 0.3, start, constant_8, &inertia, 1.0, true);
    EXPECT_NE(inertia.rest_q14, 1 << 14);
    EXPECT_NE(inertia.laws.reaching_gain_q24, coarse.laws.reaching_gain_q24);
    const int32_t gain_q24 = inertia.laws.reaching_gain_q24;
    inertia_tune(&parameters, &MODEL, &inertia);
    inertia_tune_laws(&inertia);
    EXPECT_EQ(inertia.laws.reaching_gain_q24, gain_q24) << "parameters that are tuned in a run leave the inertia";
    inertia_restart(&parameters, &MODEL, &inertia, 0);
    EXPECT_EQ(inertia.laws.reaching_gain_q24, coarse.laws.reaching_gain_q24);
    EXPECT_EQ(inertia.laws.observer.acceleration_q32, coarse.laws.observer.acceleration_q32);
    EXPECT_EQ(inertia.ratio_q14, (1 << 14) >> coarse.shift);
}

TEST(Inertia, a_rest_that_has_changed_in_memory_gives_laws_within_the_limits) {
    const inertia_settings_t of = settings();
    const inertia_parameters_t parameters = inertia_configure(&of);
    for (unsigned bit = 0; bit < 64; bit++) {
        inertia_t inertia{};
        inertia_restart(&parameters, &MODEL, &inertia, 0);
        for (unsigned step = 0; step < 8u << parameters.window_shift; step++) {
            if (step == 40) {
                (bit < 32 ? inertia.rest_q14 : inertia.inverse_rest_q14) ^= int32_t(UINT32_C(1) << bit % 32);
            }
            inertia_step(&parameters, &inertia, 0, 0, true, true);
            inertia_refine(&parameters, &MODEL, &inertia);
            EXPECT_GE(inertia.ratio_q14, 1 << 13) << bit;
            EXPECT_LE(inertia.ratio_q14, 1 << 15) << bit;
        }
    }
}

TEST(Inertia, an_identified_shift_changes_the_laws_within_the_run) {
    // shift_after() restarts before the run only.
    inertia_t inertia{};
    EXPECT_EQ(shift_after(settings(), 0.2, start, constant_8, &inertia), 2);
    EXPECT_EQ(inertia.laws.observer.load_shift, 4);
}

} // namespace
