// Every state against every input, and what it takes to run again after a fault.
#include <cstdint>

#include <gtest/gtest.h>

extern "C" {
#include "drive/state_machine.h"
}

namespace {

constexpr uint32_t INITIALISE_TICKS = 5;
constexpr uint16_t TIMEOUT = FAULT_BIT(FAULT_COMMAND_TIMEOUT);
constexpr uint16_t EVERY_CHECK = FAULT_BIT(FAULT_COUNT) - FAULT_BIT(FAULT_OVER_CURRENT);
const command_request_t REQUESTS[] = {COMMAND_OFF, COMMAND_RUN, COMMAND_STOP, COMMAND_CLEAR_FAULT};

struct expected_t {
    drive_state_t state;
    bool latched;
};

// The diagram of state_machine.h. INITIALISE is one tick before it may leave.
expected_t expected(drive_state_t state, uint16_t checks, command_request_t request, bool standing, bool released) {
    const uint16_t lasting = checks & uint16_t(~TIMEOUT);
    released = released || request != COMMAND_RUN;
    switch (state) {
    case DRIVE_STATE_INITIALISE:
        return {lasting == 0 ? DRIVE_STATE_READY : DRIVE_STATE_INITIALISE, false};
    case DRIVE_STATE_READY:
        if (lasting != 0) {
            return {DRIVE_STATE_FAULT, true};
        }
        return {request == COMMAND_RUN && checks == 0 && released ? DRIVE_STATE_RUN : DRIVE_STATE_READY, false};
    case DRIVE_STATE_RUN:
        if (checks != 0) {
            return {DRIVE_STATE_FAULT, true};
        }
        if (request == COMMAND_OFF || (request == COMMAND_STOP && standing)) {
            return {DRIVE_STATE_READY, false};
        }
        return {DRIVE_STATE_RUN, false};
    case DRIVE_STATE_FAULT:
    default:
        return {request == COMMAND_CLEAR_FAULT && lasting == 0 ? DRIVE_STATE_READY : DRIVE_STATE_FAULT, false};
    }
}

fault_t lowest(uint16_t checks) {
    for (int fault = 0; fault < FAULT_COUNT; fault++) {
        if ((checks & FAULT_BIT(fault)) != 0) {
            return fault_t(fault);
        }
    }
    return FAULT_NONE;
}

TEST(StateMachineTable, takes_the_documented_way_for_every_state_check_mask_request_and_flag) {
    for (int state = DRIVE_STATE_INITIALISE; state <= DRIVE_STATE_FAULT; state++) {
        for (unsigned checks = 0; checks <= EVERY_CHECK; checks += 2) { // bit 0 is FAULT_NONE
            for (const command_request_t request : REQUESTS) {
                for (const bool standing : {false, true}) {
                    for (const bool released : {false, true}) {
                        state_machine_t machine{};
                        machine.state = drive_state_t(state);
                        machine.healthy_ticks = INITIALISE_TICKS - 1;
                        machine.released = released;
                        const fault_record_t old = {FAULT_ENCODER, FAULT_BIT(FAULT_ENCODER), 2, 1, 2, 3, 4, 5};
                        if (state == DRIVE_STATE_FAULT) {
                            machine.record = old;
                        }
                        const state_machine_input_t input = {uint16_t(checks), request, standing};
                        const expected_t wanted = expected(machine.state, input.checks, request, standing, released);
                        const bool latched = state_machine_step(&machine, &input, INITIALISE_TICKS);
                        SCOPED_TRACE(testing::Message() << "state " << state << " checks " << checks << " request "
                                                        << request << " standing " << standing);
                        ASSERT_EQ(machine.state, wanted.state);
                        ASSERT_EQ(latched, wanted.latched);
                        if (latched) {
                            const uint16_t counted = state == DRIVE_STATE_READY ? checks & unsigned(~TIMEOUT) : checks;
                            ASSERT_EQ(machine.record.checks, counted);
                            ASSERT_EQ(machine.record.fault, lowest(counted));
                            ASSERT_EQ(machine.record.state, state);
                            ASSERT_FALSE(machine.released);
                        } else if (machine.state == DRIVE_STATE_FAULT) {
                            ASSERT_EQ(machine.record.fault, old.fault) << "the first cause stays";
                            ASSERT_EQ(machine.record.checks, old.checks);
                            ASSERT_EQ(machine.record.time_us, old.time_us);
                        } else {
                            ASSERT_EQ(machine.record.fault, FAULT_NONE);
                        }
                    }
                }
            }
        }
    }
}

class StateMachine : public testing::Test {
  protected:
    StateMachine() { state_machine_reset(&machine); }

    drive_state_t step(command_request_t request, uint16_t checks = 0, bool standing = false) {
        const state_machine_input_t input = {checks, request, standing};
        state_machine_step(&machine, &input, INITIALISE_TICKS);
        return machine.state;
    }

    void run() {
        for (uint32_t k = 0; k < INITIALISE_TICKS; k++) {
            step(COMMAND_OFF);
        }
        ASSERT_EQ(step(COMMAND_RUN), DRIVE_STATE_RUN);
    }

    state_machine_t machine;
};

TEST_F(StateMachine, initialise_lasts_until_all_checks_passed_for_its_time_without_a_break) {
    for (uint32_t k = 0; k + 1 < INITIALISE_TICKS; k++) {
        ASSERT_EQ(step(COMMAND_OFF), DRIVE_STATE_INITIALISE);
    }
    ASSERT_EQ(step(COMMAND_OFF, FAULT_BIT(FAULT_UNDER_VOLTAGE)), DRIVE_STATE_INITIALISE);
    // Nobody commands yet: that is no reason to wait.
    for (uint32_t k = 0; k + 1 < INITIALISE_TICKS; k++) {
        ASSERT_EQ(step(COMMAND_OFF, TIMEOUT), DRIVE_STATE_INITIALISE);
    }
    EXPECT_EQ(step(COMMAND_OFF, TIMEOUT), DRIVE_STATE_READY);
}

TEST_F(StateMachine, run_held_from_power_on_does_not_start_the_drive) {
    for (int k = 0; k < 100; k++) {
        ASSERT_NE(step(COMMAND_RUN), DRIVE_STATE_RUN);
    }
    EXPECT_EQ(step(COMMAND_OFF), DRIVE_STATE_READY);
    EXPECT_EQ(step(COMMAND_RUN), DRIVE_STATE_RUN);
}

TEST_F(StateMachine, a_lost_command_is_a_fault_in_run_only) {
    for (uint32_t k = 0; k < INITIALISE_TICKS; k++) {
        step(COMMAND_OFF, TIMEOUT);
    }
    EXPECT_EQ(step(COMMAND_OFF, TIMEOUT), DRIVE_STATE_READY);
    EXPECT_EQ(step(COMMAND_RUN, TIMEOUT), DRIVE_STATE_READY) << "a stale run starts nothing";
    EXPECT_EQ(step(COMMAND_RUN), DRIVE_STATE_RUN);
    EXPECT_EQ(step(COMMAND_RUN, TIMEOUT), DRIVE_STATE_FAULT);
    EXPECT_EQ(machine.record.fault, FAULT_COMMAND_TIMEOUT);
}

TEST_F(StateMachine, the_first_cause_stays_whatever_fails_later) {
    run();
    step(COMMAND_RUN, FAULT_BIT(FAULT_OVER_SPEED) | FAULT_BIT(FAULT_ENCODER));
    step(COMMAND_RUN, FAULT_BIT(FAULT_OVER_CURRENT));
    step(COMMAND_CLEAR_FAULT, FAULT_BIT(FAULT_OVER_CURRENT));
    EXPECT_EQ(machine.state, DRIVE_STATE_FAULT) << "the cause is not gone";
    EXPECT_EQ(machine.record.fault, FAULT_OVER_SPEED);
    EXPECT_EQ(machine.record.checks, FAULT_BIT(FAULT_OVER_SPEED) | FAULT_BIT(FAULT_ENCODER));
    EXPECT_EQ(machine.record.state, DRIVE_STATE_RUN);
    step(COMMAND_OFF);
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_READY);
    EXPECT_EQ(machine.record.fault, FAULT_NONE);
}

TEST_F(StateMachine, after_a_fault_run_must_be_let_go_before_it_counts_again) {
    run();
    step(COMMAND_RUN, FAULT_BIT(FAULT_OVER_VOLTAGE));
    for (int k = 0; k < 100; k++) {
        ASSERT_EQ(step(COMMAND_RUN), DRIVE_STATE_FAULT) << "it clears nothing by itself";
    }
    EXPECT_EQ(step(COMMAND_OFF), DRIVE_STATE_FAULT);
    EXPECT_EQ(step(COMMAND_RUN), DRIVE_STATE_FAULT);
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_READY);
    EXPECT_EQ(step(COMMAND_RUN), DRIVE_STATE_RUN);
}

TEST_F(StateMachine, a_held_clear_fault_clears_only_once) {
    run();
    step(COMMAND_RUN, FAULT_BIT(FAULT_OVER_VOLTAGE));
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT, FAULT_BIT(FAULT_OVER_VOLTAGE)), DRIVE_STATE_FAULT);
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_FAULT) << "the cause went away after it was asked";
    step(COMMAND_OFF);
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_READY);
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT, FAULT_BIT(FAULT_ENCODER)), DRIVE_STATE_FAULT);
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_FAULT) << "a later fault is not covered";
}

TEST_F(StateMachine, a_fault_that_comes_back_while_run_is_held_needs_letting_go_again) {
    run();
    step(COMMAND_RUN, FAULT_BIT(FAULT_OVER_VOLTAGE));
    step(COMMAND_CLEAR_FAULT);
    step(COMMAND_RUN);
    ASSERT_EQ(machine.state, DRIVE_STATE_RUN);
    step(COMMAND_RUN, FAULT_BIT(FAULT_OVER_VOLTAGE));
    EXPECT_EQ(machine.state, DRIVE_STATE_FAULT);
    EXPECT_FALSE(machine.released);
}

TEST_F(StateMachine, stop_keeps_running_until_the_rotor_stands_and_off_does_not_wait) {
    run();
    for (int k = 0; k < 10; k++) {
        ASSERT_EQ(step(COMMAND_STOP), DRIVE_STATE_RUN);
    }
    EXPECT_EQ(step(COMMAND_STOP, 0, true), DRIVE_STATE_READY);
    EXPECT_EQ(step(COMMAND_RUN), DRIVE_STATE_RUN);
    EXPECT_EQ(step(COMMAND_OFF), DRIVE_STATE_READY);
}

TEST_F(StateMachine, clear_fault_does_not_leave_run) {
    run();
    EXPECT_EQ(step(COMMAND_CLEAR_FAULT), DRIVE_STATE_RUN);
}

} // namespace
