// Modes of position of CiA 402: the handshake of set-points at each instant, homing, cyclic targets, units, limits; the
// position loop is one that the test sets.
#include "support/canopen_bench.h"

#include <random>

extern "C" {
#include "comms/canopen_position.h"
#include "comms/canopen_units.h"
}

namespace {

using namespace canopen_bench;

constexpr unsigned ENABLE = 0x0F, NEW = 0x10, AT_ONCE = 0x20, RELATIVE = 0x40, HALT = 0x100;
constexpr unsigned REACHED = 0x400, ACKNOWLEDGED = 0x1000, ERROR = 0x2000;
constexpr int64_t REV = POSITION_ONE_REV;
constexpr int32_t UNITS = 131072; // of a revolution, by default

class CanopenPosition : public CanopenBench {
  protected:
    CanopenPosition() {
        values.status.controller = DRIVE_CONTROLLER_SALIENT;
        cycle();
    }

    // A cycle in which the position loop follows what was published in the one before.
    void follow(unsigned cycles = 1) {
        for (unsigned i = 0; i < cycles; i++) {
            position_status_t &place = canopen.place;
            place.active = command.request == COMMAND_RUN && command.mode == DRIVE_MODE_POSITION;
            place.arrived = place.sequence;
            place.sequence = command.position.sequence;
            cycle();
        }
    }

    void arrive() {
        follow(2);
        canopen.place.in_position = true;
        follow();
    }

    void leave() { canopen.place.in_position = false; }

    void begin(int32_t mode) {
        ASSERT_EQ(write(0x6060, 0, mode), 0u);
        enable();
        follow(2);
        ASSERT_EQ(read(0x6061, 0), unsigned(mode));
        ASSERT_EQ(command.mode, DRIVE_MODE_POSITION);
        ASSERT_EQ(command.position.order, POSITION_ORDER_HALT) << "holds until it is told";
    }

    // A set-point with its handshake; the edge alone with keep.
    void set_point(int32_t target, unsigned bits = 0, bool keep = false) {
        write(0x607A, 0, target);
        control(ENABLE | NEW | bits);
        if (!keep) {
            follow();
            control(ENABLE);
            follow();
        }
    }

    double target_rev() const { return double(command.position.target) / double(REV); }
};

TEST_F(CanopenPosition, a_controller_of_one_quadrant_has_no_such_mode) {
    EXPECT_EQ(read(0x6502, 0), 0x3ADu);
    values.status.controller = DRIVE_CONTROLLER_PAPER;
    cycle();
    EXPECT_EQ(read(0x6502, 0), 0x30Cu);
    for (int32_t mode : {1, 6, 8}) {
        EXPECT_EQ(write(0x6060, 0, mode), 0x06090030u) << mode;
    }
    EXPECT_EQ(write(0x6060, 0, 9), 0u);
}

TEST_F(CanopenPosition, a_bit_4_that_is_set_while_the_drive_waits_to_be_enabled_is_no_edge) {
    write(0x6060, 0, 1);
    operational();
    write(0x607A, 0, UNITS);
    control(6);
    control(7);
    canopen.measured.state = DRIVE_STATE_RUN; // the run before has not ended
    control(ENABLE | NEW);
    cycle(2);
    ASSERT_EQ(canopen.drive.state, CANOPEN_OPERATION_ENABLED);
    control(ENABLE | NEW);
    follow(3);
    EXPECT_EQ(command.position.order, POSITION_ORDER_HALT);
    EXPECT_EQ(status() & ACKNOWLEDGED, 0u);
    control(ENABLE);
    control(ENABLE | NEW);
    follow(3);
    EXPECT_EQ(command.position.order, POSITION_ORDER_PROFILE);
}

TEST_F(CanopenPosition, a_set_point_is_taken_by_the_edge_acknowledged_and_reached_in_its_window_time) {
    begin(1);
    write(0x6068, 0, 5);
    EXPECT_EQ(status() & (ACKNOWLEDGED | REACHED | ERROR), 0u);
    write(0x607A, 0, UNITS / 2);
    follow(3);
    EXPECT_EQ(command.position.order, POSITION_ORDER_HALT) << "a target alone moves nothing";
    control(ENABLE | NEW);
    EXPECT_NE(status() & ACKNOWLEDGED, 0u);
    canopen.place.in_position = true; // still of the old target
    follow();
    EXPECT_EQ(command.position.order, POSITION_ORDER_PROFILE);
    EXPECT_DOUBLE_EQ(target_rev(), 0.5);
    EXPECT_EQ(status() & REACHED, 0u);
    write(0x6068, 0, 0);
    follow();
    EXPECT_EQ(canopen.place.sequence, command.position.sequence);
    EXPECT_EQ(status() & REACHED, 0u) << "the loop has the set-point, its flag is still the old one's";
    leave();
    write(0x6068, 0, 5);
    follow(10);
    EXPECT_NE(status() & ACKNOWLEDGED, 0u) << "until bit 4 falls";
    control(ENABLE);
    follow();
    EXPECT_EQ(status() & ACKNOWLEDGED, 0u);
    canopen.place.in_position = true;
    follow(4);
    EXPECT_EQ(status() & REACHED, 0u) << "window time";
    follow(3);
    EXPECT_NE(status() & REACHED, 0u);
    leave();
    follow();
    EXPECT_EQ(status() & REACHED, 0u) << "left the window";
}

TEST_F(CanopenPosition, one_set_point_waits_and_holds_the_acknowledge) {
    begin(1);
    set_point(1000);
    set_point(2000);
    EXPECT_EQ(command.position.target, 1000 * (REV / UNITS));
    EXPECT_NE(status() & ACKNOWLEDGED, 0u) << "no place for a third one";
    set_point(3000);
    set_point(4000, AT_ONCE);
    EXPECT_EQ(command.position.target, 1000 * (REV / UNITS)) << "no effect of an edge while it is acknowledged";
    arrive();
    EXPECT_EQ(command.position.target, 2000 * (REV / UNITS));
    EXPECT_EQ(status() & (ACKNOWLEDGED | REACHED), 0u);
    leave();
    set_point(5000);
    EXPECT_NE(status() & ACKNOWLEDGED, 0u);
    arrive();
    leave();
    arrive();
    EXPECT_EQ(command.position.target, 5000 * (REV / UNITS));
    EXPECT_EQ(status() & (ACKNOWLEDGED | REACHED), REACHED);
}

TEST_F(CanopenPosition, change_immediately_replaces_the_move_with_its_limits) {
    begin(1);
    write(0x6081, 0, 60);
    set_point(10000);
    const int32_t slow = command.position.speed_q22;
    EXPECT_NEAR(slow, 60 * 0.10471976 * (1 << 22), 100);
    write(0x6081, 0, 120);
    write(0x6083, 0, 4000);
    write(0x6084, 0, 3000);
    write(0x6086, 0, 3);
    write(0x60A4, 1, 70000);
    follow();
    EXPECT_EQ(command.position.speed_q22, slow) << "of the set-point, not of the object";
    EXPECT_EQ(command.position.jerk_rpm_s2, 0) << "trapezoid";
    set_point(-5000, AT_ONCE);
    EXPECT_EQ(command.position.target, -5000 * (REV / UNITS));
    EXPECT_NEAR(command.position.speed_q22, 2 * slow, 2);
    EXPECT_EQ(command.position.acceleration_rpm_s, 4000);
    EXPECT_EQ(command.position.deceleration_rpm_s, 3000);
    EXPECT_EQ(command.position.jerk_rpm_s2, 70000);
}

TEST_F(CanopenPosition, relative_set_points_are_relative_to_the_one_before) {
    canopen.place.position = 3 * REV;
    begin(1);
    set_point(UNITS, RELATIVE);
    EXPECT_DOUBLE_EQ(target_rev(), 4.0) << "first of the present position";
    set_point(UNITS, RELATIVE); // waits
    arrive();
    EXPECT_DOUBLE_EQ(target_rev(), 5.0);
    leave();
    set_point(-3 * UNITS, RELATIVE | AT_ONCE);
    EXPECT_DOUBLE_EQ(target_rev(), 2.0);
    for (int i = 0; i < 3; i++) {
        set_point(INT32_MAX, RELATIVE | AT_ONCE);
    }
    EXPECT_EQ(command.position.target, POSITION_MAX) << "bounded";
}

TEST_F(CanopenPosition, halt_stops_and_the_move_goes_on_after_it) {
    begin(1);
    write(0x6084, 0, 2000);
    write(0x6085, 0, 9000);
    set_point(UNITS);
    control(ENABLE | HALT);
    values.motion.speed_rpm = 300000;
    follow(2);
    EXPECT_EQ(command.position.order, POSITION_ORDER_HALT);
    EXPECT_EQ(command.position.deceleration_rpm_s, 2000);
    EXPECT_EQ(status() & REACHED, 0u);
    write(0x605D, 0, 2);
    values.motion.speed_rpm = 0;
    follow(2);
    EXPECT_EQ(command.position.deceleration_rpm_s, 9000);
    EXPECT_NE(status() & REACHED, 0u) << "halted";
    control(ENABLE);
    follow();
    EXPECT_EQ(command.position.order, POSITION_ORDER_PROFILE);
    EXPECT_DOUBLE_EQ(target_rev(), 1.0);
}

TEST_F(CanopenPosition, an_edge_enables_nothing_and_one_of_another_mode_is_none) {
    write(0x6060, 0, 1);
    write(0x607A, 0, 1000);
    operational();
    for (unsigned word : {6u, 7u, ENABLE | NEW}) {
        control(word);
    }
    follow(3);
    EXPECT_EQ(command.position.order, POSITION_ORDER_HALT) << "bit 4 with enable operation";
    EXPECT_EQ(status() & ACKNOWLEDGED, 0u);
    control(ENABLE);
    write(0x6060, 0, 6);
    control(ENABLE | NEW); // the mode is not in effect
    follow(3);
    EXPECT_EQ(command.position.order, POSITION_ORDER_HALT);
    EXPECT_EQ(read(0x6061, 0), 6u);
    write(0x6060, 0, 1);
    follow(2);
    EXPECT_EQ(command.position.order, POSITION_ORDER_HALT) << "a level is no edge";
}

TEST_F(CanopenPosition, random_handshakes_lose_and_double_no_set_point) {
    std::mt19937 random{402};
    begin(1);
    int32_t asked = 0, taken = 0, arrived = 0;
    bool bit = false;
    for (unsigned i = 0; i < 20000; i++) {
        switch (random() % 4) {
        case 0: // as the profile has it: edges with the acknowledge low, falls with it high
            if (!bit && (status() & ACKNOWLEDGED) == 0) {
                write(0x607A, 0, ++asked);
                control(ENABLE | NEW);
                bit = true;
            } else if (bit && (status() & ACKNOWLEDGED) != 0) {
                taken++;
                control(ENABLE);
                bit = false;
            }
            break;
        case 1:
            canopen.place.in_position = random() % 2 != 0;
            follow();
            break;
        default:
            follow(random() % 3);
            break;
        }
        const auto present = int32_t(command.position.target / (REV / UNITS));
        if (command.position.order == POSITION_ORDER_PROFILE && present != arrived) {
            ASSERT_EQ(present, arrived + 1) << "in their order, each once";
            arrived = present;
        }
    }
    EXPECT_GT(taken, 1000);
    EXPECT_GE(arrived + 2, asked);
}

TEST_F(CanopenPosition, homing_begins_by_the_edge_after_a_halt_and_tells_its_end) {
    begin(6);
    EXPECT_EQ(write(0x6098, 0, 34), 0u);
    EXPECT_EQ(parameters.values[PARAMETER_HOMING_METHOD], POSITION_HOMING_INDEX_FORWARD);
    for (int32_t method : {0, 1, 17, 36, -3}) {
        EXPECT_EQ(write(0x6098, 0, method), 0x06090030u) << method;
    }
    write(0x607C, 0, UNITS / 4);
    write(0x609A, 0, 700);
    EXPECT_EQ(status() & (ACKNOWLEDGED | REACHED | ERROR), REACHED) << "not begun";
    for (const auto &[homed, fails] :
         {std::pair(true, false), std::pair(false, true), std::pair(true, true), std::pair(true, false)}) {
        canopen.place.sequence--; // a cycle that the loop has missed
        control(ENABLE | NEW);
        cycle(3);
        EXPECT_EQ(command.position.order, POSITION_ORDER_HALT) << "the loop has not seen the halt";
        follow();
        EXPECT_EQ(command.position.order, POSITION_ORDER_HOME);
        EXPECT_EQ(command.position.homing, POSITION_HOMING_METHODS) << "by the parameter";
        EXPECT_DOUBLE_EQ(target_rev(), -0.25);
        EXPECT_EQ(command.position.acceleration_rpm_s, 700);
        canopen.place.homing = true;
        canopen.place.homed = canopen.place.homing_failed = false;
        follow(5);
        EXPECT_EQ(status() & (ACKNOWLEDGED | REACHED | ERROR), 0u) << "under way";
        canopen.place.homing = false;
        canopen.place.homed = homed; // also where the way back from its place fails
        canopen.place.homing_failed = fails;
        follow(2);
        EXPECT_EQ(status() & (ACKNOWLEDGED | REACHED | ERROR), REACHED | (fails ? ERROR : ACKNOWLEDGED));
        EXPECT_EQ(command.position.order, POSITION_ORDER_HALT);
        control(ENABLE);
        follow(2);
    }
}

TEST_F(CanopenPosition, a_homing_ends_with_its_bit_and_with_a_halt) {
    for (unsigned end : {ENABLE, ENABLE | NEW | HALT}) {
        begin(6);
        control(ENABLE | NEW);
        follow();
        EXPECT_EQ(command.position.order, POSITION_ORDER_HOME);
        canopen.place.homing = true;
        follow(2);
        control(end);
        follow(2);
        EXPECT_EQ(command.position.order, POSITION_ORDER_HALT);
        EXPECT_EQ(status() & (ACKNOWLEDGED | REACHED | ERROR), REACHED) << "interrupted";
        control(ENABLE);
        canopen.place = {};
        control(0);
        cycle(3);
    }
}

TEST_F(CanopenPosition, a_homing_that_is_begun_anew_between_two_cycles_halts_first) {
    begin(6);
    control(ENABLE | NEW);
    follow();
    canopen.place.homing = true;
    follow();
    ASSERT_EQ(command.position.order, POSITION_ORDER_HOME);
    const uint32_t before = command.position.sequence;
    control(ENABLE);
    control(ENABLE | NEW);
    follow();
    EXPECT_EQ(command.position.order, POSITION_ORDER_HALT);
    EXPECT_EQ(command.position.sequence, before + 1);
    canopen.place.homing = false;
    follow();
    EXPECT_EQ(command.position.order, POSITION_ORDER_HOME) << "once the loop has seen the halt";
    EXPECT_EQ(command.position.sequence, before + 2);
    EXPECT_EQ(status() & (ACKNOWLEDGED | REACHED | ERROR), 0u) << "under way";
}

TEST_F(CanopenPosition, each_write_is_a_cyclic_target) {
    begin(8);
    write(0x60C2, 1, 4);
    EXPECT_EQ(status() & ACKNOWLEDGED, 0u) << "follows nothing yet";
    for (int32_t target : {100, 200, 200}) {
        const uint32_t before = command.position.sequence;
        write(0x607A, 0, target);
        follow(2);
        EXPECT_EQ(command.position.order, POSITION_ORDER_CYCLIC);
        EXPECT_EQ(command.position.target, target * (REV / UNITS));
        EXPECT_NE(command.position.sequence, before) << "two equal targets are two";
        EXPECT_EQ(command.position.cycle_ms, 4u);
        EXPECT_NE(status() & ACKNOWLEDGED, 0u);
    }
    const uint32_t last = command.position.sequence;
    follow(20);
    EXPECT_EQ(command.position.sequence, last);
    EXPECT_EQ(status() & ACKNOWLEDGED, 0u) << "the master is late";
    control(ENABLE | HALT);
    write(0x607A, 0, 300);
    follow(2);
    EXPECT_EQ(command.position.order, POSITION_ORDER_HALT);
}

TEST_F(CanopenPosition, a_following_error_is_bit_13_and_an_emergency_until_it_ends) {
    begin(1);
    set_point(UNITS);
    sent();
    canopen.place.following_error = true;
    follow();
    EXPECT_EQ(sent().front(), (sent_t{0x80 + NODE, {0x11, 0x86, 0x21, 0, 0, 0, 0, 0}}));
    EXPECT_NE(status() & ERROR, 0u);
    EXPECT_EQ(read(0x603F, 0), 0x8611u);
    control(ENABLE | HALT);
    follow(2);
    EXPECT_EQ(command.position.order, POSITION_ORDER_HALT) << "acknowledges";
    sent();
    canopen.place.following_error = false;
    follow();
    EXPECT_EQ(sent().front(), (sent_t{0x80 + NODE, {0, 0, 0, 0, 0, 0, 0, 0}}));
    EXPECT_EQ(status() & ERROR, 0u);
}

// The position loop takes an order halt with this mark for one that acknowledges when its sequence is new.
TEST_F(CanopenPosition, a_following_error_while_the_drive_holds_is_acknowledged_by_a_halt_or_another_mode) {
    begin(1);
    for (const bool by_mode : {false, true, false}) {
        const uint32_t before = command.position.sequence;
        follow(5);
        ASSERT_EQ(command.position.sequence, before);
        if (by_mode) {
            write(0x6060, 0, 6);
        } else {
            control(ENABLE | HALT);
        }
        follow(5);
        EXPECT_EQ(command.position.order, POSITION_ORDER_HALT);
        EXPECT_TRUE(command.position.acknowledges);
        EXPECT_EQ(command.position.sequence, before + 1);
        control(ENABLE);
        follow(5);
        EXPECT_EQ(command.position.sequence, before + 1) << "not by the end of the halt";
    }
    write(0x6060, 0, 1);
    follow(2);
    set_point(UNITS);
    EXPECT_FALSE(command.position.acknowledges);
}

TEST_F(CanopenPosition, stops_are_ramps_of_the_velocity) {
    for (unsigned word : {0x02u, 0x07u}) { // quick stop, disable operation
        begin(1);
        set_point(10 * UNITS);
        values.motion.speed_rpm = 200000;
        follow(2);
        control(word);
        follow(2);
        EXPECT_EQ(command.request, COMMAND_RUN);
        EXPECT_EQ(command.mode, DRIVE_MODE_SPEED);
        EXPECT_GT(command.speed_reference_q22, 0);
        values.motion.speed_rpm = 0;
        follow(500);
        EXPECT_EQ(command.request, COMMAND_OFF) << word;
        control(0);
        cycle(3);
    }
}

TEST_F(CanopenPosition, another_mode_in_a_move_begins_with_what_there_is) {
    begin(1);
    set_point(10 * UNITS);
    values.motion.speed_rpm = 200000;
    write(0x6060, 0, 3);
    follow();
    EXPECT_EQ(command.mode, DRIVE_MODE_SPEED);
    EXPECT_NEAR(command.speed_reference_q22, 199 * 0.10471976 * (1 << 22), 1 << 22);
    canopen.place.position = 7 * REV;
    for (int32_t mode : {8, 6, 1}) {
        write(0x6060, 0, mode);
        follow(2);
        EXPECT_EQ(command.mode, DRIVE_MODE_POSITION);
        EXPECT_EQ(command.position.order, POSITION_ORDER_HALT) << mode;
    }
    set_point(UNITS, RELATIVE);
    EXPECT_DOUBLE_EQ(target_rev(), 8.0);
}

TEST_F(CanopenPosition, limits_are_ordered_and_reach_the_drive) {
    EXPECT_EQ(write(0x607D, 1, -1000), 0u);
    EXPECT_EQ(write(0x607D, 2, -1000), 0x06090036u);
    EXPECT_EQ(write(0x607D, 2, 500), 0u);
    EXPECT_EQ(write(0x607D, 1, 501), 0x06090036u);
    begin(1);
    EXPECT_EQ(command.position.lowest, -1000 * (REV / UNITS));
    EXPECT_EQ(command.position.highest, 500 * (REV / UNITS));
    write(0x607E, 0, 0x80);
    follow();
    EXPECT_EQ(command.position.lowest, -500 * (REV / UNITS));
    EXPECT_EQ(command.position.highest, 1000 * (REV / UNITS));
    canopen.place.limited = true;
    follow();
    EXPECT_NE(status() & 0x800u, 0u) << "internal limit";
}

TEST_F(CanopenPosition, windows_and_homing_speed_are_the_parameters) {
    EXPECT_EQ(write(0x6065, 0, UNITS / 36), 0u);
    EXPECT_NEAR(parameters.values[PARAMETER_FOLLOWING_ERROR_DEG], 10 << 7, 1);
    EXPECT_NEAR(int32_t(read(0x6065, 0)), UNITS / 36, 3);
    EXPECT_EQ(write(0x6065, 0, 0), 0x06090030u) << "below the parameter's range";
    EXPECT_EQ(write(0x6065, 0, -1), 0x06090031u) << "cannot be switched off";
    EXPECT_EQ(write(0x6067, 0, UNITS / 360), 0u);
    EXPECT_NEAR(parameters.values[PARAMETER_POSITION_WINDOW_DEG], 1 << 15, 90);
    EXPECT_EQ(write(0x6099, 1, 90), 0u);
    EXPECT_EQ(parameters.values[PARAMETER_HOMING_SPEED_RPM], 90);
    EXPECT_EQ(read(0x6099, 2), 90u);
    EXPECT_EQ(write(0x6099, 2, 2000000), 0x06090030u);
}

TEST_F(CanopenPosition, positions_convert_to_nearest_for_any_factor) {
    std::mt19937 random{608};
    for (unsigned i = 0; i < 20000; i++) {
        const auto any = [&](uint32_t most) { return int32_t(1 + (random() >> random() % 28) % most); };
        canopen.values[CANOPEN_VALUE_FEED] = any(1 << 24);
        canopen.values[CANOPEN_VALUE_FEED_SHAFT] = any(1023);
        canopen.values[CANOPEN_VALUE_GEAR_MOTOR] = any(1023);
        canopen.values[CANOPEN_VALUE_GEAR_SHAFT] = any(1023);
        canopen.values[CANOPEN_VALUE_POLARITY] = random() % 2 ? 0x80 : 0;
        const auto units = int32_t(random()) >> random() % 31;
        const long double per_unit = (long double)canopen.values[CANOPEN_VALUE_FEED_SHAFT] *
                                     canopen.values[CANOPEN_VALUE_GEAR_MOTOR] / canopen.values[CANOPEN_VALUE_FEED] /
                                     canopen.values[CANOPEN_VALUE_GEAR_SHAFT] *
                                     (canopen.values[CANOPEN_VALUE_POLARITY] != 0 ? -1 : 1);
        const int64_t position = canopen_position_q32(&canopen, units);
        const long double expected = units * per_unit * REV;
        if (std::abs(expected) < 0x1p51L) {
            ASSERT_LE(std::abs(position - expected), 1.0L);
        } else {
            ASSERT_GE(std::abs((long double)position), 0x1p50L);
        }
        const int64_t place = int64_t(uint64_t(random()) << 32 | random()) >> (18 + random() % 40);
        const long double back = std::min(std::max(place / (per_unit * REV), -0x1p31L), 0x1p31L);
        ASSERT_LE(std::abs(canopen_position_units(&canopen, place) - back), 1.6L);
    }
}

} // namespace
