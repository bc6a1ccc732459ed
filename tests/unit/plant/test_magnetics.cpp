#include <gtest/gtest.h>

#include <cmath>

#include "support/emulator_machines.h"

extern "C" {
#include "plant/exponential.h"
#include "plant/magnetics_kernel.h"
}

namespace {

constexpr double RAD_PER_DEG = M_PI / 180.0;

class Magnetics : public testing::TestWithParam<magnetics_form_t> {
  protected:
    Magnetics() : machine(machine_of(GetParam())) { magnetics_prepare(&model, &machine.magnetics, 4); }

    magnetics_point_t at(double angle_deg, double current_A) const {
        magnetics_point_t point;
        magnetics_evaluate(&model, angle_deg * RAD_PER_DEG, current_A, &point);
        return point;
    }

    const machine_t machine;
    magnetics_model_t model;
};

INSTANTIATE_TEST_SUITE_P(Forms, Magnetics,
                         testing::Values(MAGNETICS_LINEAR_COSINE, MAGNETICS_LINEAR_TRAPEZOID, MAGNETICS_SATURATING),
                         [](const auto &form) { return form_name(form.param); });

// Angles farther from the corners of the trapezoid than the step of the difference quotients.
constexpr double ANGLES_DEG[] = {-200.3, -46.1, -20.0, -0.4, 0.6, 2.2, 10.0, 31.7, 42.9, 44.7, 45.3, 60.0, 88.5, 130.0};
constexpr double CURRENTS_A[] = {0.01, 1.0, 7.3, 20.0, 50.0, 79.9, 127.0, 129.0, 300.0};

TEST_P(Magnetics, DerivativesMatchDifferenceQuotients) {
    for (const double angle_deg : ANGLES_DEG) {
        for (const double current_A : CURRENTS_A) {
            SCOPED_TRACE(testing::Message() << angle_deg << " deg, " << current_A << " A");
            const magnetics_point_t point = at(angle_deg, current_A);
            const double turned_deg = 1e-4, more_A = 1e-3;
            const double angle_rad = angle_deg * RAD_PER_DEG, turned_rad = turned_deg * RAD_PER_DEG;
            const auto coenergy_J = [&](double turn_rad, double extra_A) {
                return magnetics_coenergy_J(&model, angle_rad + turn_rad, current_A + extra_A);
            };
            EXPECT_NEAR((at(angle_deg, current_A + more_A).flux_linkage_Wb -
                         at(angle_deg, current_A - more_A).flux_linkage_Wb) /
                            (2.0 * more_A),
                        point.incremental_inductance_H, 2e-8 * 23.6e-3);
            EXPECT_NEAR((at(angle_deg + turned_deg, current_A).flux_linkage_Wb -
                         at(angle_deg - turned_deg, current_A).flux_linkage_Wb) /
                            (2.0 * turned_rad),
                        point.flux_gradient_Wb_rad, 1e-8 * (1.0 + current_A));
            EXPECT_NEAR((coenergy_J(turned_rad, 0.0) - coenergy_J(-turned_rad, 0.0)) / (2.0 * turned_rad),
                        point.torque_Nm, 1e-8 * (1.0 + current_A * current_A));
            EXPECT_NEAR((coenergy_J(0.0, more_A) - coenergy_J(0.0, -more_A)) / (2.0 * more_A), point.flux_linkage_Wb,
                        1e-9 + 1e-8 * point.flux_linkage_Wb);
            EXPECT_GT(point.incremental_inductance_H, 0.0);
        }
    }
}

TEST_P(Magnetics, FieldEnergyAndCoenergyAddUpToFluxLinkageTimesCurrent) {
    for (const double angle_deg : ANGLES_DEG) {
        for (const double current_A : CURRENTS_A) {
            const double angle_rad = angle_deg * RAD_PER_DEG;
            const double product_J = at(angle_deg, current_A).flux_linkage_Wb * current_A;
            const double coenergy_J = magnetics_coenergy_J(&model, angle_rad, current_A);
            const double field_J = magnetics_field_energy_J(&model, angle_rad, current_A);
            EXPECT_NEAR(field_J + coenergy_J, product_J, 1e-14 * product_J);
            EXPECT_GT(field_J, 0.0);
            EXPECT_LE(field_J, coenergy_J * (1.0 + 1e-12)); // equal where linear
        }
    }
}

TEST_P(Magnetics, IsPeriodicInThePitchAndEvenAboutTheAlignedPosition) {
    for (const double angle_deg : ANGLES_DEG) {
        const magnetics_point_t here = at(angle_deg, 25.0), mirrored = at(-angle_deg, 25.0);
        const magnetics_point_t later = at(angle_deg + 90.0 * 1000.0, 25.0);
        EXPECT_NEAR(here.flux_linkage_Wb, later.flux_linkage_Wb, 1e-11);
        EXPECT_NEAR(here.torque_Nm, later.torque_Nm, 1e-9);
        EXPECT_NEAR(here.flux_linkage_Wb, mirrored.flux_linkage_Wb, 1e-14);
        EXPECT_NEAR(here.torque_Nm, -mirrored.torque_Nm, 1e-12);
    }
}

TEST_P(Magnetics, TorqueIsPositiveFromUnalignedToAlignedInForwardDirection) {
    for (double angle_deg = 46.5; angle_deg < 88.6; angle_deg += 0.5) {
        EXPECT_GT(at(angle_deg, 10.0).torque_Nm, 0.0) << angle_deg;
        EXPECT_LT(at(-angle_deg, 10.0).torque_Nm, 0.0) << angle_deg;
    }
    EXPECT_NEAR(at(0.0, 10.0).torque_Nm, 0.0, 1e-12);
    EXPECT_NEAR(at(45.0, 10.0).torque_Nm, 0.0, 1e-12);
}

TEST_P(Magnetics, HasTheInductancesOfTheMachineFileAtBothEnds) {
    EXPECT_NEAR(at(45.0, 20.0).flux_linkage_Wb, machine.magnetics.unaligned_inductance_H * 20.0, 1e-15);
    EXPECT_NEAR(at(0.0, 1e-6).flux_linkage_Wb / 1e-6, 23.6e-3, 1e-9);
}

TEST_P(Magnetics, ContinuesSmoothlyBelowZeroCurrent) {
    const magnetics_point_t zero = at(60.0, 0.0), below = at(60.0, -1e-3), far = at(60.0, -2.0);
    EXPECT_EQ(zero.flux_linkage_Wb, 0.0);
    EXPECT_NEAR(below.flux_linkage_Wb, -1e-3 * zero.incremental_inductance_H, 1e-8);
    EXPECT_LT(far.flux_linkage_Wb, below.flux_linkage_Wb);
}

TEST_P(Magnetics, SmoothDistanceReachesTheNextPointThatIsNotSmooth) {
    const auto distance_deg = [&](double angle_deg, double direction) {
        return magnetics_smooth_distance_rad(&model, angle_deg * RAD_PER_DEG, direction) / RAD_PER_DEG;
    };
    switch (GetParam()) {
    case MAGNETICS_LINEAR_COSINE:
        EXPECT_TRUE(std::isinf(distance_deg(10.0, 1.0)));
        break;
    case MAGNETICS_LINEAR_TRAPEZOID: // corners at 1, 3, 42, 44, 46, 48, 87, 89
        EXPECT_NEAR(distance_deg(0.0, 1.0), 1.0, 1e-9);
        EXPECT_NEAR(distance_deg(1.0, 1.0), 2.0, 1e-9);
        EXPECT_NEAR(distance_deg(3.0, 1.0), 39.0, 1e-9);
        EXPECT_NEAR(distance_deg(0.0, -1.0), 1.0, 1e-9);
        EXPECT_NEAR(distance_deg(45.0 + 90.0 * 7.0, -1.0), 1.0, 1e-7);
        EXPECT_NEAR(distance_deg(50.0 - 90.0 * 7.0, 1.0), 37.0, 1e-7);
        break;
    case MAGNETICS_SATURATING: // 0 and 45
        EXPECT_NEAR(distance_deg(0.0, 1.0), 45.0, 1e-9);
        EXPECT_NEAR(distance_deg(-10.0, 1.0), 10.0, 1e-9);
        EXPECT_NEAR(distance_deg(50.0, -1.0), 5.0, 1e-9);
        EXPECT_NEAR(distance_deg(45.0 - 1e-7, 1.0), 45.0, 1e-4); // nearer than the tolerance: passed
        break;
    }
}

TEST(MagneticsTrapezoid, HasNoJumpInSlopeAtTheCorners) {
    const machine_t machine = machine_of(MAGNETICS_LINEAR_TRAPEZOID);
    magnetics_model_t model;
    magnetics_prepare(&model, &machine.magnetics, 4);
    for (const double corner_deg : {1.0, 3.0, 42.0, 44.0}) {
        magnetics_point_t before, after;
        magnetics_evaluate(&model, (corner_deg - 1e-9) * RAD_PER_DEG, 10.0, &before);
        magnetics_evaluate(&model, (corner_deg + 1e-9) * RAD_PER_DEG, 10.0, &after);
        EXPECT_NEAR(before.flux_linkage_Wb, after.flux_linkage_Wb, 1e-10) << corner_deg;
        EXPECT_NEAR(before.torque_Nm, after.torque_Nm, 1e-7) << corner_deg;
    }
}

// Values of an independent model of the same machine, to all digits given.
TEST(MagneticsSaturating, MatchesAnIndependentModel) {
    const machine_t machine = machine_of(MAGNETICS_SATURATING);
    magnetics_model_t model;
    magnetics_prepare(&model, &machine.magnetics, 4);
    const auto at = [&](double angle_deg, double current_A) {
        magnetics_point_t point;
        magnetics_evaluate(&model, angle_deg * RAD_PER_DEG, current_A, &point);
        return point;
    };
    EXPECT_NEAR(at(0.0, 20.0).flux_linkage_Wb, 0.2850, 0.00005);
    EXPECT_NEAR(at(0.0, 450.0).flux_linkage_Wb, 0.4860, 0.00005);
    EXPECT_NEAR(at(67.5, 10.0).torque_Nm, 1.82, 0.005);
    EXPECT_NEAR(at(67.5, 20.0).torque_Nm, 6.17, 0.005);
    EXPECT_NEAR(at(67.5, 30.0).torque_Nm, 11.92, 0.005);
    EXPECT_NEAR(at(67.5, 50.0).torque_Nm, 25.3, 0.05);
}

TEST(MagneticsKernel, ExponentialMatchesLibm) {
    for (double x = -700.0; x <= 700.0; x += 0.0317) {
        const double expected = std::exp(x);
        ASSERT_NEAR(exponential(x), expected, 4e-16 * expected) << x;
    }
    EXPECT_EQ(exponential(0.0), 1.0);
    EXPECT_EQ(exponential(-701.0), 0.0);
}

TEST(MagneticsKernel, DecayMatchesLibmWithinAndBeyondTheTable) {
    const machine_t machine = machine_of(MAGNETICS_SATURATING);
    magnetics_model_t model;
    magnetics_prepare(&model, &machine.magnetics, 4);
    for (double current_A = -3.0; current_A < 200.0; current_A += 0.0137) {
        const double expected = std::exp(-model.saturation_1_A * current_A);
        ASSERT_NEAR(magnetics_kernel_decay(&model, current_A), expected, 2e-15 * expected) << current_A;
    }
}

TEST(MagneticsKernel, SineAndCosineMatchLibm) {
    for (double x = -M_PI; x <= M_PI; x += 0.00137) {
        double sine, cosine;
        magnetics_kernel_sine_cosine(x, &sine, &cosine);
        ASSERT_NEAR(sine, std::sin(x), 2e-15) << x;
        ASSERT_NEAR(cosine, std::cos(x), 2e-15) << x;
    }
}

} // namespace
