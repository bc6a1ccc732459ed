// Frames as a host sends them to the drive.
#pragma once

#include <cstdint>
#include <utility>
#include <vector>

extern "C" {
#include "comms/commands.h"
#include "comms/e2e.h"
#include "drive_codec.h"
#include "fixed/crc32.h"
#include "hal_can.h"
}

#include "support/e2e_protect.h"

namespace frames {

// A command's frame with its checksum; pack: the packing of the message.
template <typename message_t>
hal_can_frame_t protected_frame(uint32_t identifier, uint8_t length, uint16_t data_id, uint8_t counter,
                                const message_t &message, int (*pack)(uint8_t *, const message_t *, size_t)) {
    hal_can_frame_t frame{};
    frame.identifier = identifier;
    frame.length = length;
    pack(frame.data, &message, sizeof frame.data);
    e2e_protect(data_id, counter, frame.data, frame.length);
    return frame;
}

// DRIVE_COMMAND with its checksum; the values are not checked.
inline hal_can_frame_t command(uint8_t counter, unsigned request, int32_t milli_rpm) {
    drive_command_t message{};
    message.request = uint8_t(request);
    message.speed_reference_rpm = milli_rpm;
    return protected_frame(DRIVE_COMMAND_FRAME_ID, DRIVE_COMMAND_LENGTH, DRIVE_COMMAND_E2E_DATA_ID, counter, message,
                           drive_command_pack);
}

// DRIVE_TORQUE_COMMAND with its checksum; the values are not checked.
inline hal_can_frame_t torque_command(uint8_t counter, unsigned request, int32_t torque_q16) {
    drive_torque_command_t message{};
    message.request = uint8_t(request);
    message.torque_reference_nm = torque_q16;
    return protected_frame(DRIVE_TORQUE_COMMAND_FRAME_ID, DRIVE_TORQUE_COMMAND_LENGTH, DRIVE_TORQUE_COMMAND_E2E_DATA_ID,
                           counter, message, drive_torque_command_pack);
}

// DRIVE_POSITION_COMMAND with its checksum; the values are not checked.
inline hal_can_frame_t position_command(uint8_t counter, unsigned request, unsigned order, int32_t turns_q18) {
    drive_position_command_t message{};
    message.request = uint8_t(request);
    message.order = uint8_t(order);
    message.position_deg = turns_q18;
    return protected_frame(DRIVE_POSITION_COMMAND_FRAME_ID, DRIVE_POSITION_COMMAND_LENGTH,
                           DRIVE_POSITION_COMMAND_E2E_DATA_ID, counter, message, drive_position_command_pack);
}

// DRIVE_IDENTIFY_COMMAND with its checksum; the values are not checked.
inline hal_can_frame_t identify_command(uint8_t counter, unsigned request, unsigned kind, unsigned phase,
                                        uint8_t number = 1) {
    drive_identify_command_t message{};
    message.request = uint8_t(request);
    message.kind = uint8_t(kind);
    message.phase = uint8_t(phase);
    message.number = number;
    message.level = 1234;
    message.time_ms = 56;
    return protected_frame(DRIVE_IDENTIFY_COMMAND_FRAME_ID, DRIVE_IDENTIFY_COMMAND_LENGTH,
                           DRIVE_IDENTIFY_COMMAND_E2E_DATA_ID, counter, message, drive_identify_command_pack);
}

// DRIVE_IDENTIFY_WINDOW with its checksum.
inline hal_can_frame_t identify_window(uint8_t counter, uint16_t angle, uint16_t width) {
    drive_identify_window_t message{};
    message.angle = angle;
    message.width = width;
    return protected_frame(DRIVE_IDENTIFY_WINDOW_FRAME_ID, DRIVE_IDENTIFY_WINDOW_LENGTH,
                           DRIVE_IDENTIFY_WINDOW_E2E_DATA_ID, counter, message, drive_identify_window_pack);
}

// DRIVE_ARM with its checksum; the values are not checked.
inline hal_can_frame_t arm(uint8_t counter, unsigned step, uint32_t response = 0) {
    drive_arm_t message{};
    message.step = uint8_t(step);
    message.response = response;
    return protected_frame(DRIVE_ARM_FRAME_ID, DRIVE_ARM_LENGTH, DRIVE_ARM_E2E_DATA_ID, counter, message,
                           drive_arm_pack);
}

// PARAMETER_WRITE with its checksum; the values are not checked.
inline hal_can_frame_t parameter_write(uint8_t counter, unsigned index, int32_t value) {
    drive_parameter_write_t message{};
    message.index = uint8_t(index);
    message.value = value;
    return protected_frame(DRIVE_PARAMETER_WRITE_FRAME_ID, DRIVE_PARAMETER_WRITE_LENGTH,
                           DRIVE_PARAMETER_WRITE_E2E_DATA_ID, counter, message, drive_parameter_write_pack);
}

// PARAMETER_SET_CONTROL with its checksum; the values are not checked.
inline hal_can_frame_t parameter_set_control(uint8_t counter, unsigned step, uint32_t check = 0) {
    drive_parameter_set_control_t message{};
    message.step = uint8_t(step);
    message.check = check;
    return protected_frame(DRIVE_PARAMETER_SET_CONTROL_FRAME_ID, DRIVE_PARAMETER_SET_CONTROL_LENGTH,
                           DRIVE_PARAMETER_SET_CONTROL_E2E_DATA_ID, counter, message, drive_parameter_set_control_pack);
}

using parameter_writes_t = std::vector<std::pair<unsigned, int32_t>>;

// The frames of a set from begin to apply, the first with this counter.
inline std::vector<hal_can_frame_t> parameter_set(uint8_t counter, const parameter_writes_t &writes,
                                                  unsigned begin = PARAMETER_SET_STEP_BEGIN) {
    std::vector<hal_can_frame_t> set{parameter_set_control(counter, begin)};
    uint32_t check = 0;
    for (const auto &[index, value] : writes) {
        set.push_back(parameter_write(++counter, index, value));
        check = crc32_continue(check, set.back().data + E2E_HEADER_BYTES, 8 - E2E_HEADER_BYTES);
    }
    set.push_back(parameter_set_control(++counter, PARAMETER_SET_STEP_APPLY, check));
    return set;
}

// PARAMETER_REQUEST; the values are not checked.
inline hal_can_frame_t parameter_request(unsigned operation, unsigned index, unsigned part, int32_t value) {
    drive_parameter_request_t message{};
    message.operation = uint8_t(operation);
    message.index = uint8_t(index);
    message.part = uint8_t(part);
    message.value = value;
    hal_can_frame_t frame{};
    frame.identifier = DRIVE_PARAMETER_REQUEST_FRAME_ID;
    frame.length = DRIVE_PARAMETER_REQUEST_LENGTH;
    drive_parameter_request_pack(frame.data, &message, sizeof frame.data);
    return frame;
}

} // namespace frames
