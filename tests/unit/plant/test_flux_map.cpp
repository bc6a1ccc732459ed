// Kernel of the map compared with a co-energy that its splines represent exactly: a polynomial, with coefficients by
// polar forms (blossoms), independent of the recursions of the kernel.
#include <gtest/gtest.h>

#include <cmath>
#include <memory>

extern "C" {
#include "plant/magnetics.h"
}

namespace {

constexpr unsigned POLES = 4;
constexpr double HALF_RAD = M_PI / POLES;
constexpr double CURRENT_MAX_A = 80.0;
constexpr double STEP_A = CURRENT_MAX_A / FLUX_MAP_CURRENT_INTERVALS;
constexpr double STEP_RAD = HALF_RAD / FLUX_MAP_ANGLE_INTERVALS;

// W = p(x) q(i), x from 0 aligned to HALF_RAD: p = 1 - 0.9 (3 y^2 - 2 y^3), y = x / HALF_RAD, without slope at both
// ends; q = 12e-3 i^2 - 1e-4 i^3 + 4e-7 i^4.
double shape(double x, int order) {
    const double y = x / HALF_RAD, k = 1.0 / HALF_RAD;
    return order == 0   ? 1.0 - 0.9 * y * y * (3.0 - 2.0 * y)
           : order == 1 ? -0.9 * 6.0 * y * (1.0 - y) * k
                        : -0.9 * 6.0 * (1.0 - 2.0 * y) * k * k;
}

double energy_J(double i, int order) {
    switch (order) {
    case 0:
        return i * i * (12e-3 + i * (-1e-4 + 4e-7 * i));
    case 1:
        return i * (24e-3 + i * (-3e-4 + 16e-7 * i));
    case 2:
        return 24e-3 + i * (-6e-4 + 48e-7 * i);
    default:
        return -6e-4 + 96e-7 * i;
    }
}

// Coefficient of the B-spline over steps k - 3 .. k + 1 of the cubic shape(): its polar form at k - 2, k - 1, k.
double shape_coefficient(int k) {
    const double a = (k - 2) * STEP_RAD / HALF_RAD, b = (k - 1) * STEP_RAD / HALF_RAD, c = k * STEP_RAD / HALF_RAD;
    return 1.0 - 0.9 * ((a * b + b * c + c * a) - 2.0 * a * b * c);
}

// Coefficient for the quartic energy_J(): its polar form at j - 3, j - 2, j - 1, j.
double energy_coefficient(int j) {
    const double a = (j - 3) * STEP_A, b = (j - 2) * STEP_A, c = (j - 1) * STEP_A, d = j * STEP_A;
    const double pairs = (a * b + a * c + a * d + b * c + b * d + c * d) / 6.0;
    const double triples = (a * b * c + a * b * d + a * c * d + b * c * d) / 4.0;
    return 12e-3 * pairs - 1e-4 * triples + 4e-7 * a * b * c * d;
}

class FluxMap : public testing::Test {
  protected:
    FluxMap() : map(std::make_unique<flux_map_t>()) {
        map->current_max_A = CURRENT_MAX_A;
        map->inductance_min_H = 1e-4;
        map->current_scale_A = 25.0;
        for (int j = 0; j < FLUX_MAP_CURRENT_INTERVALS + 4; j++) {
            for (int k = 0; k < FLUX_MAP_ANGLE_INTERVALS + 3; k++) {
                map->coenergy_J[j][k] = energy_coefficient(j) * shape_coefficient(k);
            }
        }
        magnetics_t magnetics = {};
        magnetics.form = MAGNETICS_MAP;
        magnetics.unaligned_inductance_H = 2.4e-3;
        magnetics.map = map.get();
        magnetics_prepare(&model, &magnetics, POLES);
    }

    magnetics_point_t at(double angle_rad, double current_A) const {
        magnetics_point_t point;
        magnetics_evaluate(&model, angle_rad, current_A, &point);
        return point;
    }

    const std::unique_ptr<flux_map_t> map;
    magnetics_model_t model;
};

// Points on knots, between them and next to them, and at both ends.
constexpr double ANGLES[] = {0.0, 0.001, 0.3, 1.0 - 1e-12, 1.0, 1.0 + 1e-12, 17.77, 48.0, 60.5, 95.0, 95.99, 96.0};
constexpr double CURRENTS[] = {-1.5, -0.7, 0.0, 1e-6, 0.4, 1.0 - 1e-12, 1.0, 2.5, 31.0, 40.25, 63.0, 63.999, 64.0};

TEST_F(FluxMap, HasEveryDerivativeOfTheCoenergy) {
    for (const double angle_steps : ANGLES) {
        for (const double current_steps : CURRENTS) {
            SCOPED_TRACE(testing::Message() << angle_steps << " angle steps, " << current_steps << " current steps");
            const double x = angle_steps * STEP_RAD, i = current_steps * STEP_A;
            const magnetics_point_t point = at(x, i);
            EXPECT_NEAR(magnetics_coenergy_J(&model, x, i), shape(x, 0) * energy_J(i, 0), 1e-12);
            EXPECT_NEAR(point.flux_linkage_Wb, shape(x, 0) * energy_J(i, 1), 1e-13);
            EXPECT_NEAR(point.incremental_inductance_H, shape(x, 0) * energy_J(i, 2), 1e-13);
            EXPECT_NEAR(point.inductance_slope_H_A, shape(x, 0) * energy_J(i, 3), 1e-13);
            EXPECT_NEAR(point.torque_Nm, shape(x, 1) * energy_J(i, 0), 1e-10);
            EXPECT_NEAR(point.flux_gradient_Wb_rad, shape(x, 1) * energy_J(i, 1), 1e-11);
            EXPECT_NEAR(point.inductance_gradient_H_rad, shape(x, 1) * energy_J(i, 2), 1e-12);
            EXPECT_NEAR(point.torque_gradient_Nm_rad, shape(x, 2) * energy_J(i, 0), 1e-8);
            EXPECT_NEAR(point.flux_curvature_Wb_rad2, shape(x, 2) * energy_J(i, 1), 1e-9);
        }
    }
}

TEST_F(FluxMap, ScalesWithTheGainAtEveryPoint) {
    const magnetics_model_t once = model;
    magnetics_scale(&model, 1.25);
    EXPECT_DOUBLE_EQ(model.inductance_min_H, 1.25 * once.inductance_min_H);
    for (const double angle_steps : ANGLES) {
        for (const double current_steps : CURRENTS) {
            const double x = angle_steps * STEP_RAD, i = current_steps * STEP_A;
            magnetics_point_t point, scaled;
            magnetics_evaluate(&once, x, i, &point);
            magnetics_evaluate(&model, x, i, &scaled);
            for (unsigned k = 0; k < sizeof point / sizeof(double); k++) {
                const double value = reinterpret_cast<const double *>(&point)[k];
                ASSERT_NEAR(reinterpret_cast<const double *>(&scaled)[k], 1.25 * value, 1e-14 * std::fabs(value)) << k;
            }
            const double coenergy_J = magnetics_coenergy_J(&once, x, i);
            ASSERT_NEAR(magnetics_coenergy_J(&model, x, i), 1.25 * coenergy_J, 1e-14 * std::fabs(coenergy_J));
        }
    }
}

TEST_F(FluxMap, IsEvenAboutTheAlignedPositionAndRepeatsEveryPitch) {
    for (const double angle_steps : {0.3, 17.77, 60.5, 95.99}) {
        const double x = angle_steps * STEP_RAD;
        const magnetics_point_t here = at(x, 33.0), mirrored = at(-x, 33.0), later = at(x + 200.0 * HALF_RAD, 33.0);
        EXPECT_EQ(here.flux_linkage_Wb, mirrored.flux_linkage_Wb);
        EXPECT_EQ(here.torque_Nm, -mirrored.torque_Nm);
        EXPECT_EQ(here.flux_gradient_Wb_rad, -mirrored.flux_gradient_Wb_rad);
        EXPECT_EQ(here.inductance_gradient_H_rad, -mirrored.inductance_gradient_H_rad);
        EXPECT_EQ(here.torque_gradient_Nm_rad, mirrored.torque_gradient_Nm_rad);
        EXPECT_EQ(here.flux_curvature_Wb_rad2, mirrored.flux_curvature_Wb_rad2);
        EXPECT_NEAR(here.flux_linkage_Wb, later.flux_linkage_Wb, 1e-12);
        EXPECT_NEAR(here.torque_Nm, later.torque_Nm, 1e-10);
        EXPECT_LT(here.torque_Nm, 0.0);
    }
}

TEST_F(FluxMap, ExtrapolatesLinearlyBeyondTheMaximumCurrent) {
    const double x = 40.3 * STEP_RAD, i = 1.6 * CURRENT_MAX_A, more_A = i - CURRENT_MAX_A;
    const magnetics_point_t point = at(x, i), end = at(x, CURRENT_MAX_A);
    EXPECT_NEAR(point.incremental_inductance_H, end.incremental_inductance_H, 1e-15);
    EXPECT_EQ(point.inductance_slope_H_A, 0.0);
    EXPECT_NEAR(point.flux_linkage_Wb, end.flux_linkage_Wb + end.incremental_inductance_H * more_A, 1e-13);
    // Extrapolated co-energy by integration, and torque as its derivative, for each power of more_A.
    const double energies[] = {energy_J(CURRENT_MAX_A, 0), energy_J(CURRENT_MAX_A, 1), energy_J(CURRENT_MAX_A, 2)};
    const double beyond_J = energies[0] + energies[1] * more_A + 0.5 * energies[2] * more_A * more_A;
    EXPECT_NEAR(magnetics_coenergy_J(&model, x, i), shape(x, 0) * beyond_J, 1e-11);
    EXPECT_NEAR(point.torque_Nm, shape(x, 1) * beyond_J, 1e-9);
    EXPECT_NEAR(point.torque_gradient_Nm_rad, shape(x, 2) * beyond_J, 1e-7);
    EXPECT_NEAR(point.flux_gradient_Wb_rad, shape(x, 1) * (energies[1] + energies[2] * more_A), 1e-11);
    EXPECT_NEAR(point.inductance_gradient_H_rad, shape(x, 1) * energies[2], 1e-12);
}

TEST_F(FluxMap, IsContinuousAtTheMaximumCurrent) {
    const magnetics_point_t before = at(0.3, CURRENT_MAX_A * (1.0 - 1e-12)),
                            after = at(0.3, CURRENT_MAX_A * (1 + 1e-12));
    EXPECT_NEAR(before.flux_linkage_Wb, after.flux_linkage_Wb, 1e-11);
    EXPECT_NEAR(before.incremental_inductance_H, after.incremental_inductance_H, 1e-12);
    EXPECT_NEAR(before.torque_Nm, after.torque_Nm, 1e-9);
    EXPECT_NEAR(before.torque_gradient_Nm_rad, after.torque_gradient_Nm_rad, 1e-8);
}

TEST_F(FluxMap, PreparesTheScalesOfTheStepLimits) {
    EXPECT_EQ(model.inductance_min_H, 1e-4);
    EXPECT_EQ(model.saturation_A, 25.0);
    EXPECT_EQ(model.unaligned_inductance_H, 2.4e-3);
    EXPECT_TRUE(std::isinf(magnetics_smooth_distance_rad(&model, 0.1, 1.0)));
}

TEST_F(FluxMap, IsFiniteAndReadsOnlyItsCoefficientsAtAnyPoint) {
    for (const double angle_rad : {0.0, 1e9, -1e9, HALF_RAD, -HALF_RAD}) {
        for (const double current_A : {-1e9, 1e9, -5.0, CURRENT_MAX_A}) {
            EXPECT_TRUE(std::isfinite(at(angle_rad, current_A).torque_Nm)); // sanitizers detect reads beyond the table
        }
    }
}

} // namespace
