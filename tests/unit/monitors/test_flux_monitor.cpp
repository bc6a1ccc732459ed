// The table of verdicts: precedence, and what each row needs. [SR-29]
#include <algorithm>
#include <cstdint>
#include <functional>
#include <iterator>
#include <random>
#include <vector>

#include <gtest/gtest.h>

extern "C" {
#include "monitors/flux_monitor.h"
}

namespace {

struct Row {
    fault_t fault;
    const char *text;
    std::function<bool(const flux_evidence_t *e, uint32_t open, uint32_t shorted, uint32_t phase, uint32_t others)>
        holds;
};

const Row ROWS[] = {
#define FLUX_VERDICT(fault, condition, text)                                                                           \
    {FAULT_##fault, text,                                                                                              \
     []([[maybe_unused]] const flux_evidence_t *e, [[maybe_unused]] uint32_t open, [[maybe_unused]] uint32_t shorted,  \
        [[maybe_unused]] uint32_t phase, [[maybe_unused]] uint32_t others) { return bool(condition); }},
#include "monitors/flux_verdict.def"
#undef FLUX_VERDICT
};

// The first row that holds; -1: none.
int first_row(const flux_evidence_t &e, uint32_t phases) {
    const uint32_t open = e.too_little | e.too_little_at_angle, shorted = e.excess_moves | e.too_much_at_angle;
    const uint32_t phase = open | shorted | e.excess_still | e.unbalanced;
    for (unsigned row = 0; row < std::size(ROWS); row++) {
        if (ROWS[row].holds(&e, open, shorted, phase, e.contradicts & ~phases)) {
            return int(row);
        }
    }
    return -1;
}

TEST(FluxMonitor, the_verdict_is_the_first_row_that_holds_and_each_row_is_the_first_one_of_some_evidence) {
    std::mt19937 random(1);
    const auto mask = [&] { return random() % 4 == 0 ? random() & 7u : 0u; };
    const auto flag = [&] { return random() % 8 == 0; };
    std::vector<int> first(std::size(ROWS));
    for (int k = 0; k < 20000; k++) {
        flux_evidence_t e{};
        for (uint32_t *member :
             {&e.too_little, &e.too_little_at_angle, &e.too_much_at_angle, &e.missing, &e.excess_moves, &e.excess_still,
              &e.excess_by_tables, &e.unbalanced, &e.contradicts}) {
            *member = mask();
        }
        e.excess = e.excess_moves | e.excess_still | e.excess_by_tables | mask();
        e.parted = flag();
        e.turned_round = flag();
        e.contradicts_alone = flag();
        e.all_small = flag();
        const uint32_t phases = mask();
        const int row = first_row(e, phases);
        ASSERT_EQ(flux_monitor_verdict(&e, phases), row < 0 ? FAULT_NONE : ROWS[row].fault) << k;
        if (row >= 0) {
            first[unsigned(row)]++;
        }
    }
    for (unsigned row = 0; row < std::size(ROWS); row++) {
        EXPECT_GT(first[row], 10) << ROWS[row].text;
    }
}

TEST(FluxMonitor, nothing_is_the_verdict_without_evidence) {
    const flux_evidence_t none{};
    EXPECT_EQ(flux_monitor_verdict(&none, 0), FAULT_NONE);
}

// [SR-23] [SR-29]
TEST(FluxMonitor, a_fault_of_a_phase_is_the_encoder_s_while_another_contradicts_the_angle_or_it_turns_round) {
    struct {
        uint32_t contradicts, phases;
        bool turned_round;
        fault_t fault;
    } const cases[] = {{0, 1, false, FAULT_PHASE_OPEN},
                       {1, 1, false, FAULT_PHASE_OPEN},
                       {2, 1, false, FAULT_ENCODER_ANGLE},
                       {2, 3, false, FAULT_PHASE_OPEN},
                       {0, 1, true, FAULT_ENCODER_ANGLE}};
    for (const auto &one : cases) {
        flux_evidence_t evidence{};
        evidence.too_little = 1;
        evidence.contradicts = one.contradicts;
        evidence.turned_round = one.turned_round;
        EXPECT_EQ(flux_monitor_verdict(&evidence, one.phases), one.fault) << one.contradicts << " " << one.phases;
    }
}

TEST(FluxMonitor, a_current_that_one_phase_lacks_and_another_has_is_a_sensor_s) {
    flux_evidence_t evidence{};
    evidence.too_little = 1;
    EXPECT_EQ(flux_monitor_verdict(&evidence, 1), FAULT_PHASE_OPEN);
    evidence.excess = 2;
    EXPECT_EQ(flux_monitor_verdict(&evidence, 1), FAULT_CURRENT_SENSOR);
    evidence = {};
    evidence.excess = evidence.excess_moves = 2;
    EXPECT_EQ(flux_monitor_verdict(&evidence, 2), FAULT_PHASE_SHORTED);
    evidence.missing = 2;
    EXPECT_EQ(flux_monitor_verdict(&evidence, 2), FAULT_PHASE_SHORTED) << "of the same phase";
    evidence.missing = 1;
    EXPECT_EQ(flux_monitor_verdict(&evidence, 2), FAULT_CURRENT_SENSOR);
}

// State that a run leaves in the monitor, and samples in which the drive is at rest.
class FluxMonitorState : public testing::Test {
  protected:
    uint32_t step(bool run) {
        flux_sample_t sample{};
        sample.run = run;
        sample.periods = ++period;
        sample.periods_per_ms = 40;
        sample.period_flux_q29 = 1 << 20;
        for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
            sample.off[phase] = true;
            sample.current_q9[phase] = current_q9[phase];
        }
        return flux_monitor_step(&parameters, &monitor, &sample);
    }

    flux_monitor_parameters_t parameters = {.angle = {.rate_hz = 40000}, .encoder = {.rate_hz = 40000}, .least_q8 = 0};
    flux_monitor_t monitor{};
    uint32_t period = 0;
    int32_t current_q9[HAL_PHASES_MAX] = {};
};

TEST_F(FluxMonitorState, a_check_that_has_failed_in_a_run_remains_failed_until_the_run_ends) {
    step(true);
    monitor.balance.unbalanced = 2u;
    const uint32_t failed = uint32_t(FAULT_BIT(FAULT_CURRENT_SENSOR));
    EXPECT_EQ(step(true), failed);
    monitor.balance.unbalanced = 0;
    EXPECT_EQ(step(true), failed);
    EXPECT_EQ(step(false), 0u);
    EXPECT_EQ(step(true), 0u);
}

// [SR-31]
TEST_F(FluxMonitorState, a_phase_that_has_been_accepted_as_lost_leaves_no_failed_check) {
    step(true);
    monitor.balance.unbalanced = 2u;
    ASSERT_NE(step(true), 0u);
    flux_monitor_forget(&monitor);
    EXPECT_EQ(monitor.failed, 0u) << "until the next sample, too";
    EXPECT_EQ(step(true), 0u);
}

// [SR-31]
TEST_F(FluxMonitorState, what_has_begun_in_a_phase_before_it_was_accepted_as_lost_does_not_end_in_a_fault) {
    step(true);
    const phase_evidence_phase_t begun = {.excess_periods = 20, .turned = 1 << 26, .open_samples = 1};
    monitor.phases_by_current.phase[1] = begun;
    monitor.phases_by_current.doubted = 2u;
    flux_monitor_forget(&monitor);
    EXPECT_EQ(step(true), 0u) << "an excess that lasted half a millisecond when it ended would be a fault";
    EXPECT_EQ(monitor.phases_by_current.doubted, 0u);
    for (const phase_evidence_phase_t &phase : monitor.phases_by_current.phase) {
        EXPECT_EQ(phase.excess_periods, 0u);
        EXPECT_EQ(phase.open_samples, 0u);
        EXPECT_EQ(phase.turned, 0);
    }
}

TEST_F(FluxMonitorState, phases_with_evidence_of_a_fault_are_those_of_this_run_or_the_last) {
    step(true);
    monitor.balance.unbalanced = 2u;
    step(true);
    monitor.balance.unbalanced = 0;
    EXPECT_EQ(monitor.phases, 2u);
    step(true);
    step(false);
    EXPECT_EQ(monitor.phases, 2u) << "for the record, after the run";
    step(true);
    EXPECT_EQ(monitor.phases, 0u);
}

// Phases with evidence of a fault, when a sample has evidence of one phase and a current that others have or lack.
class FluxMonitorPhases : public FluxMonitorState {
  protected:
    struct Evidence {
        uint32_t open = 0, shorted = 0, excess = 0, missing = 0; // bits of phases; open or shorted: one phase
    };

    uint32_t phases_with(const Evidence &evidence) {
        monitor = {};
        period = 10000;
        for (int k = 0; k < 5; k++) {
            step(true);
        }
        phase_evidence_t &state = monitor.phases_by_current;
        state.doubted = evidence.open | evidence.shorted; // for long enough, all others agree
        state.doubted_side = evidence.open != 0 ? 1 : -1;
        state.doubted_at = 0;
        state.doubt_turned_q24 = 1 << 24;
        state.agreed = 7u;
        for (unsigned phase = 0; phase < 3; phase++) {
            current_q9[phase] = (evidence.excess >> phase & 1u) != 0 ? 5 * 512 : 0;
            state.phase[phase].vanished = (evidence.missing >> phase & 1u) != 0;
            state.phase[phase].vanished_at = period;
        }
        step(true);
        std::fill_n(current_q9, 3, 0);
        return monitor.phases;
    }
};

TEST_F(FluxMonitorPhases, a_current_that_an_open_phase_may_lack_makes_the_phase_that_has_it_suspect) {
    EXPECT_EQ(phases_with({.open = 1}), 1u);
    EXPECT_EQ(phases_with({.excess = 2}), 0u) << "it has lasted for one sample";
    EXPECT_EQ(phases_with({.open = 1, .excess = 2}), 3u);
    EXPECT_EQ(phases_with({.open = 4, .excess = 1}), 5u);
    EXPECT_EQ(phases_with({.open = 1, .excess = 6}), 7u);
    EXPECT_EQ(phases_with({.open = 1, .missing = 4}), 1u) << "what is missing is found in no other";
    EXPECT_EQ(phases_with({.open = 1, .excess = 2, .missing = 4}), 7u);
    EXPECT_EQ(phases_with({.open = 1, .excess = 2, .missing = 6}), 3u) << "two lack it: either may";
}

TEST_F(FluxMonitorPhases, a_current_that_is_missing_makes_its_phase_suspect_when_another_is_shorted) {
    for (unsigned shorted = 0; shorted < 3; shorted++) {
        EXPECT_EQ(phases_with({.shorted = 1u << shorted}), 1u << shorted);
        for (unsigned missing = 0; missing < 3; missing++) {
            EXPECT_EQ(phases_with({.missing = 1u << missing}), 0u) << missing;
            EXPECT_EQ(phases_with({.shorted = 1u << shorted, .missing = 1u << missing}), 1u << shorted | 1u << missing);
            if (missing != shorted) {
                EXPECT_EQ(phases_with({.shorted = 1u << shorted, .excess = 1u << missing, .missing = 1u << missing}),
                          1u << shorted)
                    << "of the phase that has it";
            }
        }
        EXPECT_EQ(phases_with({.shorted = 1u << shorted, .missing = 7u & ~(1u << shorted)}), 1u << shorted)
            << "two lack it: either may";
    }
}

} // namespace
