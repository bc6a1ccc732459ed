// Every state with every input, and the conditions for a restart after a fault. [SR-39]
#include <cstdint>
#include <vector>

#include <gtest/gtest.h>

extern "C" {
#include "interrupts/state_machine.h"
}

namespace {

constexpr uint32_t INITIALISE_TICKS = 5;
constexpr uint64_t TIMEOUT = FAULT_BIT(FAULT_COMMAND_TIMEOUT);
constexpr uint64_t EVERY_CHECK = FAULT_BIT(FAULT_COUNT) - FAULT_BIT(FAULT_OVER_CURRENT);
constexpr uint32_t CAUSE_GONE_TICKS = STATE_MACHINE_CAUSE_GONE_MS * INITIALISE_TICKS;
const command_request_t REQUESTS[] = {COMMAND_OFF, COMMAND_RUN, COMMAND_STOP, COMMAND_CLEAR_FAULT};

// True in the tick that latches a fault.
bool tick(state_machine_t &state_machine, const state_machine_input_t &input) {
    return !state_machine_runs(&state_machine, &input) &&
           state_machine_stands(&state_machine, input.fault_mask, input.request, INITIALISE_TICKS);
}

struct expected_t {
    drive_state_t state;
    bool latched;
};

// The diagram of state_machine.h. INITIALISE is in its last tick, and a cause has been gone for long enough.
expected_t expected(drive_state_t state, uint64_t fault_mask, command_request_t request, bool at_standstill,
                    bool rearmed) {
    const uint64_t all_but_timeout = fault_mask & ~TIMEOUT;
    rearmed = rearmed || request != COMMAND_RUN;
    switch (state) {
    case DRIVE_STATE_INITIALISE:
        return {all_but_timeout == 0 ? DRIVE_STATE_READY : DRIVE_STATE_INITIALISE, false};
    case DRIVE_STATE_READY:
        if (all_but_timeout != 0) {
            return {DRIVE_STATE_FAULT, true};
        }
        return {request == COMMAND_RUN && fault_mask == 0 && rearmed ? DRIVE_STATE_RUN : DRIVE_STATE_READY, false};
    case DRIVE_STATE_RUN:
        if (fault_mask != 0) {
            return {DRIVE_STATE_FAULT, true};
        }
        if (request == COMMAND_OFF || request == COMMAND_CLEAR_FAULT || (request == COMMAND_STOP && at_standstill)) {
            return {DRIVE_STATE_READY, false};
        }
        return {DRIVE_STATE_RUN, false};
    case DRIVE_STATE_FAULT:
    default:
        return {request == COMMAND_CLEAR_FAULT && all_but_timeout == 0 ? DRIVE_STATE_READY : DRIVE_STATE_FAULT, false};
    }
}

fault_t lowest(uint64_t fault_mask) {
    for (int fault = 0; fault < FAULT_COUNT; fault++) {
        if ((fault_mask & FAULT_BIT(fault)) != 0) {
            return fault_t(fault);
        }
    }
    return FAULT_NONE;
}

// No check, each one, every two of them, all: the transitions distinguish the command timeout alone.
std::vector<uint64_t> fault_masks() {
    std::vector<uint64_t> masks = {0, EVERY_CHECK, EVERY_CHECK & ~TIMEOUT};
    for (int one = FAULT_NONE + 1; one < FAULT_COUNT; one++) {
        for (int other = one; other < FAULT_COUNT; other++) {
            masks.push_back(FAULT_BIT(one) | FAULT_BIT(other));
        }
    }
    return masks;
}

TEST(StateMachineTable, every_state_fault_mask_request_and_flag_has_the_documented_transition) {
    for (int state = DRIVE_STATE_INITIALISE; state <= DRIVE_STATE_FAULT; state++) {
        for (const uint64_t fault_mask : fault_masks()) {
            for (const command_request_t request : REQUESTS) {
                for (const bool at_standstill : {false, true}) {
                    for (const bool rearmed : {false, true}) {
                        state_machine_t state_machine{};
                        state_machine.state = drive_state_t(state);
                        state_machine.fault_free_ticks =
                            state == DRIVE_STATE_FAULT ? CAUSE_GONE_TICKS : INITIALISE_TICKS - 1;
                        state_machine.rearmed = rearmed;
                        const fault_record_t old = {
                            .fault = FAULT_ENCODER,
                            .time_us = 1,
                            .fault_mask = FAULT_BIT(FAULT_ENCODER),
                            .speed_q22 = 2,
                            .torque_reference_q24 = 3,
                            .current_max_q9 = 4,
                            .dc_link_voltage_q6 = 5,
                            .state = 2,
                        };
                        if (state == DRIVE_STATE_FAULT) {
                            state_machine.record = old;
                        }
                        const state_machine_input_t input = {
                            .fault_mask = fault_mask, .request = request, .at_standstill = at_standstill};
                        const expected_t target =
                            expected(state_machine.state, input.fault_mask, request, at_standstill, rearmed);
                        const bool latched = tick(state_machine, input);
                        SCOPED_TRACE(testing::Message()
                                     << "state " << state << " fault_mask " << fault_mask << " request " << request
                                     << " at_standstill " << at_standstill);
                        ASSERT_EQ(state_machine.state, target.state);
                        ASSERT_EQ(latched, target.latched);
                        if (latched) {
                            const uint64_t counted = state == DRIVE_STATE_READY ? fault_mask & ~TIMEOUT : fault_mask;
                            ASSERT_EQ(state_machine.record.fault_mask, counted);
                            ASSERT_EQ(state_machine.record.fault, lowest(counted));
                            ASSERT_EQ(state_machine.record.state, state);
                            ASSERT_FALSE(state_machine.rearmed);
                        } else if (state_machine.state == DRIVE_STATE_FAULT) {
                            ASSERT_EQ(state_machine.record.fault, old.fault) << "the first fault is kept";
                            ASSERT_EQ(state_machine.record.fault_mask, old.fault_mask);
                            ASSERT_EQ(state_machine.record.time_us, old.time_us);
                        } else {
                            ASSERT_EQ(state_machine.record.fault, FAULT_NONE);
                        }
                    }
                }
            }
        }
    }
}

class StateMachine : public testing::Test {
  protected:
    StateMachine() { state_machine_reset(&state_machine); }

    drive_state_t step(command_request_t request, uint64_t fault_mask = 0, bool at_standstill = false) {
        const state_machine_input_t input = {
            .fault_mask = fault_mask, .request = request, .at_standstill = at_standstill};
        tick(state_machine, input);
        return state_machine.state;
    }

    void wait_until_the_cause_is_gone(command_request_t request = COMMAND_OFF) {
        for (uint32_t k = 0; k < CAUSE_GONE_TICKS; k++) {
            step(request);
        }
    }

    void run() {
        for (uint32_t k = 0; k < INITIALISE_TICKS; k++) {
            step(COMMAND_OFF);
        }
        ASSERT_EQ(step(COMMAND_RUN), DRIVE_STATE_RUN);
    }

    state_machine_t state_machine;
};

// [SR-43]
TEST_F(StateMachine, initialise_lasts_until_all_checks_have_passed_for_its_time_without_interruption) {
    for (uint32_t k = 0; k + 1 < INITIALISE_TICKS; k++) {
        ASSERT_EQ(step(COMMAND_OFF), DRIVE_STATE_INITIALISE);
    }
    ASSERT_EQ(step(COMMAND_OFF, FAULT_BIT(FAULT_UNDER_VOLTAGE)), DRIVE_STATE_INITIALISE);
    // No command yet: that does not delay the start.
    for (uint32_t k = 0; k + 1 < INITIALISE_TICKS; k++) {
        ASSERT_EQ(step(COMMAND_OFF, TIMEOUT), DRIVE_STATE_INITIALISE);
    }
    EXPECT_EQ(step(COMMAND_OFF, TIMEOUT), DRIVE_STATE_READY);
}

// [SR-43]
TEST_F(StateMachine, the_check_that_holds_initialise_is_known_and_none_is_afterwards) {
    const uint64_t failed = FAULT_BIT(FAULT_UNDER_VOLTAGE) | FAULT_BIT(FAULT_OVER_SPEED);
    step(COMMAND_RUN, failed | TIMEOUT);
    EXPECT_EQ(state_machine_first_fault(state_machine.start_inhibit_mask), FAULT_UNDER_VOLTAGE);
    step(COMMAND_OFF, FAULT_BIT(FAULT_OVER_SPEED));
    EXPECT_EQ(state_machine_first_fault(state_machine.start_inhibit_mask), FAULT_OVER_SPEED);
    for (uint32_t k = 0; k < INITIALISE_TICKS; k++) {
        step(COMMAND_OFF, TIMEOUT);
        EXPECT_EQ(state_machine_first_fault(state_machine.start_inhibit_mask), FAULT_NONE) << "no command is no cause";
    }
    EXPECT_EQ(step(COMMAND_OFF, failed), DRIVE_STATE_FAULT);
    EXPECT_EQ(state_machine.start_inhibit_mask, 0u) << "a fault is one by itself";
}

// [SR-42]
TEST_F(StateMachine, a_run_request_from_power_on_does_not_start_the_drive) {
    for (int k = 0; k < 100; k++) {
        ASSERT_NE(step(COMMAND_RUN), DRIVE_STATE_RUN);
    }
    EXPECT_EQ(step(COMMAND_OFF), DRIVE_STATE_READY);
    EXPECT_EQ(step(COMMAND_RUN), DRIVE_STATE_RUN);
}

TEST(StateMachineExperiments, they_begin_in_ready_alone_and_end_with_every_other_request_and_fault) {
    for (const drive_state_t state : {DRIVE_STATE_INITIALISE, DRIVE_STATE_READY, DRIVE_STATE_RUN, DRIVE_STATE_FAULT}) {
        for (const bool rearmed : {false, true}) {
            state_machine_t machine{};
            machine.state = state;
            machine.rearmed = rearmed;
            EXPECT_FALSE(tick(machine, {0, COMMAND_IDENTIFY, true}));
            EXPECT_EQ(machine.identifies, state == DRIVE_STATE_READY && rearmed) << state;
            EXPECT_EQ(machine.state == DRIVE_STATE_RUN, machine.identifies) << state;
        }
    }
    state_machine_t machine{};
    for (const command_request_t request : {COMMAND_OFF, COMMAND_STOP, COMMAND_CLEAR_FAULT}) {
        machine.state = DRIVE_STATE_READY;
        machine.rearmed = true;
        tick(machine, {0, COMMAND_IDENTIFY, true});
        ASSERT_TRUE(machine.identifies);
        tick(machine, {0, COMMAND_IDENTIFY, false});
        ASSERT_TRUE(machine.identifies);
        const state_machine_input_t goes_on = {0, COMMAND_IDENTIFY, true};
        EXPECT_FALSE(state_machine_runs(&machine, &goes_on)) << "the control laws do not run";
        tick(machine, {0, request, true});
        EXPECT_EQ(machine.state, DRIVE_STATE_READY) << request;
        EXPECT_FALSE(machine.identifies);
    }
    EXPECT_FALSE(tick(machine, {TIMEOUT, COMMAND_IDENTIFY, true}));
    EXPECT_EQ(machine.state, DRIVE_STATE_READY) << "no run begins by a command that has timed out";
    tick(machine, {0, COMMAND_IDENTIFY, true});
    EXPECT_TRUE(tick(machine, {TIMEOUT, COMMAND_IDENTIFY, true}));
    EXPECT_EQ(machine.state, DRIVE_STATE_FAULT);
    EXPECT_FALSE(machine.identifies);
    tick(machine, {0, COMMAND_IDENTIFY, true});
    EXPECT_FALSE(machine.rearmed) << "a request that persists does not begin again";
}

// [SR-05] [SR-39]
TEST_F(StateMachine, a_command_timeout_is_a_fault_in_run_only) {
    for (uint32_t k = 0; k < INITIALISE_TICKS; k++) {
        step(COMMAND_OFF, TIMEOUT);
    }
    EXPECT_EQ(step(COMMAND_OFF, TIMEOUT), DRIVE_STATE_READY);
    EXPECT_EQ(step(COMMAND_RUN, TIMEOUT), DRIVE_STATE_READY) << "an expired run request starts nothing";
    EXPECT_EQ(step(COMMAND_RUN), DRIVE_STATE_RUN);
    EXPECT_EQ(step(COMMAND_RUN, TIMEOUT), DRIVE_STATE_FAULT);
    EXPECT_EQ(state_machine.record.fault, FAULT_COMMAND_TIMEOUT);
}

// [SR-40]
TEST(StateMachineTable, the_first_fault_of_a_mask_is_the_lowest_bit_of_all_64) {
    EXPECT_EQ(state_machine_first_fault(0), FAULT_NONE);
    for (unsigned bit = 0; bit < 64; bit++) {
        EXPECT_EQ(unsigned(state_machine_first_fault(UINT64_MAX << bit)), bit);
    }
}

// [SR-40]
TEST_F(StateMachine, the_record_keeps_the_first_fault) {
    run();
    step(COMMAND_RUN, FAULT_BIT(FAULT_OVER_SPEED) | FAULT_BIT(FAULT_ENCODER));
    step(COMMAND_RUN, FAULT_BIT(FAULT_OVER_CURRENT));
    step(COMMAND_CLEAR_FAULT, FAULT_BIT(FAULT_OVER_CURRENT));
    EXPECT_EQ(state_machine.state, DRIVE_STATE_FAULT) << "the cause persists";
    EXPECT_EQ(state_machine.record.fault, FAULT_OVER_SPEED);
    EXPECT_EQ(state_machine.record.fault_mask, FAULT_BIT(FAULT_OVER_SPEED) | FAULT_BIT(FAULT_ENCODER));
    EXPECT_EQ(state_machine.record.state, DRIVE_STATE_RUN);
    wait_until_the_cause_is_gone();
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_READY);
    EXPECT_EQ(state_machine.record.fault, FAULT_NONE);
}

// [SR-42]
TEST_F(StateMachine, after_a_fault_the_run_request_must_be_withdrawn_before_a_restart) {
    run();
    step(COMMAND_RUN, FAULT_BIT(FAULT_OVER_VOLTAGE));
    for (int k = 0; k < 100; k++) {
        ASSERT_EQ(step(COMMAND_RUN), DRIVE_STATE_FAULT) << "a run request clears no fault";
    }
    EXPECT_EQ(step(COMMAND_OFF), DRIVE_STATE_FAULT);
    EXPECT_EQ(step(COMMAND_RUN), DRIVE_STATE_FAULT);
    wait_until_the_cause_is_gone();
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_READY);
    EXPECT_EQ(step(COMMAND_RUN), DRIVE_STATE_RUN);
}

// [SR-41]
TEST_F(StateMachine, a_persistent_clear_fault_clears_only_once) {
    run();
    step(COMMAND_RUN, FAULT_BIT(FAULT_OVER_VOLTAGE));
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT, FAULT_BIT(FAULT_OVER_VOLTAGE)), DRIVE_STATE_FAULT);
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_FAULT) << "the cause disappeared after the request";
    wait_until_the_cause_is_gone(COMMAND_CLEAR_FAULT);
    EXPECT_EQ(state_machine.state, DRIVE_STATE_FAULT);
    step(COMMAND_OFF);
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_READY);
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT, FAULT_BIT(FAULT_ENCODER)), DRIVE_STATE_FAULT);
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_FAULT) << "a later fault is not cleared";
    wait_until_the_cause_is_gone(COMMAND_CLEAR_FAULT);
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_FAULT) << "nor one that has failed in a single tick";
}

// [SR-40]
TEST_F(StateMachine, a_fault_that_is_cleared_leaves_nothing_in_the_record) {
    run();
    step(COMMAND_RUN, FAULT_BIT(FAULT_OVER_VOLTAGE));
    fault_record_t &record = state_machine.record;
    record.time_us = 1; // as the caller completes it
    record.speed_q22 = record.torque_reference_q24 = -2;
    record.current_max_q9 = record.dc_link_voltage_q6 = 3;
    step(COMMAND_OFF);
    wait_until_the_cause_is_gone();
    ASSERT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_READY);
    EXPECT_EQ(record.fault, FAULT_NONE);
    EXPECT_EQ(record.fault_mask, 0u);
    EXPECT_EQ(record.time_us, 0u);
    EXPECT_EQ(record.speed_q22, 0);
    EXPECT_EQ(record.torque_reference_q24, 0);
    EXPECT_EQ(record.current_max_q9, 0);
    EXPECT_EQ(record.dc_link_voltage_q6, 0);
    EXPECT_EQ(record.state, 0);
}

// [SR-41]
TEST_F(StateMachine, a_fault_is_cleared_when_its_cause_has_been_gone_for_ten_milliseconds) {
    run();
    step(COMMAND_RUN, FAULT_BIT(FAULT_OVER_VOLTAGE));
    step(COMMAND_OFF, FAULT_BIT(FAULT_OVER_VOLTAGE));
    for (uint32_t k = 0; k < CAUSE_GONE_TICKS; k++) {
        ASSERT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_FAULT) << k;
    }
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_READY) << "the request waits";
}

// [SR-41]
TEST_F(StateMachine, ten_milliseconds_begin_after_the_fault_itself_when_it_lasts_one_tick) {
    for (const drive_state_t from : {DRIVE_STATE_READY, DRIVE_STATE_RUN}) {
        state_machine_reset(&state_machine);
        run();
        if (from == DRIVE_STATE_READY) {
            step(COMMAND_OFF);
        }
        ASSERT_EQ(state_machine.state, from);
        ASSERT_EQ(step(COMMAND_OFF, FAULT_BIT(FAULT_OVER_VOLTAGE)), DRIVE_STATE_FAULT);
        EXPECT_EQ(state_machine.fault_free_ticks, 0u) << "this tick has a failed check";
        for (uint32_t k = 0; k < CAUSE_GONE_TICKS; k++) {
            ASSERT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_FAULT) << k;
        }
        EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_READY);
    }
}

// [SR-41]
TEST_F(StateMachine, a_fault_whose_cause_has_been_gone_for_days_is_cleared_at_once) {
    run();
    step(COMMAND_OFF, FAULT_BIT(FAULT_OVER_VOLTAGE));
    state_machine.fault_free_ticks = UINT32_MAX - 1; // 30 hours at 40 kHz
    for (int k = 0; k < 3; k++) {
        step(COMMAND_OFF);
        EXPECT_EQ(state_machine.fault_free_ticks, UINT32_MAX);
    }
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_READY);
}

// [SR-41]
TEST_F(StateMachine, a_cause_that_returns_within_ten_milliseconds_cancels_the_request_to_clear) {
    run();
    step(COMMAND_RUN, FAULT_BIT(FAULT_OVER_VOLTAGE));
    step(COMMAND_CLEAR_FAULT);
    for (uint32_t k = 2; k < CAUSE_GONE_TICKS; k++) {
        ASSERT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_FAULT) << k;
    }
    step(COMMAND_CLEAR_FAULT, FAULT_BIT(FAULT_UNDER_VOLTAGE));
    for (uint32_t k = 0; k < 3 * CAUSE_GONE_TICKS; k++) {
        ASSERT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_FAULT) << k;
    }
    step(COMMAND_OFF);
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_READY);
}

// [SR-42]
TEST_F(StateMachine, a_recurring_fault_requires_the_run_request_to_be_withdrawn_again) {
    run();
    step(COMMAND_RUN, FAULT_BIT(FAULT_OVER_VOLTAGE));
    wait_until_the_cause_is_gone();
    step(COMMAND_CLEAR_FAULT);
    step(COMMAND_RUN);
    ASSERT_EQ(state_machine.state, DRIVE_STATE_RUN);
    step(COMMAND_RUN, FAULT_BIT(FAULT_OVER_VOLTAGE));
    EXPECT_EQ(state_machine.state, DRIVE_STATE_FAULT);
    EXPECT_FALSE(state_machine.rearmed);
}

// [SR-06]
TEST_F(StateMachine, a_stop_runs_until_standstill_and_off_does_not_wait) {
    run();
    for (int k = 0; k < 10; k++) {
        ASSERT_EQ(step(COMMAND_STOP), DRIVE_STATE_RUN);
    }
    EXPECT_EQ(step(COMMAND_STOP, 0, true), DRIVE_STATE_READY);
    EXPECT_EQ(step(COMMAND_RUN), DRIVE_STATE_RUN);
    EXPECT_EQ(step(COMMAND_OFF), DRIVE_STATE_READY);
}

// [SR-39] [SR-51]
TEST_F(StateMachine, a_run_that_finds_a_request_to_clear_has_begun_by_itself_and_ends) {
    run();
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_READY);
}

} // namespace
