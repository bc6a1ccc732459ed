// The load observer: gains against their formulas, estimates against the double-precision twin.
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/load_observer.h"
}

#include "support/reference_models.h"

namespace {

constexpr double INERTIA_KG_M2 = 0.02;
constexpr double FRICTION_NM_S = 0.02;
constexpr double RATE_HZ = 40000.0;

struct observer_parameters_t {
    load_observer_gains_t gains;
    load_observer_model_t model;
};

observer_parameters_t configure(double bandwidth_rad_s, double rate_hz = RATE_HZ, double inertia = INERTIA_KG_M2,
                                double friction = FRICTION_NM_S) {
    const int32_t inertia_q30 = twins::to_fixed(inertia, twins::Q30);
    return {load_observer_gains(uint32_t(bandwidth_rad_s), uint32_t(rate_hz), inertia_q30),
            load_observer_model(uint32_t(rate_hz), inertia_q30, twins::to_fixed(friction, twins::Q30))};
}

int32_t observe(const observer_parameters_t &p, load_observer_t *observer, uint32_t angle, int32_t torque_q24) {
    const int32_t innovation = load_observer_innovation(observer, angle);
    load_observer_step(&p.model, &p.gains, observer, innovation, torque_q24);
    return innovation;
}

// J l3, N m Q7.24 per 2^-32 turn.
double load_gain(const observer_parameters_t &p) {
    return -p.gains.load_gain_q28 / std::ldexp(1.0, 28) * p.gains.load_factor_q4 / 16.0;
}

// The twin of what the parameters hold after rounding.
twins::observer_t twin_of(const observer_parameters_t &p) {
    twins::observer_t twin{};
    twin.angle_gain = p.gains.angle_gain_q28 / std::ldexp(1.0, 28);
    twin.speed_gain = p.gains.speed_gain_q24 / twins::Q24 * twins::TURN / twins::Q22;
    twin.torque_gain = load_gain(p) * twins::TURN / twins::Q24;
    twin.acceleration = p.model.acceleration_q32 / twins::Q32 * twins::Q24 / twins::Q22;
    twin.friction = p.model.friction_q30 / twins::Q30;
    twin.angle_step = p.model.angle_step_q32 / twins::Q32 * twins::Q22 / twins::TURN;
    return twin;
}

uint32_t angle_of(double turns) {
    return uint32_t(int64_t(std::floor((turns - std::floor(turns)) * twins::TURN)));
}

double turns_of(const load_observer_t &observer) {
    return double(observer.angle_q64) / twins::TURN / twins::TURN;
}

// A rotor under torque and load, integrated exactly enough; an encoder with `bits`.
struct rotor_t {
    double turns = 0.0, speed = 0.0;

    void step(double torque, double load, double rate_hz = RATE_HZ) {
        const double before = speed;
        speed += (torque - FRICTION_NM_S * speed - load) / INERTIA_KG_M2 / rate_hz;
        turns += 0.5 * (before + speed) / (2.0 * twins::PI * rate_hz);
    }

    uint32_t encoder(unsigned bits) const {
        const uint32_t lsb = bits < 32 ? 1u << (32 - bits) : 1u;
        return (angle_of(turns) & ~(lsb - 1)) + lsb / 2;
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
                const twins::observer_t ideal = twins::observer_t::ideal(
                    bandwidth, rate_hz, twins::to_fixed(inertia, twins::Q30) / twins::Q30, FRICTION_NM_S);
                SCOPED_TRACE(testing::Message()
                             << bandwidth << " rad/s, " << rate_hz << " Hz, " << inertia << " kg m^2");
                ASSERT_NO_FATAL_FAILURE(expect_gain(p.gains.angle_gain_q28, std::ldexp(ideal.angle_gain, 28), "angle"));
                ASSERT_NO_FATAL_FAILURE(expect_gain(p.gains.speed_gain_q24,
                                                    ideal.speed_gain * twins::Q22 / twins::TURN * twins::Q24, "speed"));
                ASSERT_NO_FATAL_FAILURE(expect_gain(std::ldexp(load_gain(p), 28),
                                                    std::ldexp(ideal.torque_gain * twins::Q24 / twins::TURN, 28),
                                                    "torque"));
                ASSERT_NO_FATAL_FAILURE(expect_gain(p.model.acceleration_q32,
                                                    ideal.acceleration * twins::Q22 / twins::Q24 * twins::Q32,
                                                    "acceleration"));
                ASSERT_NO_FATAL_FAILURE(expect_gain(
                    p.model.angle_step_q32, ideal.angle_step * twins::TURN / twins::Q22 * twins::Q32, "angle step"));
                ASSERT_EQ(p.model.friction_q30, twins::to_fixed(FRICTION_NM_S, twins::Q30));
                ASSERT_LE(p.gains.load_factor_q4, 16 << 20);
            }
        }
    }
}

TEST(LoadObserver, gains_at_a_megahertz_are_within_0_1_percent_and_the_torque_s_within_2_percent) {
    for (double bandwidth = 100.0; bandwidth <= 10000.0; bandwidth = std::floor(bandwidth * 1.05) + 1.0) {
        for (const double inertia : {1e-4, 5e-3, 0.02, 0.5, 1.9}) {
            const observer_parameters_t p = configure(bandwidth, 1e6, inertia);
            const twins::observer_t ideal = twins::observer_t::ideal(
                bandwidth, 1e6, twins::to_fixed(inertia, twins::Q30) / twins::Q30, FRICTION_NM_S);
            SCOPED_TRACE(testing::Message() << bandwidth << " rad/s, " << inertia << " kg m^2");
            const auto expect = [](double gain, double exact, double share) {
                ASSERT_LE(std::fabs(gain - exact), share * exact + 1.0);
            };
            ASSERT_NO_FATAL_FAILURE(expect(p.gains.angle_gain_q28, std::ldexp(ideal.angle_gain, 28), 1e-3));
            ASSERT_NO_FATAL_FAILURE(
                expect(p.gains.speed_gain_q24, ideal.speed_gain * twins::Q22 / twins::TURN * twins::Q24, 1e-3));
            ASSERT_NO_FATAL_FAILURE(expect(std::ldexp(load_gain(p), 28),
                                           std::ldexp(ideal.torque_gain * twins::Q24 / twins::TURN, 28),
                                           bandwidth >= 1000.0 ? 1e-3 : 0.02));
            ASSERT_NO_FATAL_FAILURE(
                expect(p.model.angle_step_q32, ideal.angle_step * twins::TURN / twins::Q22 * twins::Q32, 1e-3));
        }
    }
}

TEST(LoadObserver, follows_its_twin_at_a_megahertz_with_an_ideal_encoder) {
    for (const double bandwidth : {250.0, 9000.0}) {
        const observer_parameters_t parameters = configure(bandwidth, 1e6);
        twins::observer_t twin = twin_of(parameters);
        rotor_t rotor{0.2, 15.0};
        load_observer_t observer;
        load_observer_reset(&observer, rotor.encoder(32));
        twin.angle = rotor.encoder(32) / twins::TURN;
        double speed = 0.0, load_Nm = 0.0;
        for (int k = 0; k < 200000; k++) {
            const double torque = 4.0 + 3.0 * std::sin(k * 4e-4), load = k < 100000 ? 0.0 : 8.0;
            const int32_t torque_q24 = twins::to_fixed(torque, twins::Q24);
            const uint32_t measured = rotor.encoder(32);
            observe(parameters, &observer, measured, torque_q24);
            twin.step(measured / twins::TURN, torque_q24 / twins::Q24);
            speed = std::max(speed, std::fabs(observer.speed_q22 / twins::Q22 - twin.speed));
            load_Nm = std::max(load_Nm, std::fabs(observer.load_torque_q24 / twins::Q24 - twin.load_torque));
            rotor.step(torque, load, 1e6);
        }
        EXPECT_LT(speed, 1e-3) << "rad/s, at " << bandwidth;
        EXPECT_GT(speed, 0.1 / twins::Q22);
        EXPECT_LT(load_Nm, 3e-3) << "N m, at " << bandwidth;
    }
}

TEST(LoadObserver, tells_the_innovation_before_the_step_and_the_speed_s_correction_behind_it) {
    const observer_parameters_t parameters = configure(1000.0);
    for (const int32_t innovation : {1, -1, 1000, -32768, 1 << 27, -(1 << 27), (1 << 27) + 1000, INT32_MIN + 1}) {
        load_observer_t observer;
        load_observer_reset(&observer, 0x12345678u);
        const uint32_t measured = 0x12345678u + uint32_t(innovation);
        const double held = std::clamp(double(innovation), -134217728.0, 134217727.0);
        EXPECT_EQ(load_observer_innovation(&observer, measured), held);
        EXPECT_EQ(observe(parameters, &observer, measured, 0), held);
        EXPECT_NEAR(observer.correction_q22, held * parameters.gains.speed_gain_q24 / twins::Q24, 1.01);
        twins::observer_t twin = twin_of(parameters);
        twin.step(held / twins::TURN, 0.0);
        EXPECT_NEAR(observer.correction_q22 / twins::Q22, twin.correction, 1.0 / twins::Q22);
    }
}

// What the observer estimates and what its twin does, for the same encoder readings and torques.
struct differences_t {
    double speed_rad_s = 0.0, load_Nm = 0.0, angle_rad = 0.0;
};

differences_t largest_differences(double bandwidth, unsigned encoder_bits, double start_turns, double start_speed,
                                  double direction) {
    const observer_parameters_t parameters = configure(bandwidth);
    twins::observer_t twin = twin_of(parameters);
    rotor_t rotor{start_turns, start_speed};
    load_observer_t observer;
    load_observer_reset(&observer, rotor.encoder(encoder_bits));
    twin.angle = rotor.encoder(encoder_bits) / twins::TURN;
    differences_t largest;
    for (int k = 0; k < 20000; k++) {
        const double load = direction * (k < 8000 ? 0.0 : 8.0);
        const double torque =
            direction * (4.0 + 3.0 * std::sin(k * 0.01) + std::max(0.0, 0.2 * (40.0 - std::fabs(rotor.speed))));
        const int32_t torque_q24 = twins::to_fixed(torque, twins::Q24);
        const uint32_t measured = rotor.encoder(encoder_bits);
        observe(parameters, &observer, measured, torque_q24);
        twin.step(measured / twins::TURN, torque_q24 / twins::Q24);
        double angle = turns_of(observer) - twin.angle;
        angle -= std::round(angle);
        largest.angle_rad = std::max(largest.angle_rad, std::fabs(angle) * 2.0 * twins::PI);
        largest.speed_rad_s = std::max(largest.speed_rad_s, std::fabs(observer.speed_q22 / twins::Q22 - twin.speed));
        largest.load_Nm =
            std::max(largest.load_Nm, std::fabs(observer.load_torque_q24 / twins::Q24 - twin.load_torque));
        rotor.step(torque, load);
    }
    return largest;
}

TEST(LoadObserver, follows_its_twin_through_half_a_second_with_a_load_step) {
    for (const double direction : {1.0, -1.0}) {
        for (const double bandwidth : {300.0, 1000.0, 4000.0}) {
            for (const unsigned bits : {12u, 17u, 32u}) {
                SCOPED_TRACE(testing::Message() << direction << ", " << bandwidth << " rad/s, " << bits << " bits");
                // Across the turn's end (0.99) as well.
                const differences_t largest = largest_differences(bandwidth, bits, 0.99, direction * 15.0, direction);
                EXPECT_LT(largest.speed_rad_s, 2.5e-5);
                EXPECT_LT(largest.load_Nm, 2.5e-4);
                EXPECT_LT(largest.angle_rad, 2.5e-8);
                // Not the same to the bit either.
                EXPECT_GT(largest.speed_rad_s, 1.0 / twins::Q22);
            }
        }
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
            observe(parameters, &observer, rotor.encoder(32), twins::to_fixed(torque, twins::Q24));
            rotor.step(torque, direction * 8.0);
        }
        EXPECT_NEAR(observer.load_torque_q24 / twins::Q24, direction * 8.0, 1e-2);
        EXPECT_NEAR(observer.speed_q22 / twins::Q22, rotor.speed, 1e-3);
    }
}

TEST(LoadObserver, answers_a_load_step_as_its_three_poles_say) {
    // Three poles at 1000 rad/s: 1 - e^-x (1 + x + x^2/2) of a step after x / 1000 s.
    const observer_parameters_t parameters = configure(1000.0);
    rotor_t rotor{0.0, 100.0};
    load_observer_t observer;
    load_observer_reset(&observer, rotor.encoder(32));
    const auto run = [&](int samples, double load) {
        for (int k = 0; k < samples; k++) {
            const double torque = FRICTION_NM_S * rotor.speed;
            observe(parameters, &observer, rotor.encoder(32), twins::to_fixed(torque, twins::Q24));
            rotor.step(torque, load);
        }
    };
    run(2000, 0.0);
    EXPECT_NEAR(observer.load_torque_q24 / twins::Q24, 0.0, 1e-2);
    for (int ms = 1; ms <= 8; ms++) {
        run(40, 8.0);
        const double x = ms;
        const double expected = 8.0 * (1.0 - std::exp(-x) * (1.0 + x + 0.5 * x * x));
        EXPECT_NEAR(observer.load_torque_q24 / twins::Q24, expected, 0.1) << ms << " ms";
    }
}

TEST(LoadObserver, catches_a_turning_rotor_from_rest) {
    for (const double rate_hz : {20000.0, 40000.0, 100000.0}) {
        for (const double bandwidth : {100.0, 300.0, 1000.0, 4000.0, 8000.0}) {
            for (const double speed : {-300.0, -30.0, 15.0, 100.0, 300.0, 400.0}) {
                const observer_parameters_t parameters = configure(bandwidth, rate_hz);
                rotor_t rotor{0.7, speed};
                load_observer_t observer;
                load_observer_reset(&observer, rotor.encoder(32));
                double fastest = 0.0, caught_s = 0.0;
                for (int k = 0; k < int(20.0 / bandwidth * rate_hz); k++) {
                    const double torque = FRICTION_NM_S * speed;
                    observe(parameters, &observer, rotor.encoder(32), twins::to_fixed(torque, twins::Q24));
                    rotor.step(torque, 0.0, rate_hz);
                    const double estimate = observer.speed_q22 / twins::Q22;
                    fastest = std::max(fastest, std::fabs(estimate));
                    if (std::fabs(estimate - speed) > 0.01 * std::fabs(speed)) {
                        caught_s = (k + 1) / rate_hz;
                    }
                }
                SCOPED_TRACE(testing::Message() << rate_hz << " Hz, " << bandwidth << " rad/s at " << speed);
                EXPECT_LT(caught_s, (std::fabs(speed) > 2.0 * bandwidth ? 20.0 : 10.0) / bandwidth);
                // No overspeed by the search itself, but for the slowest observers.
                if (std::fabs(speed) <= 0.3 * bandwidth || bandwidth >= 1000.0) {
                    EXPECT_LT(fastest, 1.26 * std::fabs(speed));
                }
            }
        }
    }
}

TEST(LoadObserver, the_angle_wraps_without_a_step_in_either_direction) {
    for (const double direction : {1.0, -1.0}) {
        const observer_parameters_t parameters = configure(1000.0);
        rotor_t rotor{0.0, direction * 300.0};
        load_observer_t observer;
        load_observer_reset(&observer, rotor.encoder(32));
        int32_t largest = 0;
        for (int k = 0; k < 20000; k++) { // some 24 turns
            const double torque = FRICTION_NM_S * rotor.speed;
            const int32_t innovation =
                observe(parameters, &observer, rotor.encoder(32), twins::to_fixed(torque, twins::Q24));
            if (k > 4000) {
                largest = std::max(largest, std::abs(innovation));
            }
            rotor.step(torque, 0.0);
        }
        EXPECT_LE(largest, 16) << "2^-32 turn";
    }
}

TEST(LoadObserver, a_jump_of_the_encoder_is_limited_and_forgotten) {
    const observer_parameters_t parameters = configure(1000.0);
    load_observer_t observer;
    load_observer_reset(&observer, 0);
    // Modulo a turn.
    EXPECT_EQ(observe(parameters, &observer, 0x40000000u, 0), (1 << 27) - 1);
    load_observer_reset(&observer, 0x10u);
    EXPECT_EQ(observe(parameters, &observer, 0xFFFFFFF0u, 0), -0x20);
    load_observer_reset(&observer, 0);
    EXPECT_EQ(observe(parameters, &observer, 0x80000000u, 0), -(1 << 27));
    // It corrects as a 32nd of a turn would, and the estimate comes back.
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
    EXPECT_NEAR(observer.speed_q22 / twins::Q22, 0.0, 1e-3);
    EXPECT_NEAR(observer.load_torque_q24 / twins::Q24, 0.0, 1e-2);
}

TEST(LoadObserver, every_estimate_saturates_and_none_overflows) {
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
    // Pushed forwards for ever: the speed holds at the end of Q9.22, the load at -60 N m.
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
