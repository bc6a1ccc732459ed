// Requests for the periods before a fault: every item in the units of the bus, and what there is not.
#include <cmath>
#include <cstring>

#include <gtest/gtest.h>

extern "C" {
#include "comms/trace_protocol.h"
#include "control/machine_tables.h"
#include "drive_codec.h"
}
#include "support/configured.h"
#include "support/frames.h"

namespace {

constexpr unsigned FIRST_PHASES = 4, FIRST_ITEMS = 4 + 3 * FIRST_PHASES;

class TraceProtocol : public testing::Test {
  protected:
    TraceProtocol() : parameters(configured(DRIVE_CONTROLLER_SALIENT, 40000, 17)) {}

    // False: not answered.
    bool ask(unsigned operation, unsigned period, unsigned part) {
        const hal_can_frame_t frame = frames::parameter_request(operation, period, part, 0);
        hal_can_frame_t answer{};
        if (!trace_protocol_respond(&trace, &parameters, &frame, &answer)) {
            return false;
        }
        EXPECT_EQ(answer.identifier, DRIVE_PARAMETER_RESPONSE_FRAME_ID);
        drive_parameter_response_unpack(&response, answer.data, sizeof answer.data);
        EXPECT_EQ(response.index, period);
        EXPECT_EQ(response.part, part);
        return true;
    }

    int item(unsigned period, unsigned number) {
        EXPECT_TRUE(ask(PARAMETER_OPERATION_FAULT_TRACE, period, number / 2));
        EXPECT_EQ(response.status, PARAMETER_STATUS_DONE);
        return int16_t(uint32_t(response.value) >> (number % 2 * 16));
    }

    // Each period with a value of its own.
    void record(unsigned periods) {
        for (unsigned k = 0; k < periods; k++) {
            hal_adc_sample_t adc{};
            hal_pwm_compare_t compare{};
            for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
                adc.phase_current_counts[phase] = uint16_t(k + phase);
                compare.upper[phase] = uint16_t(100 * phase + k);
                compare.lower[phase] = uint16_t(parameters.period_ticks - k);
            }
            adc.bus_voltage_counts = uint16_t(240 * 8 + k);
            const fault_trace_values_t values = {.adc = &adc,
                                                 .compare = &compare,
                                                 .angle = k << 20,
                                                 .speed_q22 = -int32_t(k) * (1 << 22),
                                                 .torque_reference_q24 = -int32_t(k) * (1 << 20)};
            const bool last = k + 1 == periods;
            last ? fault_trace_stand(&trace, &values, DRIVE_STATE_FAULT) : fault_trace_run(&trace, &values);
        }
    }

    void expect_every_item() {
        record(100);
        for (unsigned period = 0; period < FAULT_TRACE_PERIODS; period++) {
            const unsigned k = 100 - FAULT_TRACE_PERIODS + period;
            unsigned number = 0;
            const auto expect_currents = [&](unsigned from, unsigned to) {
                for (unsigned phase = from; phase < to; phase++) {
                    EXPECT_EQ(item(period, number++), int(k + phase) * 10) << "1/51.2 A a count, Q9";
                }
            };
            const auto expect_duties = [&](unsigned from, unsigned to) {
                for (unsigned phase = from; phase < to; phase++) {
                    EXPECT_EQ(item(period, number++), int((100 * phase + k) * 32768 / parameters.period_ticks))
                        << "Q15";
                }
                for (unsigned phase = from; phase < to; phase++) {
                    EXPECT_EQ(item(period, number++),
                              int((parameters.period_ticks - k) * 32768 / parameters.period_ticks));
                }
            };
            expect_currents(0, FIRST_PHASES);
            EXPECT_EQ(item(period, number++), int(240 * 8 + k) * 8) << "1/8 V a count, Q6";
            EXPECT_EQ(item(period, number++), int(k << 4)) << "2^-16 rev";
            EXPECT_EQ(item(period, number++), std::lround(-double(k) * 30.0 / M_PI * 4.0)) << "a quarter r/min";
            EXPECT_EQ(item(period, number++), -int(k) * 16) << "Q8";
            expect_duties(0, FIRST_PHASES);
            EXPECT_EQ(number, FIRST_ITEMS);
            if (machine_tables.phases > FIRST_PHASES) {
                expect_currents(FIRST_PHASES, HAL_PHASES_MAX);
                expect_duties(FIRST_PHASES, HAL_PHASES_MAX);
            }
            EXPECT_TRUE(ask(PARAMETER_OPERATION_FAULT_TRACE, period, number / 2));
            EXPECT_EQ(response.status, PARAMETER_STATUS_NO_SUCH_ENTRY);
        }
    }

    control_parameters_t parameters;
    fault_trace_t trace{};
    drive_parameter_response_t response{};
};

TEST_F(TraceProtocol, gives_every_item_of_the_last_64_periods_the_oldest_first) {
    expect_every_item();
}

TEST_F(TraceProtocol, gives_those_of_two_phases_more_of_a_machine_that_has_them) {
    const uint8_t phases = machine_tables.phases;
    machine_tables.phases = 5;
    expect_every_item();
    machine_tables.phases = phases;
}

TEST_F(TraceProtocol, has_no_period_before_a_fault_and_no_other_period_or_part_after_it) {
    const auto status = [this](unsigned period, unsigned part) {
        EXPECT_TRUE(ask(PARAMETER_OPERATION_FAULT_TRACE, period, part));
        EXPECT_TRUE(response.status == PARAMETER_STATUS_DONE || response.value == 0);
        return response.status;
    };
    EXPECT_EQ(status(0, 0), PARAMETER_STATUS_NO_SUCH_ENTRY);
    record(3);
    EXPECT_EQ(status(0, 0), PARAMETER_STATUS_DONE) << "zeros: before the start";
    EXPECT_EQ(status(FAULT_TRACE_PERIODS - 1, FIRST_ITEMS / 2 - 1), PARAMETER_STATUS_DONE);
    EXPECT_EQ(status(FAULT_TRACE_PERIODS, 0), PARAMETER_STATUS_NO_SUCH_ENTRY);
    EXPECT_EQ(status(255, 0), PARAMETER_STATUS_NO_SUCH_ENTRY);
    EXPECT_EQ(status(0, FIRST_ITEMS / 2), PARAMETER_STATUS_NO_SUCH_ENTRY);
    EXPECT_EQ(status(0, 255), PARAMETER_STATUS_NO_SUCH_ENTRY);
}

TEST_F(TraceProtocol, answers_no_other_operation) {
    record(3);
    for (unsigned operation = 0; operation < 256; operation++) {
        EXPECT_EQ(ask(operation, 0, 0), operation == PARAMETER_OPERATION_FAULT_TRACE) << operation;
    }
}

} // namespace
