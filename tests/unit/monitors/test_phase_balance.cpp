// Balance of the phases: which differences of one phase from the others are its sensor's. [SR-28]
#include <cstdint>
#include <utility>

#include <gtest/gtest.h>

extern "C" {
#include "control/applied_flux.h"
#include "control/machine_tables.h"
#include "monitors/flux_monitor.h"
#include "storage/fault.h"
}

namespace {

constexpr int32_t TABLE_Q29 = 1 << 27;
constexpr uint32_t PERIODS_PER_REVOLUTION = 1000; // 25 ms at 40 kHz

class PhaseBalance : public testing::Test {
  protected:
    void SetUp() override {
        residual.sample.run = true;
        residual.phases = 3;
        residual.elapsed = 1;
        residual.sample.periods_per_ms = 40;
    }

    uint32_t verdict(const flux_evidence_t &evidence) const {
        return uint32_t(FAULT_BIT(flux_monitor_verdict(&evidence, balance.unbalanced))) & ~1u;
    }

    // Eight electrical revolutions in each of which the phases conduct for a third, one after another.
    uint32_t window(uint32_t periods = PERIODS_PER_REVOLUTION) {
        residual.step = direction * (int32_t((int64_t(1) << 32) / periods) + 1);
        flux_evidence_t evidence{};
        for (uint32_t k = 0; k < 8 * periods; k++) {
            for (unsigned phase = 0; phase < residual.phases; phase++) {
                const bool conducts = k % periods * residual.phases / periods == phase && phase != silent;
                flux_residual_phase_t &one = residual.phase[phase];
                one.known = conducts && (phase != brief || k % periods % 16 == 0);
                one.current_q9 = 20 * 512;
                one.table_q29 = table_q29;
                one.voltage_q29 = int32_t(table_q29 * ratio[phase]);
            }
            evidence = {};
            phase_balance_step(&balance, &residual, PHASE_BALANCE_LEAST_Q8, &evidence);
        }
        return verdict(evidence);
    }

    phase_balance_t balance{};
    flux_residual_t residual{};
    unsigned silent = HAL_PHASES_MAX; // phase without current
    unsigned brief = HAL_PHASES_MAX;  // phase that conducts for a sixteenth of its third
    int32_t direction = 1, table_q29 = TABLE_Q29;
    double ratio[HAL_PHASES_MAX] = {1.0, 1.0, 1.0, 1.0};
};

TEST_F(PhaseBalance, a_phase_beyond_four_thirds_or_three_quarters_of_all_others_has_a_wrong_sensor) {
    for (unsigned phase = 0; phase < 3; phase++) {
        for (const double wrong : {1.36, 0.73}) {
            ratio[phase] = wrong;
            EXPECT_EQ(window(), FAULT_BIT(FAULT_CURRENT_SENSOR)) << phase << " " << wrong;
            EXPECT_EQ(balance.unbalanced, 1u << phase);
            balance = {};
        }
        ratio[phase] = 1.0;
    }
}

// [SR-28] [SR-30]
TEST_F(PhaseBalance, a_phase_within_four_thirds_and_three_quarters_is_none) {
    for (const double within : {1.31, 0.77}) {
        ratio[1] = within;
        EXPECT_EQ(window(), 0u) << within;
        balance = {};
    }
}

TEST_F(PhaseBalance, a_large_error_of_one_phase_accuses_no_other) {
    ratio[2] = 3.0;
    EXPECT_EQ(window(), FAULT_BIT(FAULT_CURRENT_SENSOR));
    EXPECT_EQ(balance.unbalanced, 4u);
}

// [SR-28] [SR-30]
TEST_F(PhaseBalance, ratios_that_all_phases_have_are_no_sensor_s) {
    for (const double common : {0.77, 1.3, 1.7}) {
        ratio[0] = ratio[1] = ratio[2] = common;
        EXPECT_EQ(window(), 0u) << common;
        EXPECT_EQ(window(), 0u) << common;
        balance = {};
    }
}

TEST_F(PhaseBalance, a_small_ratio_of_all_is_the_encoder_s_after_two_windows) {
    ratio[0] = ratio[1] = ratio[2] = 0.74;
    EXPECT_EQ(window(), 0u);
    EXPECT_EQ(window(), FAULT_BIT(FAULT_ENCODER_ANGLE));
    EXPECT_EQ(balance.unbalanced, 0u);
}

TEST_F(PhaseBalance, what_a_cold_winding_would_explain_in_a_window_excuses_none_of_the_next) {
    ratio[0] = ratio[1] = ratio[2] = 0.74;
    for (unsigned phase = 0; phase < 3; phase++) {
        residual.phase[phase].drop_q29 = TABLE_Q29 / 2; // 0.15 of the flux linkage by a cold winding
    }
    EXPECT_EQ(window(), 0u);
    EXPECT_EQ(window(), 0u);
    for (unsigned phase = 0; phase < 3; phase++) {
        residual.phase[phase].drop_q29 = 0;
    }
    EXPECT_EQ(window(), 0u);
    EXPECT_EQ(window(), FAULT_BIT(FAULT_ENCODER_ANGLE));
}

// [SR-28] [SR-30]
TEST_F(PhaseBalance, revolutions_beyond_100_ms_show_nothing) {
    ratio[1] = 1.5;
    EXPECT_EQ(window(4004), 0u);
    EXPECT_EQ(window(3990), FAULT_BIT(FAULT_CURRENT_SENSOR));
}

// [SR-28] [SR-30]
TEST_F(PhaseBalance, nothing_is_judged_while_a_phase_does_not_conduct) {
    ratio[1] = 1.5;
    silent = 2;
    EXPECT_EQ(window(), 0u);
}

TEST_F(PhaseBalance, a_phase_that_has_hardly_conducted_is_not_judged_whatever_it_did_in_the_window_before) {
    EXPECT_EQ(window(), 0u);
    ratio[1] = 1.5;
    brief = 1;
    EXPECT_EQ(window(), 0u);
    EXPECT_EQ(window(), 0u);
    brief = HAL_PHASES_MAX;
    EXPECT_EQ(window(), FAULT_BIT(FAULT_CURRENT_SENSOR));
}

TEST_F(PhaseBalance, without_a_lost_phase_the_others_are_judged_if_there_are_three) {
    residual.phases = 4;
    for (const unsigned absent : {0u, 2u, 3u}) {
        silent = absent;
        residual.sample.lost_phases = 1u << absent;
        for (const auto &[wrong, failed] :
             {std::pair{1.36, FAULT_BIT(FAULT_CURRENT_SENSOR)}, std::pair{0.73, FAULT_BIT(FAULT_CURRENT_SENSOR)},
              std::pair{1.3, uint64_t(0)}}) {
            ratio[1] = wrong;
            EXPECT_EQ(window(), failed) << absent << " " << wrong;
            EXPECT_EQ(balance.unbalanced, failed != 0 ? 2u : 0u);
            balance = {};
        }
        ratio[1] = 1.0;
    }
}

TEST_F(PhaseBalance, of_two_phases_that_are_left_neither_is_accused_of_a_difference_but_the_encoder_of_what_both_have) {
    silent = 1;
    residual.sample.lost_phases = 2u;
    for (const double wrong : {3.0, 0.4}) {
        ratio[2] = wrong;
        EXPECT_EQ(window(), 0u) << wrong;
        EXPECT_EQ(window(), 0u) << wrong;
        balance = {};
    }
    ratio[0] = ratio[2] = 0.74;
    EXPECT_EQ(window(), 0u);
    EXPECT_EQ(window(), FAULT_BIT(FAULT_ENCODER_ANGLE));
    EXPECT_EQ(balance.unbalanced, 0u);
}

TEST_F(PhaseBalance, a_failed_check_remains_until_the_end_of_the_run) {
    ratio[1] = 1.5;
    ASSERT_EQ(window(), FAULT_BIT(FAULT_CURRENT_SENSOR));
    ratio[1] = 1.0;
    EXPECT_EQ(window(), FAULT_BIT(FAULT_CURRENT_SENSOR));
    residual.sample.run = false;
    flux_evidence_t evidence{};
    phase_balance_step(&balance, &residual, PHASE_BALANCE_LEAST_Q8, &evidence);
    EXPECT_EQ(verdict(evidence), 0u);
}

TEST_F(PhaseBalance, a_rotor_that_turns_backwards_is_judged_as_one_that_turns_forwards) {
    direction = -1;
    ratio[1] = 1.36;
    EXPECT_EQ(window(), FAULT_BIT(FAULT_CURRENT_SENSOR));
}

TEST_F(PhaseBalance, a_ratio_beyond_256_is_too_large_and_not_a_small_one) {
    table_q29 = 1 << 16; // the voltage may exceed it by far
    ratio[1] = 257.0;    // 1 modulo 256
    EXPECT_EQ(window(), FAULT_BIT(FAULT_CURRENT_SENSOR));
    EXPECT_EQ(balance.unbalanced, 2u);
}

TEST_F(PhaseBalance, a_sample_counts_up_to_10_ms_after_the_phase_was_without_current) {
    ratio[1] = 1.36;
    for (const auto &[age, counted] : {std::pair{396u, true}, std::pair{404u, false}}) {
        residual.sample.periods = age;
        EXPECT_EQ(window(), counted ? FAULT_BIT(FAULT_CURRENT_SENSOR) : 0u) << age;
        balance = {};
    }
}

// In 7.5 ms: 1/64 of the DC-link voltage or the threshold of the devices, whichever is more, and a warm winding.
TEST_F(PhaseBalance, a_sample_counts_while_what_may_be_drift_is_less_than_half_of_the_flux_linkage) {
    ratio[1] = 1.36;
    residual.sample.periods = 300;
    const double half_q29 = TABLE_Q29 / 2.0;
    for (const auto &[part, counted] : {std::pair{0.995, true}, std::pair{1.005, false}}) {
        residual.sample.period_flux_q29 = int32_t(part * half_q29 / 300.0 * 64.0);
        EXPECT_EQ(window() != 0, counted) << part;
        balance = {};
        residual.sample.period_flux_q29 /= 2;
        residual.device_q29 = int32_t(part * half_q29 / 300.0);
        EXPECT_EQ(window() != 0, counted) << part;
        balance = {};
        residual.sample.period_flux_q29 = residual.device_q29 = 0;
        for (flux_residual_phase_t &phase : residual.phase) {
            phase.drop_q29 = int32_t(part * half_q29 * 1.0);
            while (applied_flux_warm_q29(&machine_tables, phase.drop_q29) < part * half_q29) {
                phase.drop_q29 += TABLE_Q29 / 4096;
            }
            phase.drop_q29 -= counted ? TABLE_Q29 / 4096 : 0;
        }
        EXPECT_EQ(window() != 0, counted) << part;
        balance = {};
        for (flux_residual_phase_t &phase : residual.phase) {
            phase.drop_q29 = 0;
        }
    }
}

} // namespace
