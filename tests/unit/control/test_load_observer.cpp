// The load observer: gains against their formulas, estimates against its reference model.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/load_observer.h"
}

#include "support/reference_builders.h"
#include "support/wide_integer.h"

namespace {

using namespace fixed_point;
constexpr double INERTIA_KG_M2 = 0.02;
constexpr double FRICTION_NM_S = 0.02;
constexpr double RATE_HZ = 40000.0;

struct observer_parameters_t {
    load_observer_gains_t gains;
    load_observer_model_t model;
    load_observer_inertia_t inertia;
};

observer_parameters_t configure(double bandwidth_rad_s, double rate_hz = RATE_HZ, double inertia = INERTIA_KG_M2,
                                double friction = FRICTION_NM_S) {
    const int32_t inertia_q30 = to_fixed(inertia, Q30);
    const load_observer_model_t model = load_observer_model(uint32_t(rate_hz), inertia_q30, to_fixed(friction, Q30));
    return {load_observer_gains(uint32_t(bandwidth_rad_s), uint32_t(rate_hz), inertia_q30), model,
            load_observer_inertia(&model, 0)};
}

int32_t observe(const observer_parameters_t &p, load_observer_t *observer, uint32_t angle, int32_t torque_q24) {
    const int32_t innovation = load_observer_innovation(observer, angle);
    load_observer_step(&p.model, &p.gains, &p.inertia, observer, innovation, torque_q24);
    return innovation;
}

reference_model::observer_t model_of(const observer_parameters_t &p) {
    return reference_model::model_of(p.gains, p.model);
}

double rev_of(const load_observer_t &observer) {
    return double(observer.angle_q64) / REV / REV;
}

// A rotor under torque and load, integrated exactly enough; an encoder with `bits`.
struct rotor_t {
    double rev = 0.0, speed = 0.0;

    void step(double torque, double load, double rate_hz = RATE_HZ) {
        const double before = speed;
        speed += (torque - FRICTION_NM_S * speed - load) / INERTIA_KG_M2 / rate_hz;
        rev += 0.5 * (before + speed) / (2.0 * PI * rate_hz);
    }

    uint32_t encoder(unsigned bits) const {
        const uint32_t lsb = bits < 32 ? 1u << (32 - bits) : 1u;
        return (angle_from_rev(rev) & ~(lsb - 1)) + lsb / 2;
    }
};

TEST(LoadObserver, gains_are_within_0_1_percent_and_1_lsb_over_the_whole_range) {
    const auto expect_gain = [](double gain, double exact, const char *name) {
        ASSERT_LE(std::fabs(gain - exact), 1e-3 * exact + 1.0) << name;
    };
    for (const double rate_hz : {20000.0, 40000.0, 50000.0, 100000.0}) {
        for (double bandwidth = 100.0; bandwidth <= 8000.0; bandwidth = std::floor(bandwidth * 1.05) + 1.0) {
            for (const double inertia : {1e-4, 3e-4, 1e-3, 5e-3, 0.02, 0.1, 0.5, 1.9, 1.9999}) {
                const observer_parameters_t p = configure(bandwidth, rate_hz, inertia);
                const reference_model::observer_t ideal =
                    reference_model::observer_t::ideal(bandwidth, rate_hz, to_fixed(inertia, Q30) / Q30, FRICTION_NM_S);
                SCOPED_TRACE(testing::Message()
                             << bandwidth << " rad/s, " << rate_hz << " Hz, " << inertia << " kg m^2");
                ASSERT_NO_FATAL_FAILURE(expect_gain(p.gains.angle_gain_q28, std::ldexp(ideal.angle_gain, 28), "angle"));
                ASSERT_NO_FATAL_FAILURE(
                    expect_gain(p.gains.speed_gain_q24, ideal.speed_gain * Q22 / REV * Q24, "speed"));
                ASSERT_NO_FATAL_FAILURE(expect_gain(std::ldexp(reference_model::load_gain(p.gains), 28),
                                                    std::ldexp(ideal.torque_gain * Q24 / REV, 28), "torque"));
                ASSERT_NO_FATAL_FAILURE(
                    expect_gain(p.model.acceleration_q32, ideal.acceleration * Q22 / Q24 * Q32, "acceleration"));
                ASSERT_NO_FATAL_FAILURE(
                    expect_gain(p.model.angle_step_q32, ideal.angle_step * REV / Q22 * Q32, "angle step"));
                ASSERT_EQ(p.model.friction_q30, to_fixed(FRICTION_NM_S, Q30));
                ASSERT_LE(p.gains.load_factor_q4, 16 << 20);
            }
        }
    }
}

TEST(LoadObserver, gains_at_a_megahertz_are_within_0_1_percent_and_the_load_gain_within_2_percent) {
    for (double bandwidth = 100.0; bandwidth <= 10000.0; bandwidth = std::floor(bandwidth * 1.05) + 1.0) {
        for (const double inertia : {1e-4, 5e-3, 0.02, 0.5, 1.9}) {
            const observer_parameters_t p = configure(bandwidth, 1e6, inertia);
            const reference_model::observer_t ideal =
                reference_model::observer_t::ideal(bandwidth, 1e6, to_fixed(inertia, Q30) / Q30, FRICTION_NM_S);
            SCOPED_TRACE(testing::Message() << bandwidth << " rad/s, " << inertia << " kg m^2");
            const auto expect = [](double gain, double exact, double share) {
                ASSERT_LE(std::fabs(gain - exact), share * exact + 1.0);
            };
            ASSERT_NO_FATAL_FAILURE(expect(p.gains.angle_gain_q28, std::ldexp(ideal.angle_gain, 28), 1e-3));
            ASSERT_NO_FATAL_FAILURE(expect(p.gains.speed_gain_q24, ideal.speed_gain * Q22 / REV * Q24, 1e-3));
            ASSERT_NO_FATAL_FAILURE(expect(std::ldexp(reference_model::load_gain(p.gains), 28),
                                           std::ldexp(ideal.torque_gain * Q24 / REV, 28),
                                           bandwidth >= 1000.0 ? 1e-3 : 0.02));
            ASSERT_NO_FATAL_FAILURE(expect(p.model.angle_step_q32, ideal.angle_step * REV / Q22 * Q32, 1e-3));
        }
    }
}

// Under a constant load, without friction. Between samples the model predicts.
// As of constants that have changed in memory; each factor is normalised, and 0 cannot be. [SR-51]
TEST(LoadObserver, without_an_inertia_or_a_bandwidth_nothing_is_corrected_and_the_gains_come_back) {
    for (const uint32_t rate_hz : {20000u, 40000u, 1000000u}) {
        const load_observer_gains_t weightless = load_observer_gains(1000, rate_hz, 0);
        EXPECT_EQ(weightless.load_gain_q28, 0) << rate_hz;
        EXPECT_GT(weightless.speed_gain_q24, 0) << rate_hz;
        const load_observer_gains_t open = load_observer_gains(0, rate_hz, 1 << 22);
        EXPECT_EQ(open.angle_gain_q28, 0) << rate_hz;
        EXPECT_EQ(open.speed_gain_q24, 0) << rate_hz;
        EXPECT_EQ(open.load_gain_q28, 0) << rate_hz;
    }
}

TEST(LoadObserver, with_deadbeat_gains_three_samples_determine_angle_speed_and_load) {
    constexpr double TORQUE_NM = 0.1, LOAD_NM = -0.2, FIRST_RAD_S = 1.5;
    const observer_parameters_t p = configure(250.0, RATE_HZ, INERTIA_KG_M2, 0.0);
    const double acceleration = (TORQUE_NM - LOAD_NM) / INERTIA_KG_M2;
    for (const unsigned rate_hz : {100u, 250u, 1000u}) {
        const load_observer_gains_t gains = load_observer_deadbeat_gains(rate_hz, to_fixed(INERTIA_KG_M2, Q30));
        const int apart = int(RATE_HZ) / int(rate_hz);
        const auto rev = [&](int k) {
            const double t = k / RATE_HZ;
            return 0.2 + (FIRST_RAD_S * t + 0.5 * acceleration * t * t) / (2.0 * PI);
        };
        load_observer_t observer;
        load_observer_reset(&observer, angle_from_rev(rev(0)));
        for (int k = 0; k <= 3 * apart; k++) {
            const load_observer_gains_t none{};
            const int32_t innovation = k % apart == 0 ? load_observer_innovation(&observer, angle_from_rev(rev(k))) : 0;
            load_observer_step(&p.model, k % apart == 0 ? &gains : &none, &p.inertia, &observer, innovation,
                               to_fixed(TORQUE_NM, Q24));
        }
        const double after_s = (3 * apart + 1) / RATE_HZ;
        EXPECT_NEAR(rev_of(observer), rev(3 * apart + 1), 1e-7) << rate_hz;
        EXPECT_NEAR(observer.speed_q22 / Q22, FIRST_RAD_S + acceleration * after_s, 1e-3) << rate_hz;
        EXPECT_NEAR(observer.load_torque_q24 / Q24, LOAD_NM, 1e-3) << rate_hz;
    }
}

TEST(LoadObserver, follows_its_reference_model_at_a_megahertz_with_an_ideal_encoder) {
    for (const double bandwidth : {250.0, 9000.0}) {
        const observer_parameters_t parameters = configure(bandwidth, 1e6);
        reference_model::observer_t model = model_of(parameters);
        rotor_t rotor{0.2, 15.0};
        load_observer_t observer;
        load_observer_reset(&observer, rotor.encoder(32));
        model.angle = rotor.encoder(32) / REV;
        double speed = 0.0, load_Nm = 0.0;
        for (int k = 0; k < 200000; k++) {
            const double torque = 4.0 + 3.0 * std::sin(k * 4e-4), load = k < 100000 ? 0.0 : 8.0;
            const int32_t torque_q24 = to_fixed(torque, Q24);
            const uint32_t measured = rotor.encoder(32);
            observe(parameters, &observer, measured, torque_q24);
            model.step(measured / REV, torque_q24 / Q24);
            speed = std::max(speed, std::fabs(observer.speed_q22 / Q22 - model.speed));
            load_Nm = std::max(load_Nm, std::fabs(observer.load_torque_q24 / Q24 - model.load_torque));
            rotor.step(torque, load, 1e6);
        }
        EXPECT_LT(speed, 1e-3) << "rad/s, at " << bandwidth;
        EXPECT_GT(speed, 0.1 / Q22);
        EXPECT_LT(load_Nm, 3e-3) << "N m, at " << bandwidth;
    }
}

TEST(LoadObserver, reports_the_innovation_before_the_step_and_the_speed_correction_after_it) {
    const observer_parameters_t parameters = configure(1000.0);
    for (const int32_t innovation : {1, -1, 1000, -32768, 1 << 27, -(1 << 27), (1 << 27) + 1000, INT32_MIN + 1}) {
        load_observer_t observer;
        load_observer_reset(&observer, 0x12345678u);
        const uint32_t measured = 0x12345678u + uint32_t(innovation);
        const double clamped = std::clamp(double(innovation), -134217728.0, 134217727.0);
        EXPECT_EQ(load_observer_innovation(&observer, measured), clamped);
        EXPECT_EQ(observe(parameters, &observer, measured, 0), clamped);
        EXPECT_NEAR(observer.speed_correction_q22, clamped * parameters.gains.speed_gain_q24 / Q24, 1.01);
        reference_model::observer_t model = model_of(parameters);
        model.step(clamped / REV, 0.0);
        EXPECT_NEAR(observer.speed_correction_q22 / Q22, model.speed_correction, 1.0 / Q22);
    }
}

// Every term with its rounding, for any gains and estimates. A speed correction that saturates is within 16 LSB of the
// end, which makes the rest of that sample uncertain.
TEST(LoadObserver, a_step_rounds_its_terms_as_stated_and_its_sums_saturate) {
    using namespace wide_integer;
    std::mt19937 random(7);
    int compared = 0, limited = 0;
    for (int i = 0; i < 300000; i++) {
        load_observer_gains_t gains{};
        gains.angle_gain_q28 = any_up_to(random, 1 << 28);
        gains.speed_gain_q24 = any_up_to(random, INT32_MAX);
        gains.load_gain_q28 = -any_up_to(random, INT32_MAX);
        gains.load_factor_q4 = 16 << random() % 21;
        const load_observer_model_t model = {0, any_up_to(random, INT32_MAX), any_up_to(random, INT32_MAX)};
        const load_observer_inertia_t inertia = {any_up_to(random, INT32_MAX), int32_t(random() % 5)};
        load_observer_t observer{};
        observer.angle_q64 = uint64_t(random()) << 32 | random();
        observer.speed_q22 = any(random);
        observer.load_torque_q24 = any(random) / 2;
        const load_observer_t before = observer;
        const int32_t innovation = any(random) >> 4, torque_q24 = any(random);
        load_observer_step(&model, &gains, &inertia, &observer, innovation, torque_q24);

        const wide_t innovation_q4 = wide_t(innovation) * 16;
        const wide_t correction_q22 = rounded_down(innovation_q4 * gains.speed_gain_q24, power_of_2(28));
        const wide_t speed_q22 = saturated(before.speed_q22 + correction_q22);
        const wide_t factor_q4 = wide_t(gains.load_factor_q4) * 4 >> inertia.load_shift;
        const wide_t load_steps = nearest(innovation_q4 * gains.load_gain_q28, power_of_2(32));
        const wide_t load_change_q24 = rounded_down(load_steps * factor_q4, power_of_2(4));
        const wide_t load_q24 = before.load_torque_q24 + load_change_q24;
        const wide_t friction_q24 = rounded_down(speed_q22 * model.friction_q30, power_of_2(28));
        ASSERT_LE(std::llabs(int64_t(observer.speed_correction_q22) - saturated(correction_q22)),
                  fits(correction_q22) ? 0 : 15);
        if (!fits(correction_q22) || !fits(friction_q24) || !fits(load_change_q24)) {
            continue;
        }
        const wide_t limited_q24 = std::clamp(load_q24, -power_of_2(30), power_of_2(30) - 1);
        const wide_t net_q24 = saturated(saturated(torque_q24 - friction_q24) - limited_q24);
        const wide_t change_q22 = nearest(net_q24 * inertia.acceleration_q32, power_of_2(32));
        const wide_t mean_q22 = saturated(speed_q22 + rounded_down(change_q22, 2));
        const wide_t turn_q64 = innovation_q4 * gains.angle_gain_q28 + mean_q22 * model.angle_step_q32;
        ASSERT_EQ(observer.speed_correction_q22, int32_t(correction_q22)) << i;
        ASSERT_EQ(observer.load_torque_q24, int32_t(limited_q24)) << i;
        ASSERT_EQ(observer.speed_q22, saturated(speed_q22 + change_q22)) << i;
        ASSERT_EQ(observer.angle_q64, before.angle_q64 + uint64_t(turn_q64)) << i;
        compared++;
        limited += load_q24 != limited_q24;
    }
    EXPECT_GT(compared, 50000);
    EXPECT_GT(limited, 1000);
    EXPECT_GT(compared, 2 * limited);
}

TEST(LoadObserver, acceleration_is_that_of_the_torque_on_the_inertia_rounded_towards_zero) {
    std::mt19937 random(8);
    for (int i = 0; i < 100000; i++) {
        const int32_t torque_q24 = wide_integer::any(random);
        const int32_t inertia_q30 = 1 + wide_integer::any_up_to(random, INT32_MAX - 1);
        ASSERT_EQ(load_observer_acceleration(torque_q24, inertia_q30), int64_t(torque_q24) * 64 / inertia_q30);
    }
    EXPECT_EQ(load_observer_acceleration(40 << 24, to_fixed(1e-4, Q30)), 400000); // 400000.7
    EXPECT_EQ(load_observer_acceleration(-1, 65), 0);
}

// Estimate of the observer and motion of its model, for the same encoder readings and torques.
struct differences_t {
    double speed_rad_s = 0.0, load_Nm = 0.0, angle_rad = 0.0;
};

differences_t largest_differences(double bandwidth, unsigned encoder_bits, double start_rev, double start_speed,
                                  double direction) {
    const observer_parameters_t parameters = configure(bandwidth);
    reference_model::observer_t model = model_of(parameters);
    rotor_t rotor{start_rev, start_speed};
    load_observer_t observer;
    load_observer_reset(&observer, rotor.encoder(encoder_bits));
    model.angle = rotor.encoder(encoder_bits) / REV;
    differences_t largest;
    for (int k = 0; k < 20000; k++) {
        const double load = direction * (k < 8000 ? 0.0 : 8.0);
        const double torque =
            direction * (4.0 + 3.0 * std::sin(k * 0.01) + std::max(0.0, 0.2 * (40.0 - std::fabs(rotor.speed))));
        const int32_t torque_q24 = to_fixed(torque, Q24);
        const uint32_t measured = rotor.encoder(encoder_bits);
        observe(parameters, &observer, measured, torque_q24);
        model.step(measured / REV, torque_q24 / Q24);
        double angle = rev_of(observer) - model.angle;
        angle -= std::round(angle);
        largest.angle_rad = std::max(largest.angle_rad, std::fabs(angle) * 2.0 * PI);
        largest.speed_rad_s = std::max(largest.speed_rad_s, std::fabs(observer.speed_q22 / Q22 - model.speed));
        largest.load_Nm = std::max(largest.load_Nm, std::fabs(observer.load_torque_q24 / Q24 - model.load_torque));
        rotor.step(torque, load);
    }
    return largest;
}

TEST(LoadObserver, follows_its_reference_model_through_half_a_second_with_a_load_step) {
    for (const double direction : {1.0, -1.0}) {
        for (const double bandwidth : {300.0, 1000.0, 4000.0}) {
            for (const unsigned bits : {12u, 17u, 32u}) {
                SCOPED_TRACE(testing::Message() << direction << ", " << bandwidth << " rad/s, " << bits << " bits");
                // From 0.99 rev, across the wrap.
                const differences_t largest = largest_differences(bandwidth, bits, 0.99, direction * 15.0, direction);
                EXPECT_LT(largest.speed_rad_s, 2.5e-5);
                EXPECT_LT(largest.load_Nm, 2.5e-4);
                EXPECT_LT(largest.angle_rad, 2.5e-8);
                // The arithmetic does differ.
                EXPECT_GT(largest.speed_rad_s, 1.0 / Q22);
            }
        }
    }
}

TEST(LoadObserver, with_an_identified_inertia_is_the_observer_configured_for_it) {
    for (int32_t k = -2; k <= 2; k++) {
        const double inertia = std::ldexp(INERTIA_KG_M2, -k);
        const observer_parameters_t configured = configure(1000.0, RATE_HZ, inertia);
        observer_parameters_t identified = configure(1000.0);
        identified.inertia = load_observer_inertia(&identified.model, k);
        rotor_t rotor{0.3, 15.7};
        load_observer_t one, other;
        load_observer_reset(&one, rotor.encoder(20));
        load_observer_reset(&other, rotor.encoder(20));
        double load_Nm = 0.0;
        for (int n = 0; n < 2000; n++) {
            const double torque = n < 1000 ? 8.0 : 12.0;
            observe(configured, &one, rotor.encoder(20), to_fixed(torque, Q24));
            observe(identified, &other, rotor.encoder(20), to_fixed(torque, Q24));
            EXPECT_NEAR(one.load_torque_q24 / Q24, other.load_torque_q24 / Q24, 0.001) << k;
            EXPECT_NEAR(one.speed_q22 / Q22, other.speed_q22 / Q22, 0.001) << k;
            load_Nm = std::max(load_Nm, std::fabs(one.load_torque_q24 / Q24));
            rotor.step(torque, 8.0);
        }
        EXPECT_GT(load_Nm, 1.0) << "the load moved";
    }
}

TEST(LoadObserver, finds_the_load_torque_and_the_speed) {
    for (const double direction : {1.0, -1.0}) {
        const observer_parameters_t parameters = configure(1000.0);
        rotor_t rotor{0.3, direction * 15.7};
        load_observer_t observer;
        load_observer_reset(&observer, rotor.encoder(32));
        double torque = 0.0;
        for (int k = 0; k < 4000; k++) {
            torque = direction * 8.0 + FRICTION_NM_S * rotor.speed;
            observe(parameters, &observer, rotor.encoder(32), to_fixed(torque, Q24));
            rotor.step(torque, direction * 8.0);
        }
        EXPECT_NEAR(observer.load_torque_q24 / Q24, direction * 8.0, 1e-2);
        EXPECT_NEAR(observer.speed_q22 / Q22, rotor.speed, 1e-3);
    }
}

TEST(LoadObserver, responds_to_a_load_step_as_three_equal_poles) {
    // Three poles at 1000 rad/s: 1 - e^-x (1 + x + x^2/2) of a step after x / 1000 s.
    const observer_parameters_t parameters = configure(1000.0);
    rotor_t rotor{0.0, 100.0};
    load_observer_t observer;
    load_observer_reset(&observer, rotor.encoder(32));
    const auto run = [&](int samples, double load) {
        for (int k = 0; k < samples; k++) {
            const double torque = FRICTION_NM_S * rotor.speed;
            observe(parameters, &observer, rotor.encoder(32), to_fixed(torque, Q24));
            rotor.step(torque, load);
        }
    };
    run(2000, 0.0);
    EXPECT_NEAR(observer.load_torque_q24 / Q24, 0.0, 1e-2);
    for (int ms = 1; ms <= 8; ms++) {
        run(40, 8.0);
        const double x = ms;
        const double expected = 8.0 * (1.0 - std::exp(-x) * (1.0 + x + 0.5 * x * x));
        EXPECT_NEAR(observer.load_torque_q24 / Q24, expected, 0.1) << ms << " ms";
    }
}

TEST(LoadObserver, converges_to_a_spinning_rotor_from_rest) {
    for (const double rate_hz : {20000.0, 40000.0, 100000.0}) {
        for (const double bandwidth : {100.0, 300.0, 1000.0, 4000.0, 8000.0}) {
            for (const double speed : {-300.0, -30.0, 15.0, 100.0, 300.0, 400.0}) {
                const observer_parameters_t parameters = configure(bandwidth, rate_hz);
                rotor_t rotor{0.7, speed};
                load_observer_t observer;
                load_observer_reset(&observer, rotor.encoder(32));
                double fastest = 0.0, converged_s = 0.0;
                for (int k = 0; k < int(20.0 / bandwidth * rate_hz); k++) {
                    const double torque = FRICTION_NM_S * speed;
                    observe(parameters, &observer, rotor.encoder(32), to_fixed(torque, Q24));
                    rotor.step(torque, 0.0, rate_hz);
                    const double estimate = observer.speed_q22 / Q22;
                    fastest = std::max(fastest, std::fabs(estimate));
                    if (std::fabs(estimate - speed) > 0.01 * std::fabs(speed)) {
                        converged_s = (k + 1) / rate_hz;
                    }
                }
                SCOPED_TRACE(testing::Message() << rate_hz << " Hz, " << bandwidth << " rad/s at " << speed);
                EXPECT_LT(converged_s, (std::fabs(speed) > 2.0 * bandwidth ? 20.0 : 10.0) / bandwidth);
                // No overspeed by the transient, except with the slowest observers.
                if (std::fabs(speed) <= 0.3 * bandwidth || bandwidth >= 1000.0) {
                    EXPECT_LT(fastest, 1.26 * std::fabs(speed));
                }
            }
        }
    }
}

TEST(LoadObserver, the_angle_wraps_without_a_step_in_both_directions) {
    for (const double direction : {1.0, -1.0}) {
        const observer_parameters_t parameters = configure(1000.0);
        rotor_t rotor{0.0, direction * 300.0};
        load_observer_t observer;
        load_observer_reset(&observer, rotor.encoder(32));
        int32_t largest = 0;
        for (int k = 0; k < 20000; k++) { // some 24 rev
            const double torque = FRICTION_NM_S * rotor.speed;
            const int32_t innovation = observe(parameters, &observer, rotor.encoder(32), to_fixed(torque, Q24));
            if (k > 4000) {
                largest = std::max(largest, std::abs(innovation));
            }
            rotor.step(torque, 0.0);
        }
        EXPECT_LE(largest, 16) << "2^-32 rev";
    }
}

TEST(LoadObserver, a_jump_of_the_encoder_is_limited_and_decays) {
    const observer_parameters_t parameters = configure(1000.0);
    load_observer_t observer;
    load_observer_reset(&observer, 0);
    // Modulo a revolution.
    EXPECT_EQ(observe(parameters, &observer, 0x40000000u, 0), (1 << 27) - 1);
    load_observer_reset(&observer, 0x10u);
    EXPECT_EQ(observe(parameters, &observer, 0xFFFFFFF0u, 0), -0x20);
    load_observer_reset(&observer, 0);
    EXPECT_EQ(observe(parameters, &observer, 0x80000000u, 0), -(1 << 27));
    // It corrects like 1/32 rev, and the estimate recovers.
    load_observer_t other;
    load_observer_reset(&observer, 0);
    load_observer_reset(&other, 0);
    observe(parameters, &observer, 0x40000000u, 0);
    observe(parameters, &other, 1u << 27, 0);
    EXPECT_EQ(observer.angle_q64, other.angle_q64);
    EXPECT_EQ(observer.speed_q22, other.speed_q22);
    EXPECT_EQ(observer.load_torque_q24, other.load_torque_q24);
    for (int k = 0; k < 8000; k++) {
        observe(parameters, &observer, 0, 0);
    }
    EXPECT_NEAR(observer.speed_q22 / Q22, 0.0, 1e-3);
    EXPECT_NEAR(observer.load_torque_q24 / Q24, 0.0, 1e-2);
}

TEST(LoadObserver, every_estimate_saturates_and_nothing_overflows) {
    std::mt19937 random(1);
    for (const double rate_hz : {20000.0, 100000.0}) {
        for (const double bandwidth : {100.0, 8000.0}) {
            for (const double inertia : {1e-4, 1.9}) {
                const observer_parameters_t parameters = configure(bandwidth, rate_hz, inertia, 1.9);
                for (const int32_t torque_q24 : {INT32_MIN, INT32_MAX, 0}) {
                    load_observer_t observer;
                    load_observer_reset(&observer, 0);
                    for (int k = 0; k < 3000; k++) {
                        const uint32_t angle = k < 1000   ? observer.angle_q64 / (uint64_t(1) << 32) + (1u << 30)
                                               : k < 2000 ? observer.angle_q64 / (uint64_t(1) << 32) - (1u << 30)
                                                          : uint32_t(random());
                        observe(parameters, &observer, angle, torque_q24);
                        ASSERT_LE(std::abs(observer.load_torque_q24), 64 << 24);
                    }
                }
            }
        }
    }
    // Pushed forward indefinitely: the speed saturates at the end of Q9.22, the load torque at -64 N m.
    const observer_parameters_t parameters = configure(1000.0);
    load_observer_t observer;
    load_observer_reset(&observer, 0);
    for (int k = 0; k < 20000; k++) {
        observe(parameters, &observer, uint32_t(observer.angle_q64 >> 32) + (1u << 29), 0);
    }
    EXPECT_EQ(observer.speed_q22, INT32_MAX);
    EXPECT_EQ(observer.load_torque_q24, -(64 << 24));
}

} // namespace
