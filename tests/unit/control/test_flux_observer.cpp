// Flux linkage from voltage and current, against the reference model.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/flux_observer.h"
}

#include "support/reference_models.h"

namespace {

using namespace fixed_point;
constexpr double PERIOD_S = 25e-6, RESISTANCE_OHM = 0.05;

flux_observer_parameters_t parameters_of(double gain, double resistance_ohm = RESISTANCE_OHM) {
    return {to_fixed(gain, Q15) << 15, to_fixed(resistance_ohm * PERIOD_S, Q40)};
}

// The correction is rounded to 4 LSB, 7.5 nWb, once a period: as a random walk with a gain that decays as slowly as
// 0.01, up to 40 nWb. Without a correction only the drop is rounded, but no error decays.
TEST(FluxObserver, follows_its_reference_model_within_40_nWb_and_within_20_at_a_gain_of_a_quarter_or_more) {
    for (const double gain : {0.0, 0.01, 0.25, 1.0}) {
        const flux_observer_parameters_t p = parameters_of(gain);
        std::mt19937 random(1);
        std::uniform_real_distribution<double> uniform(0.0, 1.0);
        int32_t flux_q29 = 0;
        double model = 0.0, worst = 0.0;
        for (int k = 0; k < 4000; k++) {
            // A phase that is driven up and down, and tables with some error.
            const int32_t applied_q29 = to_fixed(6e-3 * (2.0 * uniform(random) - 1.0 + 0.3 * std::sin(k * 0.02)), Q29);
            const int32_t table_q29 = to_fixed(std::max(0.0, model * (0.95 + 0.1 * uniform(random))), Q29);
            const int32_t current_q9 = int32_t(random() % (60 * 512));
            const double drop = current_q9 / Q9 * p.resistance_period_q40 / Q40;
            const int32_t drop_q29 = flux_observer_step(&p, &flux_q29, table_q29, applied_q29, current_q9);
            model = reference_model::flux_step(model, p.gain_q30 / Q30, table_q29 / Q29, applied_q29 / Q29, drop);
            ASSERT_NEAR(drop_q29 / Q29, drop, 0.51 / Q29);
            worst = std::max(worst, std::fabs(flux_q29 / Q29 - model));
        }
        EXPECT_LT(worst, gain == 0.0 ? 200e-9 : gain < 0.25 ? 40e-9 : 20e-9) << gain;
        EXPECT_GT(worst, 0.0);
    }
}

TEST(FluxObserver, is_never_negative_and_saturates) {
    const flux_observer_parameters_t p = parameters_of(0.25);
    int32_t flux_q29 = 1000;
    flux_observer_step(&p, &flux_q29, 0, -3000000, 0);
    EXPECT_EQ(flux_q29, 0);
    flux_observer_step(&p, &flux_q29, 0, INT32_MIN, 1 << 18);
    EXPECT_EQ(flux_q29, 0);
    for (int k = 0; k < 3; k++) {
        flux_observer_step(&p, &flux_q29, INT32_MAX, INT32_MAX, 0);
    }
    EXPECT_EQ(flux_q29, INT32_MAX);
}

TEST(FluxObserver, the_correction_of_the_largest_error_by_the_largest_gain_fits) {
    const flux_observer_parameters_t p = {(1 << 30) - 1, 0};
    int32_t flux_q29 = -1; // changed in memory
    flux_observer_step(&p, &flux_q29, INT32_MAX, 0, 0);
    EXPECT_GT(flux_q29, INT32_MAX - 8);
}

TEST(FluxObserver, an_error_decays_by_the_gain_each_sample) {
    const flux_observer_parameters_t p = parameters_of(0.25, 0.0);
    int32_t flux_q29 = int32_t(0.3 * Q29);
    const int32_t table_q29 = int32_t(0.1 * Q29);
    double error = 0.2;
    for (int k = 0; k < 20; k++) {
        flux_observer_step(&p, &flux_q29, table_q29, 0, 0);
        error *= 0.75;
        ASSERT_NEAR(flux_q29 / Q29 - 0.1, error, 1e-8) << k;
    }
}

TEST(FluxObserver, resistive_drop_at_the_largest_resistance_and_current_is_exact) {
    const flux_observer_parameters_t p = parameters_of(0.0, 20.0);
    int32_t flux_q29 = INT32_MAX;
    const int32_t drop_q29 = flux_observer_step(&p, &flux_q29, 0, 0, 79 * 512);
    EXPECT_NEAR(drop_q29 / Q29, 79.0 * 20.0 * PERIOD_S, 1e-8);
    EXPECT_NEAR(flux_q29 / Q29, INT32_MAX / Q29 - 79.0 * 20.0 * PERIOD_S, 1e-8);
}

} // namespace
