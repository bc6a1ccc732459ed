// Integral of the voltage against the tables: what a sample leaves in the residual. Machine: saturating, 40 kHz, 240 V.
#include <algorithm>
#include <cstdint>
#include <utility>

#include "support/flux_samples.h"

namespace {

class FluxResidual : public FluxSamples {
  protected:
    void step() {
        input.periods++;
        ASSERT_TRUE(flux_residual_step(&residual, &input));
        flux_residual_follow(&residual, correction_q29);
    }

    flux_residual_t residual{};
};

TEST_F(FluxResidual, the_resistive_drop_is_summed_from_zero_to_zero_current) {
    input.resistance_period_q40 = int32_t(2.0 * 25e-6 * 0x1p40);
    input.electrical = MIDDLE;
    for (int k = 0; k < 40; k++) {
        set(0, 10.0, table_Wb(10.0));
        step();
    }
    EXPECT_NEAR(residual.phase[0].drop_q29 / Q29, 40 * 20.0 * 25e-6, 1e-6);
    EXPECT_LT(residual.phase[0].followed_drop_q29, residual.phase[0].drop_q29);
    EXPECT_GT(residual.phase[0].followed_drop_q29, residual.phase[0].drop_q29 / 10 * 9) << "a tenth of 10 ms";
    input.periods += 2;
    step();
    EXPECT_NEAR(residual.phase[0].drop_q29 / Q29, 43 * 20.0 * 25e-6, 1e-6);
    input.current_q9[0] = 0;
    input.off[0] = true;
    step();
    EXPECT_EQ(residual.phase[0].drop_q29, 0);
    EXPECT_EQ(residual.phase[0].followed_drop_q29, 0);
}

TEST_F(FluxResidual, psi_by_voltage_is_that_which_follows_less_its_corrections_since_the_last_zero) {
    step();
    input.electrical = MIDDLE;
    double corrections_Wb = 0.0;
    for (int k = 0; k < 40; k++) {
        set(0, 10.0, 0.8 * table_Wb(10.0));
        step();
        EXPECT_NEAR(residual.phase[0].voltage_q29 / Q29, 0.8 * table_Wb(10.0) - corrections_Wb, 1e-6) << k;
        corrections_Wb += correction_q29[0] / Q29;
    }
    EXPECT_GT(corrections_Wb, 0.01 * table_Wb(10.0));
    EXPECT_TRUE(residual.phase[0].known);
    input.current_q9[0] = 0;
    input.off[0] = true;
    step();
    EXPECT_EQ(residual.phase[0].followed_q29, 0);
    EXPECT_EQ(residual.phase[0].zero_at, input.periods);
}

TEST_F(FluxResidual, psi_by_voltage_is_unknown_from_a_lost_trigger_to_the_next_zero) {
    input.electrical = MIDDLE;
    const auto conduct = [&] {
        for (int k = 0; k < 10; k++) {
            set(0, 10.0, table_Wb(10.0));
            step();
        }
    };
    input.off[0] = true;
    step();
    conduct();
    EXPECT_TRUE(residual.phase[0].known);
    input.late_interrupts++;
    conduct();
    EXPECT_FALSE(residual.phase[0].known);
    set(0, 0.0, 0.0);
    input.off[0] = true;
    step();
    conduct();
    EXPECT_TRUE(residual.phase[0].known);
}

TEST_F(FluxResidual, psi_by_voltage_is_unknown_while_an_integral_is_saturated_and_known_just_below_that) {
    input.electrical = MIDDLE;
    step();
    for (const auto &[followed_q29, known] : {std::pair{INT32_MAX, false},
                                              {-INT32_MAX, false},
                                              {INT32_MAX - 1, true},
                                              {-INT32_MAX + 1000, false}, // of the voltage
                                              {-(INT32_MAX / 2), true}}) {
        set(0, 10.0, table_Wb(10.0));
        residual.phase[0].followed_q29 = followed_q29;
        step();
        EXPECT_EQ(residual.phase[0].known, known) << followed_q29;
        EXPECT_EQ(residual.phase[0].voltage_q29,
                  std::min<int64_t>(int64_t(input.flux_q29[0]) - followed_q29, INT32_MAX));
    }
    set(0, 0.0, 0.0);
    input.off[0] = true;
    step();
    set(0, 10.0, table_Wb(10.0));
    step();
    EXPECT_TRUE(residual.phase[0].known) << "it has begun anew";
}

TEST_F(FluxResidual, a_phase_ends_by_the_voltage_alone_and_not_by_what_the_tables_have_taken_away) {
    for (const int32_t taken_q29 : {0, 2 * PERIOD_Q29}) {
        input.electrical = MIDDLE;
        set(0, 10.0, table_Wb(10.0));
        step();
        set(0, 5.0, 0.5 * PERIOD_Q29 / Q29);
        input.off[0] = true;
        input.next_q29[0] = 0;
        residual.phase[0].followed_q29 = -taken_q29;
        const uint32_t before = residual.phase[0].zero_at;
        step();
        EXPECT_EQ(correction_q29[0], 0);
        EXPECT_EQ(residual.phase[0].zero_at, taken_q29 == 0 ? input.periods : before);
        EXPECT_EQ(residual.phase[0].followed_q29, -taken_q29);
    }
}

TEST_F(FluxResidual, limits_of_psi_enclose_the_tables_at_every_resistance_of_a_winding) {
    constexpr double OHM = 2.0, AMPERE = 10.0, PERIOD_S = 25e-6;
    input.resistance_period_q40 = int32_t(OHM * PERIOD_S * 0x1p40);
    input.electrical = MIDDLE;
    for (const auto &[factor, within] : {std::pair{0.7, true}, {1.0, true}, {1.6, true}, {4.0, false}}) {
        residual = {};
        double error_Wb = 0.0;
        for (int k = 0; k < 120; k++) {
            set(0, AMPERE, table_Wb(AMPERE) + error_Wb);
            step();
            error_Wb += (factor - 1.0) * OHM * AMPERE * PERIOD_S + correction_q29[0] / Q29;
        }
        const int32_t table_q29 = residual.phase[0].table_q29;
        EXPECT_EQ(flux_residual_least_q29(&residual, 0) <= table_q29 &&
                      flux_residual_most_q29(&residual, 0) >= table_q29,
                  within)
            << factor;
    }
}

// The error of the voltage acts for so many periods: until the phase is at rest, at most the time constant of 10 ms.
TEST_F(FluxResidual, periods_of_the_voltage_s_error_count_up_to_10_ms_twice_with_a_small_current_and_not_at_rest) {
    const flux_residual_phase_t &phase = residual.phase[0];
    const auto conduct = [&](double current_A, int periods) {
        for (int k = 0; k < periods; k++) {
            set(0, current_A, table_Wb(current_A));
            step();
        }
        return phase.conducting;
    };
    input.electrical = MIDDLE;
    EXPECT_EQ(conduct(10.0, 100), 100u);
    EXPECT_EQ(conduct(10.0, 400), 400u) << "10 ms";
    EXPECT_EQ(conduct(1.0, 100), 600u);
    EXPECT_EQ(conduct(1.0, 400), 800u) << "twice 10 ms";
    EXPECT_EQ(conduct(10.0, 100), 600u) << "what was small has been corrected";
    EXPECT_EQ(conduct(10.0, 400), 400u);
    set(0, 0.0, 0.0);
    input.off[0] = true;
    for (int k = 0; k < 100; k++) {
        step();
    }
    EXPECT_TRUE(phase.at_rest);
    EXPECT_EQ(phase.conducting, 0u);
    EXPECT_EQ(phase.peak_q29, 0);
    EXPECT_EQ(conduct(10.0, 1), 1u);
}

// A constant error of the voltage over ten time constants, at the same current and angle.
TEST_F(FluxResidual, limits_of_psi_enclose_the_tables_with_a_voltage_that_is_off_by_a_64th_and_not_by_a_32nd) {
    input.electrical = MIDDLE;
    for (const auto &[part, within] :
         {std::pair{1.0 / 64.0, true}, {-1.0 / 64.0, true}, {1.0 / 32.0, false}, {-1.0 / 32.0, false}}) {
        residual = {};
        double error_Wb = 0.0;
        for (int k = 0; k < 4000; k++) {
            set(0, 10.0, table_Wb(10.0) + error_Wb);
            step();
            error_Wb += part * PERIOD_Q29 / Q29 + correction_q29[0] / Q29;
        }
        const int32_t table_q29 = residual.phase[0].table_q29;
        EXPECT_EQ(flux_residual_least_q29(&residual, 0) <= table_q29 &&
                      flux_residual_most_q29(&residual, 0) >= table_q29,
                  within)
            << part;
    }
}

} // namespace
