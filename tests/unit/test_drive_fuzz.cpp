// Random parameters, sensors and commands: no undefined behaviour (built with sanitizers), and never a closed switch
// outside RUN. Seeded; a failure names its sequence.
#include <algorithm>
#include <cstdint>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "control/position/position_configure.h"
#include "interrupts/configure.h"
#include "interrupts/control_step.h"
#include "interrupts/deferred.h"
}
#include "support/deferred_step.h"
#include "support/equal_parameters.h"
#include "support/whole_sample.h"

namespace {

constexpr uint32_t TIMER_CLOCKS_HZ[] = {25000000, 400000000}; // slowest and fastest

constexpr int SEQUENCES = 6000;
constexpr int PERIODS = 400;

// Any value of the row's range; its ends and its default more often.
int32_t any_value(unsigned index, std::mt19937_64 &random) {
    const parameter_row_t *row = parameters_row(index);
    switch (random() % 8) {
    case 0:
        return row->minimum;
    case 1:
        return row->maximum;
    case 2:
    case 3:
        return machine_tables.parameter_default[index];
    default:
        return int32_t(row->minimum + int64_t(random() % (uint64_t(int64_t(row->maximum) - row->minimum) + 1)));
    }
}

// Changes some of the tunable parameters as a drive that runs does; 1 when it runs and the set is accepted.
unsigned tune(parameters_t &p, std::mt19937_64 &random, bool runs) {
    parameters_t set = p;
    uint64_t written = 0;
    for (unsigned index = 0; index < PARAMETER_COUNT; index++) {
        if (parameters_tunable(index) && random() % 3 == 0) {
            set.values[index] = any_value(index, random);
            written |= index < 64 ? uint64_t(1) << index : 0;
        }
    }
    // The set itself may have contradictions, which remain; no tunable parameter is part of one.
    const parameters_conditions_t conditions = {true, INT32_MAX};
    const parameter_status_t status = parameters_check(&p, set.values, written, &conditions).status;
    EXPECT_TRUE(status == PARAMETER_STATUS_DONE || status == PARAMETER_STATUS_CONTRADICTION);
    parameters_apply(&p, set.values);
    return runs;
}

// The machine at hand, and one with four phases whose map is full of noise.
machine_tables_t four_phases() {
    machine_tables_t tables = machine_tables;
    tables.phases = 4;
    tables.rotor_poles = 6;
    std::mt19937 random(1);
    for (unsigned column = 0; column < MACHINE_COLUMNS; column++) {
        for (unsigned row = 0; row < MACHINE_ROWS; row++) {
            tables.node[column * MACHINE_TO_NEXT_COLUMN + row] = int16_t(random());
        }
    }
    return tables;
}

// Most targets are within reach.
position_set_point_t any_set_point(std::mt19937_64 &random) {
    position_set_point_t set_point{};
    set_point.order = position_order_t(random() % 4);
    set_point.homing = position_homing_t(random() % POSITION_HOMING_METHODS);
    set_point.sequence = uint32_t(random());
    set_point.target = int64_t(random()) >> (random() % 34);
    set_point.speed_q22 = int32_t(random() >> (random() % 64));
    set_point.acceleration_rpm_s = int32_t(random() >> (random() % 64));
    set_point.deceleration_rpm_s = int32_t(random() >> (random() % 64));
    set_point.jerk_rpm_s2 = int32_t(random() >> (random() % 64));
    set_point.speed_offset_q22 = int32_t(random() >> (random() % 64));
    set_point.torque_offset_q24 = int32_t(random() >> (random() % 64));
    return set_point;
}

// A plausible bench that goes wild now and then.
struct bench_t {
    uint32_t angle = 0;
    int32_t step = 0; // 2^-32 turn a period
    whole_sample_t sample{};
    command_t command{};

    void advance(std::mt19937_64 &random, const control_parameters_t &parameters, uint32_t period_us) {
        const auto rarely = [&](unsigned one_in) { return random() % one_in == 0; };
        step += int32_t(random() % 20001) - 10000;
        angle += uint32_t(step);
        if (rarely(500)) {
            angle = uint32_t(random());
        }
        sample.encoder.counts = angle >> parameters.encoder_shift;
        const uint64_t middle_q6 = (uint64_t(parameters.protection.dc_link_over_voltage_q6) +
                                    uint64_t(parameters.protection.dc_link_under_voltage_q6)) /
                                   2;
        const unsigned finer = parameters.adc_bits - 12u;
        sample.adc.bus_voltage_counts =
            uint16_t((rarely(500) ? random() % 4096 : std::min<uint64_t>(middle_q6 / 8, 4095)) << finer);
        const uint64_t highest = uint64_t(parameters.protection.current_trip_q9) / 10;
        for (uint16_t &counts : sample.adc.phase_current_counts) {
            counts = uint16_t((rarely(2000) ? random() % 4096 : random() % (highest + 1)) << finer);
        }
        sample.missed_interrupts = rarely(100) ? uint32_t(random() % 3) : rarely(2000) ? uint32_t(random()) : 0;
        sample.time_us += period_us;
        if (rarely(2000)) {
            sample.time_us = uint32_t(random());
        }
        if (rarely(20)) {
            command.time_us = sample.time_us;
            command.request = rarely(3) ? command_request_t(random() % 4) : COMMAND_RUN;
            command.speed_reference_q22 = int32_t(uint32_t(random()));
            command.mode = drive_mode_t(random() % 3);
            command.torque_reference_q24 = int32_t(uint32_t(random()));
            command.position = any_set_point(random);
        }
    }
};

TEST(Fuzz, no_switch_is_closed_outside_run_and_nothing_is_undefined) {
    const machine_tables_t bundled = machine_tables, other = four_phases();
    const uint32_t rates_hz[] = {20000, 40000, 50000, 100000};
    uint64_t running = 0, faults = 0, cleared = 0, driven = 0, tuned = 0;
    for (int sequence = 0; sequence < SEQUENCES; sequence++) {
        std::mt19937_64 random{uint64_t(sequence)};
        machine_tables = sequence % 2 == 0 ? bundled : other;
        const machine_tables_t *tables = &machine_tables;
        parameters_t p;
        parameters_init(&p);
        for (unsigned index = 0; index < PARAMETER_COUNT; index++) {
            p.values[index] = any_value(index, random);
        }
        const uint32_t rate_hz = rates_hz[random() % 4];
        const unsigned encoder_bits = unsigned(8 + random() % 25), adc_bits = 12 + unsigned(sequence) % 5;
        const auto configured = [&] {
            return configure_control(&p, tables, rate_hz, encoder_bits, adc_bits, TIMER_CLOCKS_HZ[sequence % 2]);
        };
        control_parameters_t parameters = configured();
        control_state_t state;
        control_reset(&parameters, &state);
        bench_t bench;
        bench.angle = uint32_t(random());
        for (int period = 0; period < PERIODS; period++) {
            bench.advance(random, parameters, 1000000 / rate_hz);
            if (random() % 50 == 0) { // between two periods, in any state
                tuned += tune(p, random, state.state_machine.state == DRIVE_STATE_RUN);
                const control_parameters_t of_the_set = configured();
                for (unsigned part = 0; part < CONFIGURE_TUNE_PARTS; ++part) {
                    configure_tune(&parameters, &of_the_set, part);
                }
                for (unsigned part = 0; part < DEFERRED_TUNE_PARTS; ++part) {
                    deferred_tune(&parameters, &state, part);
                }
                ASSERT_STREQ(difference(parameters, of_the_set), "") << "sequence " << sequence;
            }
            state.position_command = position_command(&parameters.position, &bench.command.position, 1 << 14, 1 << 14);
            const drive_state_t before = state.state_machine.state;
            hal_pwm_compare_t compare;
            const bool closed = control_step(&parameters, &state, &bench.sample, &bench.command, &compare);
            if ((period / 4 + sequence) % 5 != 0) { // four periods are skipped in a row
                deferred_step(&parameters, &state, &bench.command);
            }
            ASSERT_EQ(closed, state.state_machine.state == DRIVE_STATE_RUN) << "sequence " << sequence;
            for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
                const bool exists = phase < tables->phases;
                ASSERT_LE(compare.upper[phase], closed && exists ? parameters.period_ticks : 0) << sequence;
                ASSERT_LE(compare.lower[phase], closed && exists ? parameters.period_ticks : 0) << sequence;
                // Both on at a time is the only way to put voltage on a phase: not above its limit and the error of the
                // plans.
                if (compare.upper[phase] + compare.lower[phase] > parameters.period_ticks) {
                    driven++;
                    ASSERT_LE(state.measurement.current_q9[phase], p.values[PARAMETER_CURRENT_LIMIT_A] * 65 / 64)
                        << sequence;
                }
            }
            running += closed;
            faults += before != DRIVE_STATE_FAULT && state.state_machine.state == DRIVE_STATE_FAULT;
            cleared += before == DRIVE_STATE_FAULT && state.state_machine.state == DRIVE_STATE_READY;
        }
    }
    machine_tables = bundled;
    // The sequences are not so wild that they say nothing.
    EXPECT_GT(running, uint64_t(SEQUENCES) * PERIODS / 20);
    EXPECT_GT(driven, running / 20);
    EXPECT_GT(faults, uint64_t(SEQUENCES) / 4);
    EXPECT_GT(cleared, uint64_t(SEQUENCES) / 200); // few have 10 ms without a cause
    EXPECT_GT(tuned, uint64_t(SEQUENCES) / 2);
}

TEST(Fuzz, garbage_from_every_sensor_at_once_is_survived) {
    std::mt19937_64 random(77);
    parameters_t p;
    parameters_init(&p);
    for (const uint32_t rate_hz : {20000u, 100000u}) {
        for (const unsigned bits : {8u, 17u, 32u}) {
            const control_parameters_t parameters =
                configure_control(&p, &machine_tables, rate_hz, bits, 12, TIMER_CLOCKS_HZ[1]);
            control_state_t state;
            control_reset(&parameters, &state);
            for (int period = 0; period < 20000; period++) {
                whole_sample_t sample{};
                for (uint16_t &counts : sample.adc.phase_current_counts) {
                    counts = uint16_t(random() % 4096);
                }
                sample.adc.bus_voltage_counts = uint16_t(random() % 4096);
                sample.encoder.counts = uint32_t(random()) >> (32 - bits);
                sample.missed_interrupts = uint32_t(random());
                sample.time_us = uint32_t(random());
                const command_t command = {.request = command_request_t(random() % 4),
                                           .mode = drive_mode_t(random() % 3),
                                           .speed_reference_q22 = int32_t(uint32_t(random())),
                                           .torque_reference_q24 = int32_t(uint32_t(random())),
                                           .time_us = uint32_t(random()),
                                           .position = any_set_point(random)};
                state.position_command =
                    position_command(&parameters.position, &command.position, 1 << 14, int32_t(random()));
                hal_pwm_compare_t compare;
                const bool closed = control_step(&parameters, &state, &sample, &command, &compare);
                if (random() % 4 != 0) {
                    deferred_step(&parameters, &state, &command);
                }
                ASSERT_EQ(closed, state.state_machine.state == DRIVE_STATE_RUN);
            }
        }
    }
}

} // namespace
