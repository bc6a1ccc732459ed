// The sliding-mode speed control against its reference model, its stability, and the reaching law as published.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>
#include <vector>

#include <gtest/gtest.h>

extern "C" {
#include "control/speed_smc.h"
#include "fixed/fixed.h"
}

#include "support/reference_models.h"
#include "support/wide_integer.h"

namespace {

using namespace fixed_point;
// The paper's motor, Table 1, and its rated torque by 6 kW.
constexpr double INERTIA_KG_M2 = 0.02;
constexpr double FRICTION_NM_S = 0.02;
constexpr double TORQUE_MAX_NM = 19.1;
constexpr double REFERENCE_RAD_S = 20.0 * PI; // 600 r/min

speed_smc_parameters_t parameters_of(double gain_1_s, double epsilon, double delta_s) {
    return {
        .gain_q24 = to_fixed(INERTIA_KG_M2 * gain_1_s, Q24),
        .epsilon_q31 = to_fixed(epsilon, Q31),
        .delta_q27 = to_fixed(delta_s / std::log(2.0), Q27),
        .friction_q30 = to_fixed(FRICTION_NM_S, Q30),
    };
}

// Reaching torque of the reference model for the rounded parameters.
double model_torque_Nm(const speed_smc_parameters_t &parameters, int32_t x_q22) {
    return reference_model::reaching_rad_s2(parameters.gain_q24 / Q24, parameters.epsilon_q31 / Q31,
                                            parameters.delta_q27 / Q27 * std::log(2.0), x_q22 / Q22);
}

// Torque reference without the period between reaching torque and feed-forward that the drive has (deferred.h).
int32_t torque_q24_of(const speed_smc_parameters_t &parameters, int32_t reference_q22, int32_t speed_q22,
                      int32_t load_q24, int32_t torque_max_q24 = to_fixed(TORQUE_MAX_NM, Q24)) {
    const int32_t error_q22 = fixed_subtract(reference_q22, speed_q22);
    const int32_t reaching_q24 = speed_smc_reaching_torque_q24(&parameters, error_q22);
    return speed_smc_torque_q24(&parameters, reaching_q24, speed_q22, load_q24, -torque_max_q24, torque_max_q24);
}

// Ends of the range, zero, every magnitude with both signs, and random values.
std::vector<int32_t> speeds() {
    std::vector<int32_t> values = {0, INT32_MAX, INT32_MIN, INT32_MIN + 1};
    for (double magnitude = 1.0; magnitude < 2147483647.0; magnitude *= 1.01) {
        values.push_back(int32_t(magnitude));
        values.push_back(-int32_t(magnitude));
    }
    std::mt19937 random(1);
    for (int i = 0; i < 3000; i++) {
        values.push_back(int32_t(uint32_t(random())));
    }
    return values;
}

TEST(SpeedSmc, reaching_torque_error_is_within_its_bound_over_the_whole_range) {
    const std::vector<int32_t> values = speeds();
    double worst = 0.0;
    for (const double epsilon : {0.01, 0.05, 0.5, 0.9, 1.0}) {
        for (const double delta_s : {0.0, 0.0002, 0.1, 1.0, 3.0, 10.0}) {
            for (const double gain : {1.0, 478.0, 1000.0, 6399.0}) {
                const speed_smc_parameters_t parameters = parameters_of(gain, epsilon, delta_s);
                for (const int32_t x_q22 : values) {
                    const double exact = model_torque_Nm(parameters, x_q22);
                    const int32_t torque_q24 = speed_smc_reaching_torque_q24(&parameters, x_q22);
                    if (std::fabs(exact) > 127.98) {
                        ASSERT_GE(std::abs(torque_q24), int32_t(127.96 * Q24));
                        continue;
                    }
                    const double error = std::fabs(torque_q24 / Q24 - exact);
                    ASSERT_LE(error, 1e-4 * std::fabs(exact) + 1.0 / Q20)
                        << "x " << x_q22 << " eps " << epsilon << " delta " << delta_s << " gain " << gain;
                    if (std::fabs(exact) > 1.0) {
                        worst = std::max(worst, error / std::fabs(exact));
                    }
                }
            }
        }
    }
    EXPECT_GT(worst, 4e-5) << "more accurate than its header says: adapt both";
    EXPECT_LT(worst, 9e-5);
}

// Two LSBs of the gain are much of a small one.
TEST(SpeedSmc, reaching_torque_error_is_within_its_bound_for_any_parameters) {
    std::mt19937 random(5);
    double worst_of_bound = 0.0;
    for (int i = 0; i < 300000; i++) {
        const int32_t delta_max_q27 = to_fixed(10.0 / std::log(2.0), Q27);
        const speed_smc_parameters_t parameters = {
            .gain_q24 = std::max(wide_integer::any_up_to(random, INT32_MAX), 1),
            .epsilon_q31 = std::max(wide_integer::any_up_to(random, INT32_MAX), SPEED_SMC_EPSILON_MIN_Q31),
            .delta_q27 = wide_integer::any_up_to(random, delta_max_q27),
            .friction_q30 = 0};
        const int32_t x_q22 = wide_integer::any(random);
        const double exact = model_torque_Nm(parameters, x_q22);
        const int32_t torque_q24 = speed_smc_reaching_torque_q24(&parameters, x_q22);
        const double bound = 1e-4 * std::fabs(exact) + 2.0 * std::fabs(exact) / parameters.gain_q24 + 1.0 / Q20;
        const double saturated = std::clamp(exact, -INT32_MAX / Q24, INT32_MAX / Q24);
        const double error = std::fabs(torque_q24 / Q24 - saturated);
        ASSERT_LE(error, bound) << "x " << x_q22 << " gain " << parameters.gain_q24 << " eps " << parameters.epsilon_q31
                                << " delta " << parameters.delta_q27;
        worst_of_bound = std::max(worst_of_bound, error / bound);
    }
    EXPECT_GT(worst_of_bound, 0.25) << "four times the error would not show";
}

TEST(SpeedSmc, reaching_torque_is_exactly_odd_and_saturates) {
    const speed_smc_parameters_t parameters = parameters_of(6000.0, 0.01, 10.0);
    for (const int32_t x_q22 : speeds()) {
        if (x_q22 != INT32_MIN) {
            ASSERT_EQ(speed_smc_reaching_torque_q24(&parameters, -x_q22),
                      -speed_smc_reaching_torque_q24(&parameters, x_q22));
        }
    }
    EXPECT_EQ(speed_smc_reaching_torque_q24(&parameters, INT32_MAX), INT32_MAX);
    EXPECT_EQ(speed_smc_reaching_torque_q24(&parameters, INT32_MIN), -INT32_MAX);
    EXPECT_EQ(speed_smc_reaching_torque_q24(&parameters, 0), 0);
}

TEST(SpeedSmc, torque_includes_load_and_friction_and_is_clamped_to_the_limits) {
    const speed_smc_parameters_t parameters = parameters_of(1000.0, 0.5, 1.0);
    std::mt19937 random(2);
    std::uniform_real_distribution<double> speed(-330.0, 330.0), load(-20.0, 20.0), error(-2.0, 2.0);
    for (int i = 0; i < 200000; i++) {
        const int32_t speed_q22 = to_fixed(speed(random), Q22);
        const int32_t reference_q22 = speed_q22 + to_fixed(error(random), Q22);
        const int32_t load_q24 = to_fixed(load(random), Q24);
        const double exact =
            model_torque_Nm(parameters, reference_q22 - speed_q22) + load_q24 / Q24 + FRICTION_NM_S * speed_q22 / Q22;
        const double clamped = std::clamp(exact, -TORQUE_MAX_NM, TORQUE_MAX_NM);
        const double torque = torque_q24_of(parameters, reference_q22, speed_q22, load_q24) / Q24;
        ASSERT_NEAR(torque, clamped, 1e-4 * 40.0 + 1.0 / Q20);
    }
}

// Exactly: sums that saturate, friction rounded down. A friction torque that saturates is within 16 LSB of it.
TEST(SpeedSmc, torque_is_the_saturated_sum_of_its_parts_for_any_arguments) {
    using namespace wide_integer;
    std::mt19937 random(6);
    int exact = 0, saturating = 0, inside = 0;
    for (int i = 0; i < 300000; i++) {
        const speed_smc_parameters_t parameters = {
            .gain_q24 = 1, .epsilon_q31 = INT32_MAX, .delta_q27 = 0, .friction_q30 = any_up_to(random, INT32_MAX)};
        const int32_t reaching_q24 = any(random), speed_q22 = any(random), load_q24 = any(random);
        const int32_t one_q24 = any(random), other_q24 = any(random);
        const int32_t min_q24 = i % 2 ? INT32_MIN : std::min(one_q24, other_q24);
        const int32_t max_q24 = i % 2 ? INT32_MAX : std::max(one_q24, other_q24);
        const int32_t torque_q24 =
            speed_smc_torque_q24(&parameters, reaching_q24, speed_q22, load_q24, min_q24, max_q24);
        const wide_t friction_q24 = rounded_down(wide_t(speed_q22) * parameters.friction_q30, power_of_2(28));
        const auto with = [&](wide_t of_friction_q24) {
            const wide_t sum_q24 = saturated(wide_t(reaching_q24) + load_q24) + of_friction_q24;
            return std::clamp(saturated(sum_q24), min_q24, max_q24);
        };
        const int32_t nearest_q24 = with(saturated(friction_q24));
        if (fits(friction_q24)) {
            ASSERT_EQ(torque_q24, nearest_q24) << reaching_q24 << " " << speed_q22 << " " << load_q24;
            exact++;
            inside += nearest_q24 > min_q24 && nearest_q24 < max_q24;
        } else {
            const int32_t least_q24 = with(saturated(friction_q24) - (friction_q24 > 0 ? 15 : -15));
            ASSERT_GE(torque_q24, std::min(nearest_q24, least_q24)) << speed_q22;
            ASSERT_LE(torque_q24, std::max(nearest_q24, least_q24)) << speed_q22;
            saturating++;
        }
    }
    EXPECT_GT(inside, 100000);
    EXPECT_GT(exact, inside);
    EXPECT_GT(saturating, 1000);
}

TEST(SpeedSmc, nothing_overflows_at_the_ends_of_all_ranges) {
    const int32_t ends[] = {INT32_MIN, INT32_MIN + 1, -1, 0, 1, INT32_MAX};
    for (const int32_t gain_q24 : {1, INT32_MAX}) {
        for (const int32_t epsilon_q31 : {1 << 16, 327 << 16, INT32_MAX}) {
            for (const int32_t delta_q27 : {0, to_fixed(10.0 / std::log(2.0), Q27)}) {
                const speed_smc_parameters_t parameters = {.gain_q24 = gain_q24,
                                                           .epsilon_q31 = epsilon_q31,
                                                           .delta_q27 = delta_q27,
                                                           .friction_q30 = INT32_MAX};
                for (const int32_t reference : ends) {
                    for (const int32_t speed : ends) {
                        for (const int32_t load : ends) {
                            const int32_t torque_q24 = torque_q24_of(parameters, reference, speed, load, 40 << 24);
                            ASSERT_LE(std::abs(torque_q24), 40 << 24);
                        }
                    }
                }
            }
        }
    }
}

// V = s^2 / 2, V' = s s': with the law's torque, s' = -(T - B w - T_L) / J.
TEST(SpeedSmc, the_lyapunov_function_decreases_while_the_torque_is_not_limited) {
    const speed_smc_parameters_t parameters = parameters_of(1000.0, 0.5, 1.0);
    std::mt19937 random(3);
    std::uniform_real_distribution<double> speed(-330.0, 330.0), load(-12.0, 12.0), exponent(-4.0, 2.5);
    for (int i = 0; i < 300000; i++) {
        const double sign = random() % 2 == 0 ? 1.0 : -1.0;
        const int32_t speed_q22 = to_fixed(speed(random), Q22);
        const int32_t reference_q22 = to_fixed(speed_q22 / Q22 + sign * std::pow(10.0, exponent(random)), Q22);
        const int32_t load_q24 = to_fixed(load(random), Q24);
        const double torque = torque_q24_of(parameters, reference_q22, speed_q22, load_q24) / Q24;
        const double s = (double(reference_q22) - speed_q22) / Q22;
        const double s_rate = -(torque - FRICTION_NM_S * speed_q22 / Q22 - load_q24 / Q24) / INERTIA_KG_M2;
        ASSERT_LT(s * s_rate, 0.0) << "s " << s;
    }
}

TEST(SpeedSmc, the_speed_error_of_the_sampled_model_never_grows) {
    const speed_smc_parameters_t parameters = parameters_of(1000.0, 0.5, 1.0);
    std::mt19937 random(4);
    std::uniform_real_distribution<double> start(0.0, 330.0), any_load(-8.0, 8.0);
    for (const double rate_hz : {20000.0, 40000.0, 100000.0}) {
        for (int run = 0; run < 20; run++) {
            const double load = any_load(random), reference = start(random);
            double speed = start(random);
            double last = std::fabs(reference - speed);
            for (int k = 0; k < 8000; k++) {
                const int32_t torque_q24 =
                    torque_q24_of(parameters, to_fixed(reference, Q22), to_fixed(speed, Q22), to_fixed(load, Q24));
                speed += (torque_q24 / Q24 - FRICTION_NM_S * speed - load) / INERTIA_KG_M2 / rate_hz;
                const double error = std::fabs(reference - speed);
                ASSERT_LE(error, last + 2.0 / Q22) << "run " << run << ", sample " << k;
                last = error;
            }
        }
    }
}

// Erratum: (10) has e^{+|s|} and no gain.
TEST(SpeedSmc, the_reaching_law_as_published_never_moves_the_motor) {
    double largest = 0.0;
    for (double x = 1e-3; x < 512.0; x *= 1.0005) {
        largest = std::max(largest, std::fabs(reference_model::published_reaching_rad_s2(x)));
        ASSERT_EQ(reference_model::published_reaching_rad_s2(-x), -reference_model::published_reaching_rad_s2(x));
    }
    EXPECT_NEAR(largest, 0.228, 0.0005);
    EXPECT_NEAR(INERTIA_KG_M2 * largest, 4.6e-3, 0.05e-3);
    EXPECT_LT(reference_model::published_reaching_rad_s2(REFERENCE_RAD_S), 1e-26);

    // (11) with the load known to be none. So J dw/dt = T - B w = J H sgn(s).
    double speed = 0.0;
    for (int k = 0; k < 10 * 20000; k++) {
        const double torque =
            INERTIA_KG_M2 * reference_model::published_reaching_rad_s2(REFERENCE_RAD_S - speed) + FRICTION_NM_S * speed;
        speed += (torque - FRICTION_NM_S * speed) / INERTIA_KG_M2 / 20000.0;
    }
    EXPECT_LT(speed * 30.0 / PI, 0.01) << "r/min of 600 after 10 s";
    EXPECT_GE(speed, 0.0);
}

TEST(SpeedSmc, the_corrected_reaching_law_starts_the_motor_within_72_ms) {
    const speed_smc_parameters_t parameters = parameters_of(1000.0, 0.5, 1.0);
    const double rate_hz = 40000.0;
    double speed = 0.0, settled_s = 0.0, highest = 0.0;
    for (int k = 0; k < 8000; k++) {
        const int32_t torque_q24 = torque_q24_of(parameters, to_fixed(REFERENCE_RAD_S, Q22), to_fixed(speed, Q22), 0);
        speed += (torque_q24 / Q24 - FRICTION_NM_S * speed) / INERTIA_KG_M2 / rate_hz;
        highest = std::max(highest, speed);
        if (std::fabs(REFERENCE_RAD_S - speed) > 0.005 * REFERENCE_RAD_S) {
            settled_s = (k + 2) / rate_hz;
        }
    }
    EXPECT_LT(settled_s, 0.072);
    EXPECT_GT(settled_s, 0.0675) << "faster than 19.1 N m allows";
    EXPECT_LT(highest, REFERENCE_RAD_S * 1.0001);
}

} // namespace
