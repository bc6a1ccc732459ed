// Telemetry and reception as a whole: schedule, three mailboxes, dropped frames, and bounded work per call.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <deque>
#include <vector>

#include <gtest/gtest.h>

extern "C" {
#include "comms/comms.h"
#include "drive/telemetry_collect.h"
#include "drive_codec.h"
#include "hal_nvm.h"
}
#include "support/frames.h"

// The CAN side of the HAL: frames to receive, three mailboxes, and what left them.
struct hal {
    std::deque<hal_can_frame_t> received;
    std::vector<hal_can_frame_t> mailboxes;
    std::vector<hal_can_frame_t> sent;
    uint32_t overflows = 0;
    unsigned received_calls = 0;

    // Transmits the mailbox that wins arbitration if its identifier is below `limit`; other nodes occupy the bus from
    // there.
    bool carry(uint32_t limit = 0x800) {
        const auto lowest = std::min_element(mailboxes.begin(), mailboxes.end(),
                                             [](const auto &a, const auto &b) { return a.identifier < b.identifier; });
        if (lowest == mailboxes.end() || lowest->identifier >= limit) {
            return false;
        }
        sent.push_back(*lowest);
        mailboxes.erase(lowest);
        return true;
    }

    unsigned count(uint32_t identifier) const {
        return unsigned(
            std::count_if(sent.begin(), sent.end(), [&](const auto &frame) { return frame.identifier == identifier; }));
    }
};

extern "C" {
bool hal_can_receive(hal_t *hal, hal_can_frame_t *frame) {
    hal->received_calls++;
    if (hal->received.empty()) {
        return false;
    }
    *frame = hal->received.front();
    hal->received.pop_front();
    return true;
}

uint32_t hal_can_receive_overflows(const hal_t *hal) {
    return hal->overflows;
}

uint64_t hal_nvm_read(const hal_t *, unsigned, unsigned) {
    return HAL_NVM_ERASED;
}
bool hal_nvm_program(hal_t *, unsigned, unsigned, uint64_t) {
    return false;
}
bool hal_nvm_erase(hal_t *, unsigned) {
    return false;
}
uint32_t hal_random_u32(hal_t *) {
    return 4711;
}

bool hal_can_transmit(hal_t *hal, const hal_can_frame_t *frame) {
    if (hal->mailboxes.size() == 3) {
        return false;
    }
    hal->mailboxes.push_back(*frame);
    return true;
}

void hal_can_status(const hal_t *hal, hal_can_status_t *status) {
    *status = {};
    status->transmitting = !hal->mailboxes.empty();
}

void hal_can_rejoin(hal_t *) {}
}

namespace {

constexpr uint32_t STEP_US = 25;

class Comms : public testing::Test {
  protected:
    Comms() {
        drive.control.state_machine.state = DRIVE_STATE_RUN;
        parameters_init(&parameters);
        parameters_set_control_rate(&parameters, 40000);
        objects.parameters = &parameters;
        parameters_set(&parameters, PARAMETER_TELEMETRY_PERIOD_MS, 1);
        comms_init(&comms, 0, 0);
    }

    // One cycle of telemetry from the drive's state.
    void report(uint32_t at_us) {
        drive_telemetry_t values;
        bus_monitor_step(&comms.bus, &bus, at_us);
        telemetry_collect(&drive, &bus, at_us, &values);
        comms_telemetry(&comms, &bus, &values);
    }

    // The drive's background and the bus, until `until_us`; other nodes hold the bus for identifiers from `limit` on.
    void run(uint32_t until_us, uint32_t limit = 0x800) {
        for (; time_us < until_us; time_us += STEP_US) {
            if (time_us % frame_us == 0) {
                bus.carry(limit);
            }
            if (comms_telemetry_due(&comms, time_us)) {
                report(time_us);
            }
            if (comms_background(&comms, &bus, &objects, DRIVE_STATE_READY, time_us)) {
                accepted.push_back(comms.command);
            }
        }
    }

    static hal_can_frame_t request(unsigned operation, unsigned index, int32_t value = 0) {
        return frames::parameter_request(operation, index, 0, value);
    }

    static hal_can_frame_t command(uint8_t counter, unsigned request_value) {
        return frames::command(counter, request_value, 0);
    }

    // The first frame with this identifier that left; zeros when none did.
    hal_can_frame_t first(uint32_t identifier) const {
        const auto found = std::find_if(bus.sent.begin(), bus.sent.end(),
                                        [&](const auto &frame) { return frame.identifier == identifier; });
        EXPECT_NE(found, bus.sent.end()) << identifier;
        return found == bus.sent.end() ? hal_can_frame_t{} : *found;
    }

    hal bus;
    drive_t drive{};
    comms_t &comms = drive.comms;
    parameters_t &parameters = drive.parameters;
    comms_objects_t objects{};
    uint32_t time_us = 0;
    uint32_t frame_us = 125; // a frame on the bus, rounded to steps
    std::vector<command_t> accepted;
};

TEST_F(Comms, frames_come_at_their_rates) {
    run(1003000);
    // 1003 cycles; the last may still be on its way
    EXPECT_NEAR(bus.count(DRIVE_STATUS_FRAME_ID), 1003, 1);
    EXPECT_NEAR(bus.count(DRIVE_MOTION_FRAME_ID), 1003, 1);
    EXPECT_NEAR(bus.count(DRIVE_TORQUE_FRAME_ID), 1003, 1);
    EXPECT_NEAR(bus.count(DRIVE_CURRENTS_FRAME_ID), 1003, 1);
    EXPECT_EQ(bus.count(DRIVE_BP_PID_FRAME_ID), 101u);
    EXPECT_EQ(bus.count(DRIVE_ADAPTATION_FRAME_ID), 101u);
    EXPECT_EQ(bus.count(DRIVE_HEARTBEAT_FRAME_ID), 11u);
    EXPECT_EQ(bus.count(DRIVE_COMMAND_COUNTERS_FRAME_ID), 11u);
    EXPECT_EQ(bus.count(DRIVE_BUS_COUNTERS_FRAME_ID), 11u);
    EXPECT_EQ(bus.count(DRIVE_PROCESSOR_FRAME_ID), 11u);
    EXPECT_EQ(bus.count(DRIVE_DEFERRED_FRAME_ID), 11u);
    EXPECT_EQ(bus.count(DRIVE_BUS_STATE_FRAME_ID), 11u);
    EXPECT_EQ(bus.count(DRIVE_IDENTITY_FRAME_ID), 10u);
    EXPECT_EQ(bus.count(DRIVE_FAULT_CAUSE_FRAME_ID), 0u);
    EXPECT_EQ(bus.count(DRIVE_FAULT_MASK_FRAME_ID), 0u);
    EXPECT_EQ(comms.telemetry.dropped, 0);
}

TEST_F(Comms, signals_carry_the_state_of_the_drive) {
    control_parameters_t &p = drive.control_parameters;
    control_state_t &control = drive.control;
    p.controller = DRIVE_CONTROLLER_SALIENT;
    p.torque_law = TORQUE_LAW_PREDICTIVE;
    control.state_machine.record.fault = FAULT_ENCODER;
    control.deferred.mode = DRIVE_MODE_TORQUE;
    control.state_machine.start_inhibit_mask = uint32_t(FAULT_BIT(FAULT_UNDER_VOLTAGE) | FAULT_BIT(FAULT_OVER_SPEED));
    control.observer.speed_q22 = int32_t(std::lround(-600 * 2 * M_PI / 60 * 4194304));
    control.deferred.response.results[0].speed.speed_reference_q22 =
        int32_t(std::lround(150 * 2 * M_PI / 60 * 4194304));
    control.measurement.angle = 0x40000000;
    control.torque_reference_q24 = int32_t(19.1 * (1 << 24));
    control.measurement.torque_sum_q24 = INT32_MAX;
    control.observer.load_torque_q24 = -8 * (1 << 24);
    control.measurement.dc_link_voltage_q6 = 240 * 64;
    control.measurement.current_q9[0] = 20 * 512;
    control.measurement.current_q9[3] = 65535;
    p.duty.pid.error_scale_inverse_q24 = 1 << 24;
    control.duty.pid.gain_q24[0] = 16384 << 9;
    control.duty.pid.gain_q24[2] = 70000 << 9;
    control.duty.pid.duty_q23 = -32769 * 256;
    for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
        control.deferred.misalignment.phase[phase].offset = (1 << 20) * machine_tables.rotor_poles;
    }
    control.predictive.torque_shortfall_q24 = INT32_MAX;
    control.deferred.conduction.single_pulse = true;
    p.bandwidth.stage[control.bandwidth.stage].bandwidth_rad_s = 8000;
    drive.used_ticks = 3000;
    drive.worst_ticks = 4999;
    p.period_ticks = 2500;
    drive.processor_time_q24 = 1 << 24; // 200 MHz
    drive.control.protection.late_interrupts = 70000;
    drive.deferred_used_ticks = 4000;
    drive.deferred_worst_ticks = 9001;
    control.deferred_request.skipped_total = 70001;
    run(3000);

    drive_status_t status;
    drive_status_unpack(&status, first(DRIVE_STATUS_FRAME_ID).data, 8);
    EXPECT_EQ(status.time_us, 0u);
    EXPECT_EQ(status.state, DRIVE_STATE_RUN);
    EXPECT_EQ(status.controller, 2);
    EXPECT_EQ(status.fault, 5);
    EXPECT_EQ(status.voltage_saturated, 1);
    EXPECT_EQ(status.mode, DRIVE_MODE_TORQUE);
    EXPECT_EQ(status.start_inhibited_by, FAULT_UNDER_VOLTAGE);
    EXPECT_EQ(status.single_pulse, 1);
    drive_motion_t motion;
    drive_motion_unpack(&motion, first(DRIVE_MOTION_FRAME_ID).data, 8);
    EXPECT_EQ(motion.speed_rpm, -600000);
    EXPECT_EQ(motion.speed_reference_rpm, 150000);
    EXPECT_EQ(motion.rotor_angle_deg, 0x4000);
    drive_torque_t torque;
    drive_torque_unpack(&torque, first(DRIVE_TORQUE_FRAME_ID).data, 8);
    EXPECT_EQ(torque.torque_reference_nm, 4890); // 19.1 N m is 4889.6 LSB
    EXPECT_EQ(torque.torque_estimate_nm, 32767);
    EXPECT_EQ(torque.load_torque_estimate_nm, -2048);
    EXPECT_EQ(torque.bus_voltage_v, 15360);
    drive_currents_t currents;
    drive_currents_unpack(&currents, first(DRIVE_CURRENTS_FRAME_ID).data, 8);
    EXPECT_EQ(currents.current_a_a, 10240);
    EXPECT_EQ(currents.current_d_a, 65535);
    drive_bp_pid_t gains;
    drive_bp_pid_unpack(&gains, first(DRIVE_BP_PID_FRAME_ID).data, 8);
    EXPECT_EQ(gains.kp_per_nm, 16384);
    EXPECT_EQ(gains.kd_per_nm, 65535);
    EXPECT_EQ(gains.duty, -32768);
    drive_adaptation_t adaptation;
    drive_adaptation_unpack(&adaptation, first(DRIVE_ADAPTATION_FRAME_ID).data, 8);
    EXPECT_EQ(adaptation.misalignment_deg, 256);
    EXPECT_EQ(adaptation.torque_missing_nm, 32767);
    EXPECT_EQ(adaptation.observer_bandwidth_rad_s, 8000);
    drive_processor_t processor;
    drive_processor_unpack(&processor, first(DRIVE_PROCESSOR_FRAME_ID).data, 8);
    EXPECT_EQ(processor.used_us, 3000);
    EXPECT_EQ(processor.worst_us, 4999);
    EXPECT_EQ(processor.available_us, 5000);
    EXPECT_EQ(processor.late_interrupts, 65535);
    drive_deferred_t deferred;
    drive_deferred_unpack(&deferred, first(DRIVE_DEFERRED_FRAME_ID).data, 6);
    EXPECT_EQ(deferred.used_us, 4000);
    EXPECT_EQ(deferred.worst_us, 9001);
    EXPECT_EQ(deferred.skipped_periods, 65535);
    drive_heartbeat_t heartbeat;
    drive_heartbeat_unpack(&heartbeat, first(DRIVE_HEARTBEAT_FRAME_ID).data, 8);
    EXPECT_EQ(heartbeat.state, DRIVE_STATE_RUN);
    EXPECT_EQ(heartbeat.controller, 2);
    EXPECT_EQ(heartbeat.phases, 3);
    EXPECT_EQ(heartbeat.control_rate_hz, 40000u);
}

TEST_F(Comms, a_fault_is_reported_with_the_next_cycle_and_every_100_ms) {
    run(10500);
    drive.control.state_machine.state = DRIVE_STATE_FAULT;
    fault_record_t &record = drive.control.state_machine.record;
    record.time_us = 10400;
    record.fault = FAULT_OVER_CURRENT;
    record.state = DRIVE_STATE_RUN;
    record.fault_mask = 0x0022;
    record.speed_q22 = -1000 * 439231;
    record.dc_link_voltage_q6 = 15360;
    record.current_max_q9 = 36000;
    record.torque_reference_q24 = 1 << 24;
    run(12000);
    ASSERT_EQ(bus.count(DRIVE_FAULT_CAUSE_FRAME_ID), 1u);
    ASSERT_EQ(bus.count(DRIVE_FAULT_SNAPSHOT_FRAME_ID), 1u);
    ASSERT_EQ(bus.count(DRIVE_FAULT_MASK_FRAME_ID), 1u);
    for (const auto &frame : bus.sent) {
        if (frame.identifier == DRIVE_FAULT_CAUSE_FRAME_ID) {
            drive_fault_cause_t cause;
            drive_fault_cause_unpack(&cause, frame.data, 8);
            EXPECT_EQ(cause.time_us, 10400u);
            EXPECT_EQ(cause.fault, 1);
            EXPECT_EQ(cause.state, DRIVE_STATE_RUN);
            EXPECT_EQ(cause.checks, 0x0022);
        } else if (frame.identifier == DRIVE_FAULT_SNAPSHOT_FRAME_ID) {
            drive_fault_snapshot_t values;
            drive_fault_snapshot_unpack(&values, frame.data, 8);
            EXPECT_EQ(values.speed_rpm, -4000); // 1000 r/min in quarters
            EXPECT_EQ(values.bus_voltage_v, 15360);
            EXPECT_EQ(values.current_max_a, 36000);
            EXPECT_EQ(values.torque_reference_nm, 256);
        } else if (frame.identifier == DRIVE_FAULT_MASK_FRAME_ID) {
            drive_fault_mask_t mask;
            drive_fault_mask_unpack(&mask, frame.data, 8);
            EXPECT_EQ(mask.over_current, 1);
            EXPECT_EQ(mask.encoder, 1);
            EXPECT_EQ(mask.over_voltage + mask.under_voltage + mask.over_speed + mask.command_timeout +
                          mask.interrupt_overrun + mask.identifier_conflict,
                      0);
        }
    }
    run(211900);
    EXPECT_EQ(bus.count(DRIVE_FAULT_CAUSE_FRAME_ID), 3u);
    record.time_us = 211900; // cleared and another between two cycles
    run(213000);
    EXPECT_EQ(bus.count(DRIVE_FAULT_CAUSE_FRAME_ID), 4u);
    drive.control.state_machine.state = DRIVE_STATE_RUN;
    run(500000);
    EXPECT_EQ(bus.count(DRIVE_FAULT_CAUSE_FRAME_ID), 4u);
}

TEST_F(Comms, loads_of_windings_and_switches_are_hundredths_of_a_percent_of_the_hottest) {
    for (const auto &[load, expected] :
         {std::pair{0.0, 0u}, std::pair{0.25, 2500u}, std::pair{1.0, 10000u}, std::pair{63.0, 630000u}}) {
        drive.thermal = {};
        drive.thermal.winding_q56[2] = int64_t(load * 0x1p56);
        drive.thermal.switches_q56[1] = int64_t(load * 0x1p55);
        drive_telemetry_t values;
        telemetry_collect(&drive, &bus, 0, &values);
        EXPECT_EQ(values.thermal.winding_load, expected);
        EXPECT_EQ(values.thermal.switch_load, expected / 2);
    }
}

TEST_F(Comms, a_lost_phase_is_named_with_the_torque_that_is_left_and_without_one_there_is_nothing) {
    for (unsigned phase = 0; phase < 5; phase++) {
        drive.degraded = {};
        drive.degraded.lost = phase < 4 ? 1u << phase : 0u;
        drive.degraded.mean_q24 = 6 << 24;
        drive.degraded.least_q24 = -(2 << 24);
        drive_telemetry_t values;
        telemetry_collect(&drive, &bus, 0, &values);
        const bool lost = phase < 4;
        EXPECT_EQ(values.degraded.degraded, lost);
        EXPECT_EQ(values.degraded.lost_phase_a, phase == 0);
        EXPECT_EQ(values.degraded.lost_phase_b, phase == 1);
        EXPECT_EQ(values.degraded.lost_phase_c, phase == 2);
        EXPECT_EQ(values.degraded.lost_phase_d, phase == 3);
        EXPECT_EQ(values.degraded.torque_mean_nm, lost ? 6 * 256 : 0);
        EXPECT_EQ(values.degraded.torque_least_nm, lost ? -2 * 256 : 0);
        drive.degraded.mean_q24 = 0; // the sum is not complete
        telemetry_collect(&drive, &bus, 0, &values);
        EXPECT_EQ(values.degraded.torque_mean_nm, 0);
        EXPECT_EQ(values.degraded.torque_least_nm, 0);
    }
}

TEST_F(Comms, failed_sensors_and_checks_have_a_bit_each) {
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        drive.temperature.failed_sensors[TEMPERATURE_WINDING] = uint8_t(1u << phase);
        drive.temperature.failed_sensors[TEMPERATURE_INVERTER] = 0;
        EXPECT_EQ(telemetry_self_test(&drive), phase < 4 ? 1u << phase : 0u);
        EXPECT_EQ(telemetry_sensors_e_f(&drive), phase < 4 ? 0u : 1u << (phase - 4));
        drive.temperature.failed_sensors[TEMPERATURE_WINDING] = 0;
        drive.temperature.failed_sensors[TEMPERATURE_INVERTER] = uint8_t(1u << phase);
        EXPECT_EQ(telemetry_self_test(&drive), phase < 4 ? 16u << phase : 0u);
        EXPECT_EQ(telemetry_sensors_e_f(&drive), phase < 4 ? 0u : 4u << (phase - 4));
    }
    drive.temperature = {};
    drive.self_test.failed = 1;
    EXPECT_EQ(telemetry_self_test(&drive), 1u << SELF_TEST_TELEMETRY_BIT);
}

TEST_F(Comms, the_misalignment_is_the_mean_of_the_phases_that_the_machine_has) {
    const int32_t part = (1 << 24) * machine_tables.rotor_poles;
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        for (unsigned other = 0; other < HAL_PHASES_MAX; other++) {
            drive.control.deferred.misalignment.phase[other].offset = other == phase ? part : 0;
        }
        drive_telemetry_t values;
        telemetry_collect(&drive, &bus, 0, &values);
        const double expected = phase < machine_tables.phases ? 4096.0 / machine_tables.phases : 0.0;
        EXPECT_NEAR(values.adaptation.misalignment_deg, expected, 0.51) << phase;
    }
}

TEST_F(Comms, a_blocked_bus_drops_whole_cycles_and_keeps_the_oldest) {
    run(50500, 0); // nothing leaves: three frames in mailboxes, a full queue
    EXPECT_GT(comms.telemetry.dropped, 0);
    run(51500); // the cycle that begins while the queue is still full
    const uint16_t dropped = comms.telemetry.dropped;
    run(60000);
    const std::vector<hal_can_frame_t> &sent = bus.sent;
    drive_status_t status;
    std::vector<int> cycles;
    for (size_t i = 0; i < sent.size(); i++) {
        if (sent[i].identifier == DRIVE_STATUS_FRAME_ID && i + 3 < sent.size()) {
            drive_status_unpack(&status, sent[i].data, 8);
            cycles.push_back(status.cycle);
        }
    }
    for (const uint32_t identifier : {DRIVE_MOTION_FRAME_ID, DRIVE_TORQUE_FRAME_ID, DRIVE_CURRENTS_FRAME_ID}) {
        EXPECT_NEAR(bus.count(identifier), bus.count(DRIVE_STATUS_FRAME_ID), 1);
    }
    ASSERT_GE(cycles.size(), 4u);
    EXPECT_EQ(cycles[0], 0); // the oldest
    EXPECT_EQ(cycles[1], 1);
    EXPECT_GE(cycles.back(), 57); // and the present again
    EXPECT_EQ(comms.telemetry.dropped, dropped) << "nothing is dropped once the bus is free";
}

TEST_F(Comms, dropped_frames_are_counted_exactly) {
    run(100000, 0); // 100 cycles: 400 + 10 BP_PID + 10 ADAPTATION + 11 of the group counters + identity + heartbeat
    const unsigned waiting = unsigned(bus.mailboxes.size()) + comms.telemetry.queue.count;
    EXPECT_EQ(comms.telemetry.dropped + waiting, 434u);
}

TEST_F(Comms, others_above_the_heartbeat_cannot_block_telemetry) {
    run(1990500, 0x700);
    EXPECT_NEAR(bus.count(DRIVE_STATUS_FRAME_ID), 1991, 1);
    EXPECT_EQ(bus.count(DRIVE_HEARTBEAT_FRAME_ID), 0u);
    EXPECT_EQ(comms.telemetry.dropped, 19 + 20); // heartbeats and identities after the heartbeat that waits
    run(2200000);
    EXPECT_GE(bus.count(DRIVE_HEARTBEAT_FRAME_ID), 2u);
    EXPECT_EQ(comms.telemetry.dropped, 19 + 20);
    EXPECT_GE(bus.count(DRIVE_IDENTITY_FRAME_ID), 1u);
}

TEST_F(Comms, own_telemetry_that_the_bus_does_not_take_lets_the_heartbeat_pass) {
    frame_us = 500; // the fast telemetry alone is twice what the bus takes
    run(2000500);
    EXPECT_NEAR(bus.count(DRIVE_HEARTBEAT_FRAME_ID), 20, 1);
    EXPECT_GT(comms.telemetry.dropped, 4000);
    EXPECT_LT(comms.telemetry.dropped, 5000);
    EXPECT_GT(bus.count(DRIVE_STATUS_FRAME_ID), 800u);
}

TEST_F(Comms, the_heartbeat_survives_a_pause_of_telemetry_in_which_other_nodes_fill_the_bus) {
    frame_us = 500;
    run(12000);
    ASSERT_TRUE(comms.telemetry.background_in_mailbox);
    const uint32_t entered_us = comms.telemetry.background_us;
    run(entered_us + TELEMETRY_PATIENCE_US);
    ASSERT_EQ(bus.count(DRIVE_HEARTBEAT_FRAME_ID), 0u);
    run(entered_us + TELEMETRY_PATIENCE_US + TELEMETRY_PAUSE_US + 1000, 0);
    run(2000500);
    EXPECT_NEAR(bus.count(DRIVE_HEARTBEAT_FRAME_ID), 20, 1);
}

TEST_F(Comms, periods_follow_the_parameters_from_the_last_frame_on) {
    parameters_set(&parameters, PARAMETER_TELEMETRY_PERIOD_MS, 4);
    run(20500);
    parameters_set(&parameters, PARAMETER_TELEMETRY_PERIOD_MS, 7);
    parameters_set(&parameters, PARAMETER_TELEMETRY_SLOW_PERIOD_MS, 3);
    run(60500);
    parameters_set(&parameters, PARAMETER_TELEMETRY_PERIOD_MS, 1);
    run(64900);
    std::vector<int> fast;
    for (const auto &frame : bus.sent) {
        if (frame.identifier == DRIVE_STATUS_FRAME_ID) {
            fast.push_back(frame.data[7]);
        }
    }
    EXPECT_EQ(fast, (std::vector<int>{0, 4, 8, 12, 16, 20, 27, 34, 41, 48, 55, 61, 62, 63, 64}));
    EXPECT_EQ(bus.count(DRIVE_CURRENTS_FRAME_ID), fast.size());
    EXPECT_EQ(bus.count(DRIVE_ADAPTATION_FRAME_ID), 3u + 14u); // cycles 0, 10, 20; 23, 26 to 62
    EXPECT_EQ(comms.telemetry.dropped, 0);
}

TEST_F(Comms, a_node_has_identifiers_of_its_own_and_ignores_those_of_others) {
    comms_init(&comms, 5, 0);
    for (const uint32_t other : {0x080u, 0x0E0u, 0x181u, 0x590u, 0x640u, 0x770u}) {
        bus.received.push_back(hal_can_frame_t{other, false, false, 7, {}});
    }
    bus.received.push_back(hal_can_frame_t{0x0D0, false, false, 6, {}});
    bus.received.push_back(hal_can_frame_t{0x100, false, false, 6, {}});
    hal_can_frame_t read = request(DRIVE_PARAMETER_REQUEST_OPERATION_READ_CHOICE, PARAMETER_COMMAND_TIMEOUT_MS);
    read.identifier += 0x50;
    bus.received.push_back(read);
    run(106000);
    EXPECT_EQ(comms.commands.counters.wrong_length, 1);
    EXPECT_EQ(comms.commands.counters.unknown_frame, 1);
    EXPECT_EQ(comms.bus.foreign_count, 0);
    for (const auto &frame : bus.sent) {
        EXPECT_EQ(frame.identifier & 0x70, 0x50u);
    }
    EXPECT_EQ(bus.count(DRIVE_STATUS_FRAME_ID + 0x50), 106u);
    EXPECT_EQ(bus.count(DRIVE_HEARTBEAT_FRAME_ID + 0x50), 2u);
    EXPECT_GE(bus.count(DRIVE_ARMING_FRAME_ID + 0x50), 1u);
    EXPECT_EQ(bus.count(DRIVE_PARAMETER_RESPONSE_FRAME_ID + 0x50), 1u);
    bus.received.push_back(hal_can_frame_t{0x1D3, false, false, 8, {}});
    run(107000);
    EXPECT_EQ(comms.bus.foreign_count, 1) << "its own";
}

TEST_F(Comms, a_node_is_heard_and_named_whatever_bit_of_its_offset_flips) {
    for (unsigned bit = 0; bit < 32; bit++) {
        for (unsigned copy = 0; copy < (bit < 16 ? 3u : 2u); copy++) {
            comms_init(&comms, 5, 0);
            time_us = 0;
            bus.sent.clear();
            accepted.clear();
            run(500);
            if (copy == 2) {
                comms.commands.data_id_offset = uint16_t(comms.commands.data_id_offset ^ 1u << bit);
            } else {
                (copy == 0 ? comms.telemetry.identifier_offset : comms.node_offset) ^= UINT32_C(1) << bit;
            }
            hal_can_frame_t off{DRIVE_COMMAND_FRAME_ID + 0x50, false, false, 7, {}};
            e2e_protect(uint16_t(DRIVE_COMMAND_E2E_DATA_ID + 0x50), 1, off.data, 7);
            bus.received.push_back(off);
            run(3000);
            EXPECT_EQ(accepted.size(), 1u) << bit << ", " << copy;
            for (const auto &frame : bus.sent) {
                EXPECT_EQ(frame.identifier & 0x70, 0x50u) << bit << ", " << copy;
            }
        }
    }
}

TEST_F(Comms, a_flipped_bit_of_a_count_or_of_the_next_time_silences_no_telemetry) {
    const auto flipped = [this](auto &number, unsigned bit) {
        number = std::remove_reference_t<decltype(number)>(number ^ UINT32_C(1) << bit);
        bus.sent.clear();
        run(time_us + 120000);
        EXPECT_GE(bus.count(DRIVE_STATUS_FRAME_ID), 110u) << bit;
        EXPECT_LE(bus.count(DRIVE_STATUS_FRAME_ID), 125u) << bit;
        EXPECT_GE(bus.count(DRIVE_HEARTBEAT_FRAME_ID), 1u) << bit;
    };
    run(500);
    for (unsigned bit = 0; bit < 32; bit++) {
        flipped(comms.telemetry.next_us, bit);
    }
    for (uint16_t &count : comms.telemetry.countdown) {
        flipped(count, 15);
    }
}

TEST(FrameQueue, an_index_or_a_count_that_has_changed_leads_to_no_frame_outside_of_the_ring) {
    for (unsigned bit = 0; bit < 8; bit++) {
        frame_queue_t queue{};
        queue.count = uint8_t(1u << bit);
        EXPECT_LE(frame_queue_free(&queue), unsigned(FRAME_QUEUE_CAPACITY));
        queue.first = uint8_t(1u << bit);
        const hal_can_frame_t *frame = frame_queue_peek(&queue);
        EXPECT_GE(frame, &queue.frames[0]);
        EXPECT_LT(frame, &queue.frames[FRAME_QUEUE_CAPACITY]);
    }
}

TEST_F(Comms, a_command_of_one_node_is_valid_for_no_other) {
    for (unsigned node = 0; node < 8; node++) {
        comms_init(&comms, node, 0);
        for (unsigned sender = 0; sender < 8; sender++) {
            accepted.clear();
            for (const uint32_t base : {DRIVE_COMMAND_FRAME_ID, DRIVE_TORQUE_COMMAND_FRAME_ID}) {
                const uint16_t data_id =
                    base == DRIVE_COMMAND_FRAME_ID ? DRIVE_COMMAND_E2E_DATA_ID : DRIVE_TORQUE_COMMAND_E2E_DATA_ID;
                for (const uint32_t identifier : {DRIVE_COMMAND_FRAME_ID, DRIVE_TORQUE_COMMAND_FRAME_ID}) {
                    hal_can_frame_t frame{identifier + 16 * node, false, false, 7, {}};
                    e2e_protect(uint16_t(data_id + 16 * sender), uint8_t(accepted.size()), frame.data, 7);
                    bus.received.push_back(frame);
                    run(time_us + 1000);
                }
            }
            EXPECT_EQ(accepted.size(), sender == node ? 2u : 0u) << sender << " to " << node;
        }
        time_us = 0;
    }
}

TEST_F(Comms, the_identity_is_sent_in_the_middle_of_a_slow_cycle) {
    run(106000);
    std::vector<int> cycles;
    int cycle = -1;
    for (const auto &frame : bus.sent) {
        if (frame.identifier == DRIVE_STATUS_FRAME_ID) {
            cycle = frame.data[7];
        } else if (frame.identifier == DRIVE_IDENTITY_FRAME_ID) {
            cycles.push_back(cycle);
            drive_identity_t identity;
            drive_identity_unpack(&identity, frame.data, 8);
            EXPECT_EQ(identity.firmware_major, SALIENT_VERSION_MAJOR);
            EXPECT_EQ(identity.firmware_minor, SALIENT_VERSION_MINOR);
            EXPECT_EQ(identity.firmware_patch, SALIENT_VERSION_PATCH);
            EXPECT_EQ(identity.dbc_hash, machine_tables.dbc_hash);
        }
    }
    EXPECT_EQ(cycles, (std::vector<int>{5, 105}));
}

TEST_F(Comms, no_mailbox_is_lost_to_a_second_background_frame) {
    run(99500, 0); // nothing leaves
    run(500000, 0x700);
    EXPECT_LE(std::count_if(bus.mailboxes.begin(), bus.mailboxes.end(),
                            [](const auto &frame) { return frame.identifier >= 0x700; }),
              1);
}

// A message of a group that is due alone, and what keeps it from the queue.
TEST(Telemetry, a_background_frame_needs_a_place_and_none_of_its_kind_before_it_an_idle_one_no_backlog_either) {
    enum { NOTHING, QUEUED, IN_MAILBOX, FULL, BACKLOG, REASONS };
    for (const auto group : {DRIVE_TELEMETRY_GROUP_BACKGROUND, DRIVE_TELEMETRY_GROUP_IDLE}) {
        for (unsigned reason = NOTHING; reason < REASONS; reason++) {
            telemetry_t telemetry;
            telemetry_init(&telemetry, 0, 0);
            bool due = false;
            for (unsigned i = 0; i < DRIVE_TELEMETRY_MESSAGES; i++) {
                const bool now = !due && drive_telemetry_messages[i].group == group;
                telemetry.countdown[i] = now ? 0 : 1;
                due = due || now;
            }
            ASSERT_TRUE(due);
            telemetry.background_queued = reason == QUEUED;
            telemetry.background_in_mailbox = reason == IN_MAILBOX;
            telemetry.queue.count = reason == FULL ? FRAME_QUEUE_CAPACITY : reason == BACKLOG ? 1 : 0;
            const unsigned before = telemetry.queue.count;
            drive_telemetry_t values{};
            telemetry_cycle(&telemetry, &values);
            const bool taken = reason == NOTHING || (reason == BACKLOG && group == DRIVE_TELEMETRY_GROUP_BACKGROUND);
            EXPECT_EQ(telemetry.queue.count, before + taken) << group << ", " << reason;
            EXPECT_EQ(telemetry.dropped, taken ? 0 : 1) << group << ", " << reason;
        }
    }
}

TEST_F(Comms, missed_cycles_show_in_the_cycle_number_and_the_grid_stays) {
    run(2500);
    time_us = 7600; // the background was held up
    run(9500);
    std::vector<std::pair<int, uint32_t>> cycles;
    for (const auto &frame : bus.sent) {
        if (frame.identifier == DRIVE_STATUS_FRAME_ID) {
            drive_status_t status;
            drive_status_unpack(&status, frame.data, 8);
            cycles.emplace_back(status.cycle, status.time_us);
        }
    }
    const std::vector<std::pair<int, uint32_t>> expected = {{0, 0},    {1, 1000}, {2, 2000},
                                                            {3, 7600}, {8, 8000}, {9, 9000}};
    EXPECT_EQ(cycles, expected);
}

TEST_F(Comms, values_collected_just_before_the_cycle_is_due_keep_the_grid) {
    for (uint32_t cycle = 0; cycle < 10; cycle++) {
        ASSERT_TRUE(comms_telemetry_due(&comms, cycle * 1000));
        report(cycle * 1000 - 20);
        ASSERT_FALSE(comms_telemetry_due(&comms, cycle * 1000 + 999));
    }
}

TEST_F(Comms, values_collected_when_the_next_cycle_is_due_are_of_the_one_before_and_the_next_one_is_left_out) {
    ASSERT_TRUE(comms_telemetry_due(&comms, 0));
    report(0);
    for (uint32_t cycle = 1; cycle < 10; cycle++) {
        report(cycle * 2000); // due at 1,000 us less
        ASSERT_FALSE(comms_telemetry_due(&comms, cycle * 2000 + 999)) << cycle;
        ASSERT_TRUE(comms_telemetry_due(&comms, cycle * 2000 + 1000)) << cycle;
    }
}

TEST_F(Comms, cycles_go_on_across_the_wrap_of_the_clock) {
    const uint32_t start = UINT32_MAX - 2499;
    comms_init(&comms, 0, start);
    for (uint32_t elapsed = 0; elapsed < 10000; elapsed += STEP_US) {
        bus.carry();
        if (comms_telemetry_due(&comms, start + elapsed)) {
            report(start + elapsed);
        }
        comms_background(&comms, &bus, &objects, DRIVE_STATE_READY, start + elapsed);
    }
    EXPECT_EQ(bus.count(DRIVE_STATUS_FRAME_ID), 10u);
}

TEST_F(Comms, every_command_is_seen_in_order) {
    for (unsigned i = 0; i < 4; i++) {
        bus.received.push_back(command(uint8_t(i), i));
    }
    run(1000);
    ASSERT_EQ(accepted.size(), 4u);
    for (unsigned i = 0; i < 4; i++) {
        EXPECT_EQ(accepted[i].request, i == COMMAND_RUN ? COMMAND_OFF : i) << "not armed";
    }
    EXPECT_LT(accepted[0].time_us, accepted[1].time_us);
}

TEST_F(Comms, one_call_processes_a_bounded_number_of_frames) {
    bus.received.assign(HAL_CAN_RECEIVE_QUEUE, hal_can_frame_t{0x123, false, false, 8, {}});
    comms_background(&comms, &bus, &objects, DRIVE_STATE_READY, 0);
    EXPECT_EQ(bus.received.size(), size_t(HAL_CAN_RECEIVE_QUEUE - COMMS_FRAMES_PER_CALL));
    EXPECT_EQ(comms.commands.counters.unknown_frame, COMMS_FRAMES_PER_CALL);
}

TEST_F(Comms, one_call_of_canopen_processes_a_bounded_number_of_frames) {
    nvm_store_t store{};
    objects.store = &store;
    comms_choose(&comms, 5, 0);
    bus.received.assign(HAL_CAN_RECEIVE_QUEUE, hal_can_frame_t{0x123, false, false, 8, {}});
    comms_background(&comms, &bus, &objects, DRIVE_STATE_READY, 0);
    EXPECT_EQ(bus.received.size(), size_t(HAL_CAN_RECEIVE_QUEUE - COMMS_FRAMES_PER_CALL));
}

TEST_F(Comms, a_request_for_the_trace_is_answered_by_it) {
    objects.trace = &drive.trace;
    objects.control_parameters = &drive.control_parameters;
    bus.received.push_back(request(PARAMETER_OPERATION_FAULT_TRACE, 0));
    run(5000);
    drive_parameter_response_t response{};
    drive_parameter_response_unpack(&response, first(DRIVE_PARAMETER_RESPONSE_FRAME_ID).data, 8);
    EXPECT_EQ(response.operation, PARAMETER_OPERATION_FAULT_TRACE);
    EXPECT_EQ(response.status, PARAMETER_STATUS_NO_SUCH_ENTRY) << "no fault yet";
    EXPECT_EQ(bus.count(DRIVE_PARAMETER_RESPONSE_FRAME_ID), 1u);
}

TEST_F(Comms, requests_without_room_for_a_response_are_dropped_and_counted_and_the_others_are_answered_in_order) {
    for (unsigned i = 0; i < 60; i++) {
        bus.received.push_back(request(DRIVE_PARAMETER_REQUEST_OPERATION_READ_CHOICE, i % PARAMETER_COUNT));
    }
    bus.received.push_back(command(1, COMMAND_STOP));
    run(900, 0); // one cycle
    EXPECT_TRUE(bus.received.empty());
    EXPECT_EQ(accepted.size(), 1u) << "a command waits for no response";
    EXPECT_EQ(comms.telemetry.dropped, 60 - FRAME_QUEUE_CAPACITY);
    run(100000);
    unsigned answered = 0;
    for (const auto &frame : bus.sent) {
        if (frame.identifier == DRIVE_PARAMETER_RESPONSE_FRAME_ID) {
            EXPECT_EQ(frame.data[1], answered % PARAMETER_COUNT);
            answered++;
        }
    }
    EXPECT_EQ(answered, unsigned(FRAME_QUEUE_CAPACITY));
}

TEST_F(Comms, steps_of_a_set_do_not_make_the_drive_deaf_while_its_telemetry_is_more_than_the_bus_takes) {
    frame_us = 500;
    run(20000);
    for (unsigned i = 0; i < 40; i++) {
        bus.received.push_back(frames::parameter_set_control(uint8_t(i), PARAMETER_SET_STEP_ABANDON));
    }
    bus.received.push_back(command(1, COMMAND_OFF));
    run(21000);
    EXPECT_EQ(accepted.size(), 1u);
    EXPECT_TRUE(bus.received.empty());
    run(225000);
    EXPECT_NEAR(bus.count(DRIVE_PARAMETER_RESPONSE_FRAME_ID), FRAME_QUEUE_CAPACITY + 1, 1)
        << "the last ones in the pause for a heartbeat";
}

TEST_F(Comms, steps_of_a_set_that_keep_coming_starve_neither_commands_nor_telemetry_nor_the_heartbeat) {
    frame_us = 500;
    for (uint32_t ms = 0; ms < 2000; ms++) {
        bus.received.push_back(frames::parameter_set_control(uint8_t(ms), PARAMETER_SET_STEP_ABANDON));
        bus.received.push_back(frames::parameter_set_control(uint8_t(ms), PARAMETER_SET_STEP_ABANDON));
        if (ms % 10 == 0) {
            bus.received.push_back(command(uint8_t(ms / 10), COMMAND_OFF));
        }
        run((ms + 1) * 1000);
    }
    EXPECT_EQ(accepted.size(), 200u);
    EXPECT_NEAR(bus.count(DRIVE_HEARTBEAT_FRAME_ID), 20, 1);
    EXPECT_GT(bus.count(DRIVE_STATUS_FRAME_ID), 400u);
    EXPECT_GT(bus.count(DRIVE_PARAMETER_RESPONSE_FRAME_ID), 1000u);
    EXPECT_LE(bus.count(DRIVE_PARAMETER_RESPONSE_FRAME_ID), 2000u) << "one in each cycle";
}

TEST_F(Comms, parameters_can_be_written_over_the_bus) {
    bus.received.push_back(frames::arm(1, ARMING_STEP_REQUEST_CONFIGURATION));
    run(1000);
    bus.received.push_back(frames::arm(2, ARMING_STEP_CONFIRM_CONFIGURATION, ~comms.commands.arming.challenge));
    for (const auto &frame : frames::parameter_set(3, {{PARAMETER_COMMAND_TIMEOUT_MS, 20}})) {
        bus.received.push_back(frame);
    }
    run(4000);
    EXPECT_EQ(parameters.values[PARAMETER_COMMAND_TIMEOUT_MS], 20);
    bus.received.push_back(command(10, COMMAND_RUN));
    run(10000);
    EXPECT_EQ(bus.count(DRIVE_PARAMETER_RESPONSE_FRAME_ID), 2u) << "begin, apply";
    ASSERT_EQ(accepted.size(), 1u);
    run(40000);
    bus.received.push_back(command(200, COMMAND_RUN)); // the sender was silent for longer than 20 ms
    run(41000);
    EXPECT_EQ(accepted.size(), 2u);
}

TEST_F(Comms, counters_are_reported) {
    bus.received.push_back(hal_can_frame_t{0x123, false, false, 8, {}});
    bus.received.push_back(hal_can_frame_t{DRIVE_COMMAND_FRAME_ID, false, false, 6, {}});
    bus.received.push_back(hal_can_frame_t{DRIVE_COMMAND_FRAME_ID, false, false, 7, {}});
    bus.received.push_back(command(1, COMMAND_STOP));
    bus.received.push_back(command(1, COMMAND_STOP));
    bus.received.push_back(command(2, 4));
    bus.overflows = 70000;
    run(105000);
    drive_command_counters_t refused{};
    drive_bus_counters_t counters{};
    for (const auto &frame : bus.sent) {
        if (frame.identifier == DRIVE_COMMAND_COUNTERS_FRAME_ID) {
            drive_command_counters_unpack(&refused, frame.data, 8);
        } else if (frame.identifier == DRIVE_BUS_COUNTERS_FRAME_ID) {
            drive_bus_counters_unpack(&counters, frame.data, 8);
        }
    }
    EXPECT_EQ(refused.wrong_length, 1);
    EXPECT_EQ(refused.wrong_checksum, 1);
    EXPECT_EQ(refused.wrong_counter, 1);
    EXPECT_EQ(refused.out_of_range, 1);
    EXPECT_EQ(counters.unknown_frame, 1);
    EXPECT_EQ(counters.command_accepted, 1);
    EXPECT_EQ(counters.receive_overflow, 65535);
    EXPECT_EQ(counters.telemetry_dropped, 0);
}

} // namespace
