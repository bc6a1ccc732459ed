// State machine of CiA 402: every transition; option codes, demand, and the loss of the master.
#include "support/canopen_bench.h"

namespace {

using namespace canopen_bench;

constexpr unsigned SHUTDOWN = 0x06, SWITCH_ON = 0x07, ENABLE = 0x0F, DISABLE_VOLTAGE = 0x00, QUICK_STOP = 0x02,
                   RESET = 0x80, HALT = 0x10F;

const char *const names[CANOPEN_STATES] = {
    "not ready",         "switch on disabled", "ready to switch on", "switched on",
    "operation enabled", "quick stop active",  "fault reaction",     "fault"};

class CanopenDrive : public CanopenBench {
  protected:
    void expect_state(canopen_state_t state, const char *after) {
        EXPECT_STREQ(names[canopen.drive.state], names[state]) << after;
    }

    // Brings a fresh device into a state.
    void go(canopen_state_t state) {
        canopen_init(&canopen, NODE, 1, time_us);
        commands_init(&commands);
        values.status.state = state == CANOPEN_NOT_READY ? DRIVE_STATE_INITIALISE
                              : state == CANOPEN_FAULT   ? DRIVE_STATE_FAULT
                                                         : DRIVE_STATE_READY;
        values.status.fault = state == CANOPEN_FAULT ? FAULT_OVER_CURRENT : FAULT_NONE;
        command = {};
        cycle(2);
        sent();
        operational();
        const unsigned words[] = {SHUTDOWN, SWITCH_ON, ENABLE};
        const unsigned count = state == CANOPEN_READY_TO_SWITCH_ON ? 1
                               : state == CANOPEN_SWITCHED_ON      ? 2
                               : state == CANOPEN_OPERATION_ENABLED || state == CANOPEN_QUICK_STOP_ACTIVE ||
                                       state == CANOPEN_FAULT_REACTION
                                   ? 3
                                   : 0;
        for (unsigned i = 0; i < count; i++) {
            control(words[i]);
        }
        if (state == CANOPEN_QUICK_STOP_ACTIVE) {
            control(QUICK_STOP);
        } else if (state == CANOPEN_FAULT_REACTION) {
            write(0x6007, 0, 1);
            const canopen_context_t now = context();
            canopen_drive_lose_master(&canopen, &now, CANOPEN_MASTER_SILENT);
        }
        ASSERT_STREQ(names[canopen.drive.state], names[state]);
    }
};

TEST_F(CanopenDrive, every_command_in_every_state) {
    const unsigned words[] = {SHUTDOWN, SWITCH_ON, ENABLE, DISABLE_VOLTAGE, QUICK_STOP, RESET | DISABLE_VOLTAGE};
    constexpr canopen_state_t NR = CANOPEN_NOT_READY, SD = CANOPEN_SWITCH_ON_DISABLED, RS = CANOPEN_READY_TO_SWITCH_ON,
                              SO = CANOPEN_SWITCHED_ON, OE = CANOPEN_OPERATION_ENABLED, QS = CANOPEN_QUICK_STOP_ACTIVE,
                              FR = CANOPEN_FAULT_REACTION, FA = CANOPEN_FAULT;
    // Directly after the command. Disable operation has a ramp: its option code is 1.
    const canopen_state_t table[CANOPEN_STATES][6] = {
        {NR, NR, NR, NR, NR, NR}, {RS, SD, SD, SD, SD, SD}, {RS, SO, OE, SD, SD, SD}, {RS, SO, OE, SD, SD, SD},
        {RS, OE, OE, SD, QS, SD}, {QS, QS, QS, SD, QS, SD}, {FR, FR, FR, FR, FR, FR}, {FA, FA, FA, FA, FA, FA},
    };
    for (unsigned state = 0; state < CANOPEN_STATES; state++) {
        for (unsigned i = 0; i < 6; i++) {
            go(canopen_state_t(state));
            write(0x6040, 0, int32_t(words[i]));
            expect_state(table[state][i], names[state]);
            const bool runs = canopen_enabled(&canopen);
            EXPECT_EQ(commands.arming.armed != 0, runs) << names[state] << " " << i;
            cycle();
            EXPECT_EQ(command.request == COMMAND_RUN, canopen_enabled(&canopen)) << names[state] << " " << i;
        }
    }
}

TEST_F(CanopenDrive, statusword_of_every_state) {
    const unsigned bits[CANOPEN_STATES] = {0x00, 0x40, 0x21, 0x23, 0x27, 0x07, 0x0F, 0x08};
    for (unsigned state = 0; state < CANOPEN_STATES; state++) {
        go(canopen_state_t(state));
        EXPECT_EQ(status() & 0x6Fu, bits[state]) << names[state];
        EXPECT_NE(status() & 0x10u, 0u) << "voltage";
        EXPECT_EQ((status() & 0x200u) != 0, canopen.nmt == CANOPEN_NMT_OPERATIONAL) << "remote";
    }
    values.torque.bus_voltage_v = 0;
    cycle();
    EXPECT_EQ(status() & 0x10u, 0u);
}

TEST_F(CanopenDrive, automatic_transitions_follow_the_drive) {
    go(CANOPEN_NOT_READY);
    values.status.state = DRIVE_STATE_READY;
    cycle();
    expect_state(CANOPEN_SWITCH_ON_DISABLED, "ready");
    for (unsigned state : {1u, 2u, 3u, 4u, 5u, 6u}) {
        go(canopen_state_t(state));
        values.status.state = DRIVE_STATE_FAULT;
        values.status.fault = FAULT_OVER_VOLTAGE;
        cycle();
        expect_state(CANOPEN_FAULT, names[state]);
        EXPECT_EQ(command.request, COMMAND_OFF);
        EXPECT_EQ(commands.arming.armed, 0);
    }
}

TEST_F(CanopenDrive, enabling_needs_operational_and_a_ready_drive) {
    go(CANOPEN_SWITCHED_ON);
    receive(0, {128, NODE});
    control(ENABLE);
    expect_state(CANOPEN_SWITCHED_ON, "pre-operational");
    operational();
    canopen.measured.state = DRIVE_STATE_RUN;
    control(ENABLE);
    expect_state(CANOPEN_SWITCHED_ON, "the drive still runs");
    cycle();
    expect_state(CANOPEN_OPERATION_ENABLED, "ready a little later");
    go(CANOPEN_SWITCHED_ON);
    canopen.measured.state = DRIVE_STATE_RUN;
    control(ENABLE);
    follows = false;
    values.status.state = DRIVE_STATE_RUN;
    cycle(25);
    values.status.state = DRIVE_STATE_READY;
    cycle(25);
    expect_state(CANOPEN_SWITCHED_ON, "not for ever");
}

TEST_F(CanopenDrive, an_enabling_that_waits_for_a_ready_drive_is_withdrawn_by_the_next_command) {
    for (const bool withdrawn : {true, false}) {
        go(CANOPEN_SWITCHED_ON);
        canopen.measured.state = DRIVE_STATE_RUN;
        control(ENABLE);
        if (withdrawn) {
            control(SWITCH_ON);
        }
        cycle(2);
        expect_state(withdrawn ? CANOPEN_SWITCHED_ON : CANOPEN_OPERATION_ENABLED, "ready");
        EXPECT_EQ(command.request == COMMAND_RUN, !withdrawn);
    }
}

TEST_F(CanopenDrive, the_loss_of_a_master_is_told_until_the_drive_is_enabled_again) {
    enable();
    write(0x6007, 0, 2);
    const canopen_context_t now = context();
    canopen_drive_lose_master(&canopen, &now, CANOPEN_MASTER_SILENT);
    cycle(2);
    EXPECT_EQ(read(0x603F, 0), 0x8130u);
    enable();
    cycle();
    EXPECT_EQ(read(0x603F, 0), 0u);
    EXPECT_EQ(read(0x1001, 0), 0u);
}

TEST_F(CanopenDrive, a_fault_is_reported_and_reset_by_the_edge) {
    enable();
    values.status.state = DRIVE_STATE_FAULT;
    values.status.fault = FAULT_OVER_CURRENT;
    cycle();
    EXPECT_EQ(sent().front(), (sent_t{0x80 + NODE, {0x10, 0x23, 0x03, FAULT_OVER_CURRENT, 0, 0, 0, 0}}));
    EXPECT_EQ(read(0x603F, 0), 0x2310u);
    EXPECT_EQ(read(0x1001, 0), 3u);
    control(RESET);
    cycle();
    EXPECT_EQ(command.request, COMMAND_CLEAR_FAULT);
    cycle(101);
    EXPECT_EQ(command.request, COMMAND_OFF) << "not accepted in time";
    control(RESET);
    cycle();
    EXPECT_EQ(command.request, COMMAND_OFF) << "no edge";
    control(0);
    control(RESET | ENABLE);
    cycle();
    EXPECT_EQ(command.request, COMMAND_CLEAR_FAULT);
    sent();
    values.status.state = DRIVE_STATE_READY;
    values.status.fault = FAULT_NONE;
    cycle();
    expect_state(CANOPEN_SWITCH_ON_DISABLED, "cleared");
    EXPECT_EQ(sent().front(), (sent_t{0x80 + NODE, {0, 0, 0, 0, 0, 0, 0, 0}}));
    cycle(10);
    EXPECT_EQ(command.request, COMMAND_OFF) << "the bits of enabling start nothing";
}

TEST_F(CanopenDrive, the_bit_of_a_reset_that_was_set_before_the_fault_is_no_edge_whatever_follows) {
    enable();
    control(RESET | ENABLE);
    values.status.state = DRIVE_STATE_FAULT;
    values.status.fault = FAULT_OVER_CURRENT;
    cycle();
    for (const unsigned word : {RESET | ENABLE, RESET | SHUTDOWN, RESET}) {
        control(word);
        cycle();
        EXPECT_EQ(command.request, COMMAND_OFF) << word;
    }
    control(0);
    control(RESET);
    cycle();
    EXPECT_EQ(command.request, COMMAND_CLEAR_FAULT);
}

TEST_F(CanopenDrive, a_fault_is_one_emergency_another_in_its_place_is_one_and_so_is_the_same_after_it_was_cleared) {
    enable();
    const auto emergencies_of = [this](fault_t fault) {
        values.status.state = fault == FAULT_NONE ? DRIVE_STATE_READY : DRIVE_STATE_FAULT;
        values.status.fault = fault;
        cycle(5);
        return emergencies();
    };
    using codes_t = std::vector<unsigned>;
    EXPECT_EQ(emergencies_of(FAULT_OVER_CURRENT), codes_t{canopen_error_codes[FAULT_OVER_CURRENT]});
    EXPECT_EQ(emergencies_of(FAULT_OVER_VOLTAGE), codes_t{canopen_error_codes[FAULT_OVER_VOLTAGE]});
    EXPECT_EQ(emergencies_of(FAULT_NONE), codes_t{0});
    EXPECT_EQ(emergencies_of(FAULT_OVER_VOLTAGE), codes_t{canopen_error_codes[FAULT_OVER_VOLTAGE]});
    EXPECT_EQ(emergencies_of(FAULT_OVER_VOLTAGE), codes_t{});
}

TEST_F(CanopenDrive, a_velocity_is_reached_in_the_window_time_of_its_own_run) {
    write(0x606E, 0, 50);
    cycle(200);
    for (unsigned run = 0; run < 2; run++) {
        enable();
        EXPECT_EQ(status() & 0x400u, 0u) << run;
        cycle(60);
        EXPECT_NE(status() & 0x400u, 0u) << run;
        control(DISABLE_VOLTAGE);
        cycle(200);
    }
}

TEST_F(CanopenDrive, profile_velocity_follows_its_ramp) {
    enable();
    write(0x6083, 0, 2000);
    write(0x60FF, 0, 600);
    cycle(100);
    EXPECT_EQ(command.mode, DRIVE_MODE_SPEED);
    EXPECT_NEAR(int32_t(read(0x606B, 0)), 200, 1);
    EXPECT_NEAR(command.speed_reference_q22, 200 * 0.10471976 * (1 << 22), 0.2 * (1 << 22));
    cycle(201);
    EXPECT_EQ(read(0x606B, 0), 600u);
    values.motion.speed_rpm = 600000;
    cycle(12);
    EXPECT_NE(status() & 0x400u, 0u) << "target reached";
    control(HALT);
    cycle(100);
    EXPECT_NEAR(int32_t(read(0x606B, 0)), 500, 1) << "by the deceleration";
    write(0x605D, 0, 2);
    cycle(20);
    EXPECT_NEAR(int32_t(read(0x606B, 0)), 400, 1) << "by the quick stop deceleration";
    expect_state(CANOPEN_OPERATION_ENABLED, "halt");
    write(0x607E, 0, 0x40);
    values.motion.speed_rpm = 400000;
    cycle();
    EXPECT_EQ(int32_t(read(0x606C, 0)), -400);
}

TEST_F(CanopenDrive, torque_follows_its_slope_and_cyclic_modes_interpolate) {
    write(0x6060, 0, 4);
    write(0x6087, 0, 1000);
    enable();
    write(0x6071, 0, 500);
    cycle(100);
    EXPECT_EQ(command.mode, DRIVE_MODE_TORQUE);
    const double rated = machine_tables.parameter_default[PARAMETER_TORQUE_MAX_NM];
    EXPECT_NEAR(command.torque_reference_q24, 0.1 * rated, 0.002 * rated);
    cycle(500);
    EXPECT_NEAR(command.torque_reference_q24, 0.5 * rated, 1e-5 * rated);
    EXPECT_NE(status() & 0x400u, 0u);
    write(0x6060, 0, 10);
    write(0x60C2, 1, 10);
    values.torque.torque_reference_nm = 0;
    cycle();
    EXPECT_EQ(read(0x6061, 0), 10u);
    write(0x6071, 0, -400);
    cycle(5);
    const int32_t half = command.torque_reference_q24;
    cycle(5);
    EXPECT_NEAR(command.torque_reference_q24, -0.4 * rated, 1e-5 * rated);
    EXPECT_LT(half, 0);
    EXPECT_GT(half, command.torque_reference_q24);
    write(0x6060, 0, 9);
    write(0x60FF, 0, 1000);
    cycle(10);
    EXPECT_EQ(read(0x606B, 0), 1000u);
    EXPECT_NE(status() & 0x1000u, 0u) << "follows";
}

TEST_F(CanopenDrive, factors_scale_velocities) {
    write(0x6096, 1, 1);
    write(0x6096, 2, 1000);
    write(0x6091, 1, 3);
    write(0x6097, 1, 4095);
    enable();
    write(0x60FF, 0, 100000); // 0.001 r/min of the shaft
    cycle(500);
    EXPECT_NEAR(command.speed_reference_q22, 300 * 0.10471976 * (1 << 22), 0.01 * (1 << 22));
    EXPECT_EQ(read(0x606B, 0), 100000u);
    write(0x60FF, 0, INT32_MAX);
    cycle(500);
    EXPECT_LE(command.speed_reference_q22, 512.0 * (1 << 22));
    EXPECT_EQ(status() & 0x400u, 0u);
}

TEST_F(CanopenDrive, beyond_its_range_the_demand_is_limited) {
    write(0x6083, 0, 1000000);
    enable();
    write(0x60FF, 0, -1000000);
    cycle(2000);
    EXPECT_GT(command.speed_reference_q22, -513.0 * (1 << 22));
    EXPECT_NE(status() & 0x800u, 0u) << "internal limit";
}

TEST_F(CanopenDrive, a_quick_stop_ends_at_rest_with_the_switches_open) {
    enable();
    write(0x60FF, 0, 600);
    cycle(700);
    values.motion.speed_rpm = 600000;
    cycle();
    control(QUICK_STOP);
    cycle(60);
    EXPECT_NEAR(int32_t(read(0x606B, 0)), 300, 6);
    EXPECT_EQ(command.request, COMMAND_RUN);
    values.motion.speed_rpm = 0;
    cycle(70);
    expect_state(CANOPEN_SWITCH_ON_DISABLED, "at rest");
    EXPECT_EQ(command.request, COMMAND_OFF);
    control(ENABLE);
    expect_state(CANOPEN_SWITCH_ON_DISABLED, "enable alone");
}

TEST_F(CanopenDrive, a_stop_begins_with_a_rotor_that_has_not_reached_its_demand) {
    for (const unsigned word : {QUICK_STOP, SWITCH_ON}) {
        for (const int32_t sign : {1, -1}) {
            go(CANOPEN_OPERATION_ENABLED);
            write(0x6083, 0, 1000000);
            write(0x60FF, 0, sign * 3000);
            values.motion.speed_rpm = sign * 100000;
            cycle(10);
            EXPECT_EQ(int32_t(read(0x606B, 0)), sign * 3000);
            control(word);
            cycle(2);
            EXPECT_LE(std::abs(int32_t(read(0x606B, 0))), 100);
            EXPECT_GE(std::abs(int32_t(read(0x606B, 0))), 80) << "by its ramp";
            values.motion.speed_rpm = 0;
            cycle(200);
        }
    }
}

TEST_F(CanopenDrive, a_load_that_turns_the_rotor_does_not_keep_a_stop_from_ending) {
    enable();
    control(QUICK_STOP);
    values.motion.speed_rpm = 300000;
    cycle(900);
    EXPECT_EQ(command.request, COMMAND_RUN);
    cycle(300);
    EXPECT_EQ(command.request, COMMAND_OFF);
}

TEST_F(CanopenDrive, a_command_repeated_each_ms_does_not_keep_a_stop_from_ending) {
    write(0x605B, 0, 1);
    for (const auto &[word, to] : {std::pair{SHUTDOWN, CANOPEN_READY_TO_SWITCH_ON}, {SWITCH_ON, CANOPEN_SWITCHED_ON}}) {
        for (int32_t speed : {0, 300000}) { // at rest, and turned by a load
            go(CANOPEN_SWITCHED_ON);
            control(ENABLE);
            values.motion.speed_rpm = speed;
            cycle(2);
            for (unsigned ms = 0; ms < 1500; ms++) {
                receive(0x200 + NODE, {uint8_t(word), 0});
                cycle();
            }
            expect_state(to, "a master that sends its controlword in each cycle");
            EXPECT_EQ(command.request, COMMAND_OFF);
            values.motion.speed_rpm = 0;
        }
    }
}

TEST_F(CanopenDrive, another_command_in_a_stop_is_obeyed) {
    write(0x605B, 0, 1);
    go(CANOPEN_SWITCHED_ON);
    control(ENABLE);
    values.motion.speed_rpm = 300000;
    cycle(2);
    control(SWITCH_ON);
    cycle(5);
    control(SHUTDOWN);
    values.motion.speed_rpm = 0;
    cycle(400);
    expect_state(CANOPEN_READY_TO_SWITCH_ON, "the later one");
}

TEST_F(CanopenDrive, quick_stop_options) {
    write(0x605A, 0, 0);
    enable();
    control(QUICK_STOP);
    expect_state(CANOPEN_SWITCH_ON_DISABLED, "option 0");
    cycle();
    write(0x605A, 0, 6);
    for (unsigned word : {SHUTDOWN, SWITCH_ON, ENABLE}) {
        control(word);
    }
    cycle(2);
    control(QUICK_STOP);
    cycle(2000);
    expect_state(CANOPEN_QUICK_STOP_ACTIVE, "option 6 stays");
    control(ENABLE);
    expect_state(CANOPEN_OPERATION_ENABLED, "transition 16");
    EXPECT_EQ(write(0x605A, 0, 3), 0x06090030u);
}

TEST_F(CanopenDrive, option_codes_of_shutdown_and_disable_operation) {
    for (const auto &[option, word, to] :
         {std::tuple{0x605Bu, SHUTDOWN, CANOPEN_READY_TO_SWITCH_ON}, {0x605Cu, SWITCH_ON, CANOPEN_SWITCHED_ON}}) {
        for (int32_t code : {0, 1}) {
            go(CANOPEN_SWITCHED_ON);
            write(option, 0, code);
            control(ENABLE);
            cycle(2);
            values.motion.speed_rpm = 100000;
            cycle();
            control(word);
            expect_state(code == 0 ? to : CANOPEN_OPERATION_ENABLED, "at once, or after the ramp");
            values.motion.speed_rpm = 0;
            cycle(200);
            expect_state(to, "after the ramp");
        }
    }
}

TEST_F(CanopenDrive, a_lost_heartbeat_is_a_quick_stop_then_open_switches) {
    write(0x1016, 1, 0x7F << 16 | 100);
    enable();
    write(0x60FF, 0, 600);
    for (unsigned i = 0; i < 70; i++) {
        receive(0x77F, {5});
        cycle(10);
    }
    values.motion.speed_rpm = 600000;
    cycle(89);
    expect_state(CANOPEN_OPERATION_ENABLED, "in time");
    sent();
    cycle(20);
    expect_state(CANOPEN_QUICK_STOP_ACTIVE, "lost");
    EXPECT_EQ(canopen.nmt, CANOPEN_NMT_PRE_OPERATIONAL);
    EXPECT_EQ(sent().front(), (sent_t{0x80 + NODE, {0x30, 0x81, 0x11, 0, 0, 0, 0, 0}}));
    receive(0x77F, {5});
    values.motion.speed_rpm = 0;
    cycle(130);
    expect_state(CANOPEN_SWITCH_ON_DISABLED, "at rest");
    EXPECT_EQ(command.request, COMMAND_OFF);
}

TEST_F(CanopenDrive, a_heartbeat_that_stays_away_is_lost_once_and_once_more_after_it_was_heard) {
    write(0x1016, 1, 0x7F << 16 | 100);
    operational();
    for (unsigned loss = 0; loss < 2; loss++) {
        receive(0x77F, {5});
        sent();
        cycle(1000);
        EXPECT_EQ(emergencies().size(), 1u) << loss;
    }
}

TEST_F(CanopenDrive, silence_without_any_supervision_is_a_lost_master) {
    enable();
    cycle(1990);
    expect_state(CANOPEN_OPERATION_ENABLED, "in time");
    cycle(20);
    EXPECT_NE(canopen.drive.state, CANOPEN_OPERATION_ENABLED);
    EXPECT_EQ(write(0x2F01, 0, 0), 0x06090032u) << "cannot be switched off";
    EXPECT_EQ(write(0x6007, 0, 0), 0x06090032u) << "nor the reaction";
}

TEST_F(CanopenDrive, silence_in_a_quick_stop_that_stays_opens_the_switches) {
    write(0x605A, 0, 6);
    enable();
    control(QUICK_STOP);
    cycle(1900);
    expect_state(CANOPEN_QUICK_STOP_ACTIVE, "option 6 stays");
    EXPECT_EQ(command.request, COMMAND_RUN);
    cycle(300);
    expect_state(CANOPEN_SWITCH_ON_DISABLED, "the master is lost");
    EXPECT_EQ(command.request, COMMAND_OFF);
}

TEST_F(CanopenDrive, a_consumer_without_node_or_time_is_none_and_a_node_is_watched_once) {
    EXPECT_EQ(write(0x1016, 1, 0x7F << 16 | 100), 0u);
    EXPECT_EQ(write(0x1016, 2, 0x7F << 16 | 200), 0x06040043u) << "the same node";
    EXPECT_EQ(write(0x1016, 1, 0x7F << 16 | 200), 0u) << "its own entry";
    EXPECT_EQ(write(0x1016, 1, 0x7F << 16), 0u) << "no time: not used";
    EXPECT_EQ(write(0x1016, 2, 100), 0u) << "no node: not used";
    enable();
    receive(0x77F, {5});
    cycle(2100);
    EXPECT_NE(canopen.drive.state, CANOPEN_OPERATION_ENABLED) << "an entry that is not used replaces no supervision";
}

TEST_F(CanopenDrive, long_guard_times_are_not_short_ones) {
    for (const auto &[time_ms, factor] : {std::pair{61357, 70}, {65535, 255}, {60000, 72}}) { // 2^32 us and some ms
        go(CANOPEN_SWITCHED_ON);
        write(0x100C, 0, time_ms);
        write(0x100D, 0, factor);
        control(ENABLE);
        receive(0x700 + NODE, {}, true);
        for (unsigned i = 0; i < 40; i++) {
            cycle(1000);
            receive(0x80, {}); // any sign against the silence of all
        }
        expect_state(CANOPEN_OPERATION_ENABLED, "guarded");
    }
}

TEST_F(CanopenDrive, other_losses_of_the_master) {
    const canopen_state_t after[] = {CANOPEN_FAULT_REACTION, CANOPEN_SWITCH_ON_DISABLED, CANOPEN_QUICK_STOP_ACTIVE};
    for (int32_t option : {1, 2, 3}) {
        for (unsigned loss = 0; loss < 4; loss++) {
            go(CANOPEN_SWITCHED_ON);
            write(0x6007, 0, option);
            write(0x100C, 0, 10);
            write(0x100D, 0, 3);
            control(ENABLE);
            write(0x1400, 5, 20);
            values.motion.speed_rpm = 300000;
            cycle(2);
            switch (loss) {
            case 0: // guarding
                receive(0x700 + NODE, {}, true);
                cycle(28);
                expect_state(CANOPEN_OPERATION_ENABLED, "guarded");
                cycle(5);
                break;
            case 1:
                receive(0x200 + NODE, {ENABLE, 0});
                cycle(19);
                expect_state(CANOPEN_OPERATION_ENABLED, "RPDO in time");
                cycle(3);
                break;
            case 2:
                canopen.bus_off = true;
                cycle();
                break;
            default:
                receive(0, {2, 0}); // NMT stop
                break;
            }
            EXPECT_STREQ(names[canopen.drive.state], names[after[option - 1]]) << option << " " << loss;
        }
    }
    values.motion.speed_rpm = 0;
    go(CANOPEN_FAULT_REACTION);
    cycle(50);
    expect_state(CANOPEN_FAULT, "after the reaction");
    EXPECT_EQ(read(0x603F, 0), 0x8130u);
    EXPECT_EQ(command.request, COMMAND_OFF);
    control(RESET);
    cycle();
    expect_state(CANOPEN_SWITCH_ON_DISABLED, "reset");
}

TEST_F(CanopenDrive, a_drive_that_is_disarmed_from_elsewhere_leaves_operation_enabled) {
    enable();
    commands.arming.armed ^= 1; // a flipped bit
    cycle();
    expect_state(CANOPEN_SWITCH_ON_DISABLED, "disarmed");
    EXPECT_EQ(command.request, COMMAND_OFF);
}

TEST_F(CanopenDrive, reset_node_opens_the_switches_first) {
    enable();
    write(0x60FF, 0, 600);
    receive(0, {129, 0});
    conditions.running = true;
    cycle(3);
    EXPECT_EQ(command.request, COMMAND_OFF);
    conditions.running = false;
    sent();
    cycle(2);
    EXPECT_EQ(sent().front(), (sent_t{0x700 + NODE, {0}})) << "boot-up";
    EXPECT_EQ(read(0x60FF, 0), 0u);
}

} // namespace
