// Parameters: the table is sound, ranges hold, and the protocol answers every request there is.
#include <cstring>
#include <set>
#include <string>

#include <gtest/gtest.h>

extern "C" {
#include "comms/parameter_protocol.h"
#include "control/machine_tables.h"
#include "drive_codec.h"
#include "storage/parameters.h"
}
#include "support/frames.h"

namespace {

struct Texts {
    std::string name, unit;
};

// By index; the drive's are one text.
const Texts TEXTS[PARAMETER_COUNT] = {
#define PARAMETER(index, name, unit, fraction_bits, minimum, maximum, default_value, text) {name, unit},
#include "storage/parameters.def"
#undef PARAMETER
};

class Parameters : public testing::Test {
  protected:
    Parameters() { parameters_init(&parameters); }

    drive_parameter_response_t request(unsigned operation, unsigned index, unsigned part = 0, int32_t value = 0) {
        const hal_can_frame_t frame = frames::parameter_request(operation, index, part, value);
        hal_can_frame_t response_frame;
        std::memset(&response_frame, 0xA5, sizeof response_frame);
        parameter_protocol_respond(&parameters, &frame, &response_frame);
        EXPECT_EQ(response_frame.identifier, DRIVE_PARAMETER_RESPONSE_FRAME_ID);
        EXPECT_EQ(response_frame.length, 8);
        EXPECT_FALSE(response_frame.extended);
        EXPECT_FALSE(response_frame.remote);
        drive_parameter_response_t response{};
        drive_parameter_response_unpack(&response, response_frame.data, sizeof response_frame.data);
        EXPECT_EQ(response.operation, operation);
        EXPECT_EQ(response.index, index);
        EXPECT_EQ(response.part, part);
        return response;
    }

    std::string text(unsigned operation, unsigned index) {
        std::string result;
        for (unsigned part = 0; part < 256; part++) {
            const auto response = request(operation, index, part);
            EXPECT_EQ(response.status, PARAMETER_STATUS_DONE);
            if (response.value == 0) {
                break;
            }
            char characters[5] = {};
            std::memcpy(characters, &response.value, 4);
            result += characters;
        }
        return result;
    }

    parameters_t parameters;
};

TEST_F(Parameters, every_row_is_sound) {
    std::set<std::string> names;
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        const parameter_row_t *row = parameters_row(i);
        const std::string name = parameters_name(i);
        SCOPED_TRACE(name);
        EXPECT_EQ(name, TEXTS[i].name);
        EXPECT_EQ(parameters_unit(i), TEXTS[i].unit);
        EXPECT_LE(name.size(), size_t(PARAMETER_NAME_MAX));
        EXPECT_GT(name.size(), 0u);
        EXPECT_TRUE(names.insert(name).second) << "named twice";
        EXPECT_LE(machine_tables.parameter_fraction_bits[i], 30);
        EXPECT_LT(row->minimum, row->maximum);
        EXPECT_LE(row->minimum, parameters_default(&parameters, i));
        EXPECT_LE(parameters_default(&parameters, i), row->maximum);
        EXPECT_EQ(parameters.values[i], parameters_default(&parameters, i));
        EXPECT_EQ(parameters_default(&parameters, i), machine_tables.parameter_default[i]);
    }
}

TEST_F(Parameters, defaults_are_a_consistent_set) {
    const int32_t *value = parameters.values;
    EXPECT_LT(value[PARAMETER_CURRENT_LIMIT_A], value[PARAMETER_CURRENT_TRIP_A]);
    EXPECT_LT(value[PARAMETER_UNDER_VOLTAGE_V], value[PARAMETER_OVER_VOLTAGE_V]);
    EXPECT_LT(value[PARAMETER_TURN_ON_ANGLE_DEG], value[PARAMETER_TURN_OFF_ANGLE_DEG]);
    EXPECT_LT(value[PARAMETER_TURN_OFF_ANGLE_DEG], value[PARAMETER_OUTGOING_OFF_ANGLE_DEG]);
    EXPECT_LT(value[PARAMETER_TORQUE_BAND_INNER_NM], value[PARAMETER_TORQUE_BAND_OUTER_NM]);
}

TEST_F(Parameters, limits_are_allowed_and_one_beyond_is_rejected) {
    const parameters_conditions_t unsupplied = {false, 0};
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        const parameter_row_t *row = parameters_row(i);
        SCOPED_TRACE(TEXTS[i].name);
        for (const int64_t value :
             {int64_t(row->minimum), int64_t(row->maximum), int64_t(row->minimum) - 1, int64_t(row->maximum) + 1}) {
            if (value != int32_t(value)) {
                continue; // the limit is the limit of the 32 bits
            }
            parameters_t set = parameters;
            set.values[i] = int32_t(value);
            const auto verdict = parameters_check(&parameters, set.values, UINT64_MAX, &unsupplied);
            const bool within = value >= row->minimum && value <= row->maximum;
            EXPECT_EQ(verdict.status == PARAMETER_STATUS_OUT_OF_RANGE, !within) << value;
            EXPECT_EQ(verdict.index, verdict.status == PARAMETER_STATUS_OUT_OF_RANGE ? i : verdict.index);
            parameters_t restored = parameters;
            EXPECT_EQ(parameters_restore(&restored, set.values), within);
            EXPECT_EQ(restored.values[i], within ? value : parameters.values[i]);
            EXPECT_EQ(restored.revision, parameters.revision + within);
        }
    }
}

TEST_F(Parameters, the_controller_of_the_drive_is_its_default_clamped_to_the_limits) {
    parameters_set_controller(&parameters, 1);
    EXPECT_EQ(parameters.values[PARAMETER_CONTROLLER], 1);
    EXPECT_EQ(request(PARAMETER_OPERATION_DEFAULT, PARAMETER_CONTROLLER).value, 1);
    parameters.values[PARAMETER_CONTROLLER] = 0;
    EXPECT_EQ(request(PARAMETER_OPERATION_DEFAULT, PARAMETER_CONTROLLER).value, 1);
    parameters_set_controller(&parameters, INT32_MAX);
    EXPECT_EQ(parameters.values[PARAMETER_CONTROLLER], parameters_row(PARAMETER_CONTROLLER)->maximum);
}

TEST_F(Parameters, protocol_reads_everything_of_every_row) {
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        const parameter_row_t *row = parameters_row(i);
        SCOPED_TRACE(TEXTS[i].name);
        parameters.values[i] = row->maximum;
        for (const auto &[operation, expected] :
             {std::pair<unsigned, int32_t>{PARAMETER_OPERATION_READ, row->maximum},
              {PARAMETER_OPERATION_MINIMUM, row->minimum},
              {PARAMETER_OPERATION_MAXIMUM, row->maximum},
              {PARAMETER_OPERATION_DEFAULT, machine_tables.parameter_default[i]},
              {PARAMETER_OPERATION_FRACTION_BITS, machine_tables.parameter_fraction_bits[i]}}) {
            const auto response = request(operation, i);
            EXPECT_EQ(response.status, PARAMETER_STATUS_DONE);
            EXPECT_EQ(response.value, expected) << "operation " << operation;
        }
        EXPECT_EQ(text(PARAMETER_OPERATION_NAME, i), TEXTS[i].name);
        EXPECT_EQ(text(PARAMETER_OPERATION_UNIT, i), TEXTS[i].unit);
    }
}

TEST_F(Parameters, protocol_never_reads_past_a_text) {
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        for (unsigned part = 0; part < 256; part++) {
            EXPECT_EQ(request(PARAMETER_OPERATION_NAME, i, part).value != 0, part * 4 < TEXTS[i].name.size())
                << i << " part " << part;
            EXPECT_EQ(request(PARAMETER_OPERATION_UNIT, i, part).value != 0, part * 4 < TEXTS[i].unit.size())
                << i << " part " << part;
        }
    }
}

TEST_F(Parameters, every_operation_with_every_index_is_answered_and_changes_nothing) {
    for (unsigned operation = 0; operation < 256; operation++) {
        for (unsigned index = 0; index < 256; index++) {
            const parameters_t before = parameters;
            const auto response = request(operation, index, 0, INT32_MIN);
            const int expected = operation > PARAMETER_OPERATION_UNIT     ? PARAMETER_STATUS_UNKNOWN_OPERATION
                                 : index >= PARAMETER_COUNT               ? PARAMETER_STATUS_NO_SUCH_PARAMETER
                                 : operation == PARAMETER_OPERATION_WRITE ? PARAMETER_STATUS_UNPROTECTED
                                                                          : PARAMETER_STATUS_DONE;
            ASSERT_EQ(response.status, expected) << operation << ", " << index;
            ASSERT_EQ(std::memcmp(&before, &parameters, sizeof before), 0);
        }
    }
}

TEST_F(Parameters, what_can_be_changed_in_a_run_is_a_gain) {
    const std::set<std::string> not_tunable = {
        "controller",      "torque_max_Nm",  "current_limit_A",    "current_trip_A", "over_voltage_V",
        "under_voltage_V", "over_speed_rpm", "command_timeout_ms", "inertia_kg_m2",  "friction_Nm_s",
        "resistance_ohm",  "bp_mode",        "pulses_per_period",  "torque_sharing", "load_source"};
    const std::set<std::string> tunable = {"speed_kp", "speed_ki", "smc_k", "smc_delta", "observer_bandwidth_rad_s",
                                           "bp_ki_max"};
    for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
        EXPECT_TRUE(!parameters_tunable(i) || not_tunable.count(TEXTS[i].name) == 0) << TEXTS[i].name;
        EXPECT_TRUE(parameters_tunable(i) || tunable.count(TEXTS[i].name) == 0) << TEXTS[i].name;
    }
}

} // namespace
