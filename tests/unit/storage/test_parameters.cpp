// Parameters in memory: what a start sets, what each change keeps intact, and the supply against its thresholds.
// [SR-56]
#include <cstring>
#include <utility>

#include <gtest/gtest.h>

extern "C" {
#include "control/machine_tables.h"
#include "storage/parameters.h"
}

namespace {

class StoredParameters : public testing::Test {
  protected:
    StoredParameters() {
        std::memset(&parameters, 0xA5, sizeof parameters);
        parameters_init(&parameters);
    }

    parameters_t parameters;
};

// [SR-57]
TEST_F(StoredParameters, a_start_sets_every_value_to_the_machine_s_default_whatever_was_in_memory) {
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        EXPECT_EQ(parameters.values[i], machine_tables.parameter_default[i]) << i;
        EXPECT_EQ(parameters_default(&parameters, i), machine_tables.parameter_default[i]) << i;
    }
    EXPECT_TRUE(parameters_intact(&parameters));
}

// [SR-57]
TEST_F(StoredParameters, each_change_is_one_revision_and_leaves_them_intact) {
    uint32_t revision = parameters.revision;
    const auto changed = [&](uint32_t by) {
        revision += by;
        return parameters.revision == revision && parameters_intact(&parameters);
    };
    parameters_set(&parameters, PARAMETER_OVER_SPEED_RPM, 1000);
    EXPECT_TRUE(changed(1));
    parameters_set_controller(&parameters, 1);
    EXPECT_TRUE(changed(1));
    parameters_t set = parameters;
    set.values[PARAMETER_OVER_SPEED_RPM]++;
    parameters_apply(&parameters, set.values);
    EXPECT_TRUE(changed(1));
    EXPECT_TRUE(parameters_restore(&parameters, set.values));
    EXPECT_TRUE(changed(1));
    set.values[PARAMETER_OVER_SPEED_RPM] = parameters_row(PARAMETER_OVER_SPEED_RPM)->maximum + 1;
    EXPECT_FALSE(parameters_restore(&parameters, set.values));
    EXPECT_TRUE(changed(0));
}

// [SR-57]
TEST_F(StoredParameters, every_bit_that_flips_in_a_value_the_controller_the_rate_or_the_sum_is_noticed) {
    for (unsigned i = 0; i < PARAMETER_COUNT + 3; i++) {
        for (unsigned bit = 0; bit < 32; bit++) {
            parameters_t flipped = parameters;
            const auto flip = [bit](auto &word) {
                uint32_t raw;
                std::memcpy(&raw, &word, sizeof raw);
                raw ^= UINT32_C(1) << bit;
                std::memcpy(&word, &raw, sizeof raw);
            };
            if (i < PARAMETER_COUNT) {
                flip(flipped.values[i]);
            } else if (i == PARAMETER_COUNT) {
                flip(flipped.controller_default);
            } else if (i == PARAMETER_COUNT + 1) {
                flip(flipped.control_rate_hz);
            } else {
                flip(flipped.sum);
            }
            EXPECT_FALSE(parameters_intact(&flipped)) << i << ", " << bit;
        }
    }
    const parameters_t cleared{};
    EXPECT_FALSE(parameters_intact(&cleared));
}

// [SR-57]
TEST_F(StoredParameters, a_value_beyond_its_limits_is_set_to_the_limit) {
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        const parameter_row_t *row = parameters_row(i);
        for (const auto &[value, expected] : {std::pair{INT32_MIN, row->minimum},
                                              {row->minimum, row->minimum},
                                              {row->maximum, row->maximum},
                                              {INT32_MAX, row->maximum}}) {
            parameters_set(&parameters, i, value);
            EXPECT_EQ(parameters.values[i], expected) << i;
        }
    }
}

// Thresholds between which the supply is, up to both of them, may not change so that it would fail; without a supply
// within the present ones nothing is said.
TEST_F(StoredParameters, thresholds_that_the_present_supply_would_fail_are_refused_when_it_passes_the_present_ones) {
    const int32_t under = parameters.values[PARAMETER_UNDER_VOLTAGE_V];
    const int32_t over = parameters.values[PARAMETER_OVER_VOLTAGE_V];
    const struct {
        int32_t supply, under, over;
        unsigned refused; // PARAMETER_COUNT: not
    } cases[] = {
        {under, under + 1, over, PARAMETER_UNDER_VOLTAGE_V},
        {under, under, over, PARAMETER_COUNT},
        {under - 1, under + 1, over, PARAMETER_COUNT},
        {over, under, over - 1, PARAMETER_OVER_VOLTAGE_V},
        {over, under, over, PARAMETER_COUNT},
        {over + 1, under, over - 1, PARAMETER_COUNT},
        {0, under + 1, over - 1, PARAMETER_COUNT},
        {under + 1, under + 1, over, PARAMETER_COUNT},
        {over - 1, under, over - 1, PARAMETER_COUNT},
    };
    for (const auto &one : cases) {
        parameters_t set = parameters;
        set.values[PARAMETER_UNDER_VOLTAGE_V] = one.under;
        set.values[PARAMETER_OVER_VOLTAGE_V] = one.over;
        const parameters_conditions_t conditions = {false, one.supply};
        const parameters_verdict_t verdict = parameters_check(&parameters, set.values, UINT64_MAX, &conditions);
        const bool refused = one.refused != PARAMETER_COUNT;
        EXPECT_EQ(verdict.status, refused ? PARAMETER_STATUS_EXCLUDES_SUPPLY : PARAMETER_STATUS_DONE) << one.supply;
        EXPECT_EQ(verdict.index, refused ? one.refused : 0u) << one.supply;
        EXPECT_EQ(verdict.other, 0u) << one.supply;
    }
}

TEST_F(StoredParameters, in_a_run_the_first_written_parameter_that_is_not_tunable_is_named_and_no_other) {
    const parameters_conditions_t running = {true, 0};
    for (unsigned i = 0; i < 64; i++) { // bits of the mask; the later ones are tunable
        const uint64_t later = i + 1 < 64 ? UINT64_MAX << (i + 1) : 0;
        for (const uint64_t more : {uint64_t(0), later}) {
            const parameters_verdict_t verdict =
                parameters_check(&parameters, parameters.values, UINT64_C(1) << i | more, &running);
            unsigned named = i;
            while (named < PARAMETER_COUNT && ((named > i && more == 0) || parameters_tunable(named))) {
                named++;
            }
            const bool refused = named < PARAMETER_COUNT;
            EXPECT_EQ(verdict.status, refused ? PARAMETER_STATUS_NOT_WHILE_RUNNING : PARAMETER_STATUS_DONE) << i;
            EXPECT_EQ(verdict.index, refused ? named : 0) << i;
            EXPECT_EQ(verdict.other, 0) << i;
        }
    }
}

} // namespace
