// Thermal models of windings and switches against first-order models in double precision. [SR-16]
#include <cmath>
#include <random>
#include <tuple>
#include <vector>

#include <gtest/gtest.h>

extern "C" {
#include "control/machine_tables.h"
#include "monitors/thermal.h"
#include "storage/fault.h"
}

namespace {

constexpr double A = 512.0; // LSBs of Q7.9

struct Settings {
    double winding_A, switch_A;
    int time_constant_s;
};

thermal_parameters_t configure(const Settings &settings) {
    std::vector<int32_t> values(PARAMETER_COUNT);
    values[PARAMETER_WINDING_CURRENT_A] = int32_t(settings.winding_A * A);
    values[PARAMETER_WINDING_TIME_CONSTANT_S] = settings.time_constant_s;
    values[PARAMETER_SWITCH_CURRENT_A] = int32_t(settings.switch_A * A);
    values[PARAMETER_TORQUE_MAX_NM] = 20 << 24;
    return thermal_configure(values.data());
}

// The load's exact answer to a square that is constant in each sample.
struct Model {
    double current_A, time_constant_s, load = 0.0;

    void step(double measured_A, double step_s) {
        const double square = std::pow(measured_A / current_A, 2);
        load = square + (load - square) * std::exp(-step_s / time_constant_s);
    }
};

class Heat : public testing::TestWithParam<std::tuple<Settings, uint32_t>> {};

// Currents that are chopped, switched from phase to phase and at times overload: a new amplitude every 20 ms, in one
// phase after the other.
TEST_P(Heat, is_within_a_percent_of_a_model_in_double_precision) {
    const auto &[settings, sample_us] = GetParam();
    const thermal_parameters_t parameters = configure(settings);
    thermal_t thermal{};
    Model winding[2] = {{settings.winding_A, double(settings.time_constant_s)},
                        {settings.winding_A, double(settings.time_constant_s)}};
    Model switches[2] = {{settings.switch_A, 1.0}, {settings.switch_A, 1.0}};
    std::mt19937 random(settings.time_constant_s);
    std::uniform_real_distribution<double> share(0.0, 1.0);
    const double duration_s = std::min(3.0 * settings.time_constant_s, 20.0);
    double worst = 0.0, highest = 0.0;
    uint32_t time_us = 0;
    double amplitude_A = 0.0;
    unsigned on = 0;
    for (unsigned k = 0; time_us < duration_s * 1e6; k++) {
        if (time_us % 20000 < sample_us) {
            amplitude_A = share(random) * 2.0 * settings.winding_A;
            on = unsigned(share(random) * 3.0); // 2: neither
        }
        int32_t current_q9[HAL_PHASES_MAX]{};
        for (unsigned phase = 0; phase < 2; phase++) {
            const double chopped_A = std::min(amplitude_A * (0.8 + 0.4 * share(random)), 127.0);
            current_q9[phase] = phase == on ? int32_t(chopped_A * A) : 0;
            winding[phase].step(current_q9[phase] / A, sample_us * 1e-6);
            switches[phase].step(current_q9[phase] / A, sample_us * 1e-6);
        }
        time_us += sample_us;
        if (!thermal_sample(&parameters, &thermal, current_q9, time_us)) {
            continue;
        }
        const double winding_load = std::max(winding[0].load, winding[1].load);
        const double switch_load = std::max(switches[0].load, switches[1].load);
        if (winding_load > 0.004) { // 260 LSB
            worst = std::max(worst, std::abs(thermal_winding_load_q16(&thermal) / 65536.0 / winding_load - 1.0));
        }
        if (switch_load > 0.004) {
            worst = std::max(worst, std::abs(thermal_switch_load_q16(&thermal) / 65536.0 / switch_load - 1.0));
        }
        highest = std::max(highest, winding_load);
    }
    RecordProperty("worst_percent", std::to_string(100.0 * worst));
    EXPECT_GT(highest, 0.008);
    EXPECT_LT(worst, 0.01);
    EXPECT_GT(worst, 0.0);
}

INSTANTIATE_TEST_SUITE_P(settings, Heat,
                         testing::Combine(testing::Values(Settings{30.0, 42.0, 1}, Settings{2.0, 3.0, 7},
                                                          Settings{60.0, 79.0, 60}, Settings{10.0, 79.0, 1000}),
                                          testing::Values(25u, 50u, 333u)));

// Milliseconds of a constant current until `until` is true.
template <typename condition_t>
double time_s(thermal_t &thermal, const thermal_parameters_t &parameters, double current_A, condition_t until) {
    const int32_t current_q9[HAL_PHASES_MAX] = {0, int32_t(current_A * A)};
    uint32_t time_us = thermal.step_us;
    while (!until(thermal) && time_us < thermal.step_us + 1000000000u) {
        time_us += 250;
        thermal_sample(&parameters, &thermal, current_q9, time_us);
        if (time_us > 600000000u) {
            break;
        }
    }
    return time_us * 1e-6;
}

bool tripped(const thermal_t &thermal) {
    return thermal_faults(&thermal) != 0;
}

TEST(Overload, trips_after_the_time_of_a_first_order_model_by_winding_or_switches) {
    for (const double ratio : {1.05, 1.5, 3.0}) {
        thermal_t thermal{};
        const auto parameters = configure({20.0, 79.0, 10});
        const double expected_s = 10.0 * std::log(ratio * ratio / (ratio * ratio - 1.0));
        EXPECT_NEAR(time_s(thermal, parameters, 20.0 * ratio, tripped), expected_s, 0.01 * expected_s) << ratio;
        EXPECT_EQ(thermal_faults(&thermal), FAULT_BIT(FAULT_WINDING_OVERLOAD));
    }
    thermal_t thermal{};
    const auto parameters = configure({79.0, 20.0, 60});
    EXPECT_NEAR(time_s(thermal, parameters, 30.0, tripped), std::log(2.25 / 1.25), 0.006);
    EXPECT_EQ(thermal_faults(&thermal), FAULT_BIT(FAULT_INVERTER_OVERLOAD));
}

TEST(Overload, does_not_trip_at_99_percent_of_the_continuous_current_and_does_at_101_percent) {
    for (const auto &[ratio, trips] : {std::pair{0.99, false}, std::pair{1.01, true}}) {
        thermal_t thermal{};
        const auto parameters = configure({20.0, 79.0, 1});
        time_s(thermal, parameters, 20.0 * ratio,
               [](const thermal_t &at) { return tripped(at) || at.step_us > 9000000; });
        EXPECT_EQ(tripped(thermal), trips) << ratio;
    }
}

TEST(Overload, lasts_until_the_load_is_below_90_percent) {
    thermal_t thermal{};
    const auto parameters = configure({20.0, 79.0, 10});
    const double tripped_s = time_s(thermal, parameters, 40.0, tripped);
    const double gone_s = time_s(thermal, parameters, 0.0, [](const thermal_t &at) { return !tripped(at); });
    EXPECT_NEAR(gone_s - tripped_s, 10.0 * std::log(1.0 / 0.9), 0.02);
}

TEST(Overload, of_the_winding_and_of_the_switches_begin_and_end_each_by_its_own_load) {
    const auto parameters = configure({20.0, 79.0, 10});
    const int32_t current_q9[HAL_PHASES_MAX] = {};
    for (const bool winding : {true, false}) {
        thermal_t thermal{};
        int64_t *load_q56 = winding ? thermal.winding_q56 : thermal.switches_q56;
        int64_t *other_q56 = winding ? thermal.switches_q56 : thermal.winding_q56;
        const uint64_t fault = FAULT_BIT(winding ? FAULT_WINDING_OVERLOAD : FAULT_INVERTER_OVERLOAD);
        const auto faults = [&](double load, double other) {
            load_q56[1] = int64_t(load * 0x1p56);
            other_q56[1] = int64_t(other * 0x1p56);
            thermal_sample(&parameters, &thermal, current_q9, thermal.step_us + 1000);
            return thermal_faults(&thermal);
        };
        EXPECT_EQ(faults(0.99, 0.95), 0u);
        EXPECT_EQ(faults(1.01, 0.95), fault) << "the other one has not been overloaded";
        EXPECT_EQ(faults(0.91, 0.99), fault);
        EXPECT_EQ(faults(0.89, 0.95), 0u);
        EXPECT_EQ(faults(0.91, 0.0), 0u) << "it has ended";
    }
}

TEST(Derating, is_smooth_and_linear_from_90_to_100_percent) {
    const auto parameters = configure({20.0, 79.0, 1});
    int32_t before_q24 = 20 << 24;
    for (int64_t permille = 0; permille <= 1100; permille++) {
        thermal_t thermal{};
        thermal.winding_q56[2] = (permille * (INT64_C(1) << 50) / 1000) << 6;
        const int32_t limit_q24 = thermal_torque_limit_q24(&parameters, &thermal);
        const double expected = 20.0 * std::clamp((1000.0 - double(permille)) / 100.0, 0.0, 1.0);
        EXPECT_NEAR(limit_q24 / 16777216.0, expected, 0.01) << permille;
        EXPECT_LE(limit_q24, before_q24);
        before_q24 = limit_q24;
        thermal.switches_q56[0] = thermal.winding_q56[2];
        thermal.winding_q56[2] = 0;
        EXPECT_EQ(thermal_torque_limit_q24(&parameters, &thermal), limit_q24) << "by the switches alike";
    }
    EXPECT_EQ(before_q24, 0);
}

TEST(Step, counts_a_background_that_was_late_as_long_as_it_was_but_at_most_a_tenth_of_a_second) {
    const auto parameters = configure({20.0, 79.0, 10});
    const int32_t current_q9[HAL_PHASES_MAX] = {int32_t(20 * A)};
    const auto load_after = [&](uint32_t step_us) {
        thermal_t thermal{};
        EXPECT_TRUE(thermal_sample(&parameters, &thermal, current_q9, step_us));
        return thermal_winding_load_q16(&thermal) / 65536.0;
    };
    EXPECT_NEAR(load_after(5000), 5e-4, 2e-5);
    EXPECT_NEAR(load_after(100000), 1e-2, 2e-5);
    EXPECT_EQ(load_after(3000000), load_after(100000));
    thermal_t thermal{};
    EXPECT_FALSE(thermal_sample(&parameters, &thermal, current_q9, 999));
}

TEST(Step, counts_squares_of_more_than_64_times_that_of_the_continuous_current_as_64_times) {
    const auto parameters = configure({2.0, 3.0, 10});
    for (const auto &[current_A, winding, switches] :
         {std::tuple{15.8, 62.41, 27.738}, std::tuple{17.0, 64.0, 32.111}, std::tuple{127.0, 64.0, 64.0}}) {
        const int32_t current_q9[HAL_PHASES_MAX] = {0, 0, int32_t(current_A * A)};
        thermal_t thermal{};
        ASSERT_TRUE(thermal_sample(&parameters, &thermal, current_q9, 100000));
        EXPECT_NEAR(thermal_winding_load_q16(&thermal) / 65536.0, winding * 0.1 / 10.0, 1e-3) << current_A;
        EXPECT_NEAR(thermal_switch_load_q16(&thermal) / 65536.0, switches * 0.1, 1e-2) << current_A;
    }
}

} // namespace
