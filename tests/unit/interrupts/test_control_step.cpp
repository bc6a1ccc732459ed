// The control interrupt as a function of its arguments: outputs in each state, repeatability, faults.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <functional>
#include <iterator>
#include <random>

#include <gtest/gtest.h>

extern "C" {
#include "drive/telemetry_collect.h"
#include "interrupts/control_step.h"
#include "interrupts/deferred.h"
#include "storage/fault.h"

uint32_t hal_can_receive_overflows(const hal_t *) {
    return 0;
}
}

#include "support/configured.h"
#include "support/deferred_step.h"
#include "support/reference_models.h"
#include "support/whole_sample.h"

namespace {

constexpr double RATE_HZ = 40000.0;
constexpr unsigned ENCODER_BITS = 17;
constexpr uint32_t PERIOD_US = 25;
constexpr uint16_t BUS_COUNTS = 240 * 8;

bool all_open(const hal_pwm_compare_t &compare) {
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        if (compare.upper[phase] != 0 || compare.lower[phase] != 0) {
            return false;
        }
    }
    return true;
}

// Values of the last period.
struct diagnostics_t {
    uint32_t angle; // 2^-32 rev
    int32_t speed_q22, speed_reference_q22;
    int32_t torque_reference_q24, torque_q24, load_torque_q24;
    int32_t current_q9[HAL_PHASES_MAX], bus_voltage_q6;
    int32_t duty_q15;
    bool voltage_saturated;
    int32_t torque_missing_q24; // multiple of 2^-8 N m
};

// A drive on a rotor whose speed the test prescribes.
class Control : public testing::Test {
  protected:
    explicit Control(drive_controller_t controller = DRIVE_CONTROLLER_PAPER) { configure(controller); }

    void configure(drive_controller_t controller) {
        parameters = configured(controller, uint32_t(RATE_HZ), ENCODER_BITS);
        control_reset(&parameters, &state);
        diagnostics = diagnostics_t{};
        sample = whole_sample_t{};
        command = command_t{};
        sample.adc.bus_voltage_counts = BUS_COUNTS;
        turns = 0.1;
    }

    // Reset with one parameter changed.
    void configure_with(drive_controller_t controller, parameter_index_t index, int32_t value, unsigned adc_bits = 12) {
        configure(controller);
        parameters = configured(controller, uint32_t(RATE_HZ), ENCODER_BITS, adc_bits, {{index, value}});
    }

    bool step(command_request_t request, double reference_rpm = 600.0) {
        sample.time_us += PERIOD_US;
        command.request = request;
        command.speed_reference_q22 = fixed_point::to_fixed(fixed_point::rad_s(reference_rpm), fixed_point::Q22);
        command.time_us = sample.time_us;
        return step_unchanged();
    }

    bool step_unchanged() {
        turns += speed_rad_s / (2.0 * fixed_point::PI * RATE_HZ);
        sample.encoder.counts = uint32_t(int64_t(std::floor((turns - std::floor(turns)) * (1 << ENCODER_BITS))));
        return step_as_sampled();
    }

    bool step_as_sampled() {
        const bool closed = control_step(&parameters, &state, &sample, &command, &compare);
        deferred_step(&parameters, &state, &command);
        diagnostics = diagnose();
        // No switch is ever closed outside RUN.
        EXPECT_EQ(closed, state.state_machine.state == DRIVE_STATE_RUN);
        EXPECT_TRUE(closed || all_open(compare));
        return closed;
    }

    // From the state and, where telemetry_collect computes a value, from telemetry.
    diagnostics_t diagnose() {
        telemetry_drive.control_parameters = parameters;
        telemetry_drive.control = state;
        drive_telemetry_t telemetry;
        telemetry_collect(&telemetry_drive, nullptr, sample.time_us, &telemetry);
        diagnostics_t values = {
            .angle = state.measurement.angle,
            .speed_q22 = state.observer.speed_q22,
            .speed_reference_q22 = deferred_in_effect(&state)->speed.speed_reference_q22,
            .torque_reference_q24 = state.torque_reference_q24,
            .torque_q24 = state.measurement.torque_sum_q24,
            .load_torque_q24 = state.observer.load_torque_q24,
            .current_q9 = {},
            .bus_voltage_q6 = int32_t(telemetry.torque.bus_voltage_v),
            .duty_q15 = telemetry.bp_pid.duty,
            .voltage_saturated = telemetry.status.voltage_saturated != 0,
            .torque_missing_q24 = telemetry.adaptation.torque_missing_nm * (1 << 16),
        };
        const uint32_t currents[] = {telemetry.currents.current_a_a, telemetry.currents.current_b_a,
                                     telemetry.currents.current_c_a, telemetry.currents.current_d_a};
        for (unsigned phase = 0; phase < std::size(currents); phase++) {
            values.current_q9[phase] = int32_t(currents[phase]);
        }
        return values;
    }

    void start() {
        for (int k = 0; k < 41; k++) {
            step(COMMAND_OFF);
        }
        ASSERT_EQ(state.state_machine.state, DRIVE_STATE_READY);
        step(COMMAND_RUN);
        ASSERT_EQ(state.state_machine.state, DRIVE_STATE_RUN);
    }

    control_parameters_t parameters;
    control_state_t state;
    diagnostics_t diagnostics;
    drive_t telemetry_drive{}; // as telemetry_collect reads it
    whole_sample_t sample;
    command_t command;
    hal_pwm_compare_t compare{};
    double turns = 0.1, speed_rad_s = 0.0;
};

TEST_F(Control, counts_of_every_resolution_become_the_nearest_current_and_voltage) {
    for (unsigned bits = 12; bits <= 16; bits++) {
        parameters_t p;
        parameters_init(&p);
        parameters =
            configure_control(&p, &machine_tables, uint32_t(RATE_HZ), ENCODER_BITS, bits, fixed_point::TIMER_CLOCK_HZ);
        for (uint32_t code = 0; code < 1u << bits; code += 7) {
            sample.adc.phase_current_counts[1] = sample.adc.bus_voltage_counts = uint16_t(code);
            step(COMMAND_OFF);
            ASSERT_EQ(diagnostics.current_q9[1], std::floor(std::ldexp(code * 80.0, 9 - int(bits)) + 0.5)) << bits;
            ASSERT_EQ(diagnostics.bus_voltage_q6, std::floor(std::ldexp(code * 512.0, 6 - int(bits)) + 0.5)) << bits;
        }
    }
}

// Before the first results, as a first step that is late leaves them.
TEST_F(Control, a_reset_observes_with_the_inertia_of_the_parameters) {
    const load_observer_inertia_t expected = load_observer_inertia(&parameters.observer, 0);
    EXPECT_GT(expected.acceleration_q32, 0);
    EXPECT_EQ(deferred_in_effect(&state)->observer.acceleration_q32, expected.acceleration_q32);
    EXPECT_EQ(deferred_in_effect(&state)->observer.load_shift, expected.load_shift);
}

TEST_F(Control, initialise_lasts_a_millisecond) {
    for (int k = 0; k < 39; k++) {
        step(COMMAND_OFF);
        ASSERT_EQ(state.state_machine.state, DRIVE_STATE_INITIALISE);
    }
    step(COMMAND_OFF);
    EXPECT_EQ(state.state_machine.state, DRIVE_STATE_READY);
}

TEST_F(Control, every_switch_is_open_until_run_is_commanded) {
    for (int k = 0; k < 200; k++) {
        step(k % 2 == 0 ? COMMAND_STOP : COMMAND_CLEAR_FAULT);
        ASSERT_TRUE(all_open(compare));
    }
    step(COMMAND_RUN); // the first torque of the speed law acts in the next period
    step(COMMAND_RUN);
    EXPECT_FALSE(all_open(compare));
}

TEST_F(Control, the_same_state_and_sample_give_the_same_bits) {
    // A copy of the state, stepped again with the same inputs: there is no other memory.
    for (const drive_controller_t controller :
         {DRIVE_CONTROLLER_TRADITIONAL, DRIVE_CONTROLLER_PAPER, DRIVE_CONTROLLER_SALIENT}) {
        configure(controller);
        start();
        std::mt19937 random(1);
        speed_rad_s = 15.0;
        for (int k = 0; k < 3000; k++) {
            for (unsigned phase = 0; phase < 3; phase++) {
                sample.adc.phase_current_counts[phase] = uint16_t(random() % 2500);
            }
            // Copied bytes, so that padding is equal in both.
            control_state_t before;
            std::memcpy(&before, &state, sizeof state);
            step(COMMAND_RUN, 150.0);
            hal_pwm_compare_t replayed{};
            control_step(&parameters, &before, &sample, &command, &replayed);
            deferred_step(&parameters, &before, &command);
            ASSERT_EQ(std::memcmp(&before, &state, sizeof state), 0) << k;
            ASSERT_EQ(std::memcmp(&replayed, &compare, sizeof compare), 0) << k;
        }
    }
}

TEST_F(Control, counts_become_amperes_volts_and_angle_exactly) {
    sample.adc.phase_current_counts[0] = 512;
    sample.adc.phase_current_counts[2] = 4095;
    step(COMMAND_OFF);
    EXPECT_EQ(diagnostics.current_q9[0], 10 << 9);
    EXPECT_EQ(diagnostics.current_q9[1], 0);
    EXPECT_EQ(diagnostics.current_q9[2], 40950);
    EXPECT_EQ(diagnostics.bus_voltage_q6, 240 << 6);
    // The middle of the encoder's count.
    EXPECT_EQ(diagnostics.angle, (sample.encoder.counts << 15) + (1u << 14));
}

TEST_F(Control, each_cause_opens_every_switch_in_the_tick_that_sees_it_and_a_deferred_check_in_the_next) {
    const struct {
        fault_t fault;
        bool deferred;
        std::function<void()> provoke;
    } causes[] = {
        {FAULT_OVER_CURRENT, false, [this] { sample.adc.phase_current_counts[1] = 3841; }}, // 75.02 A
        {FAULT_OVER_VOLTAGE, false, [this] { sample.adc.bus_voltage_counts = 301 * 8; }},
        {FAULT_UNDER_VOLTAGE, true, [this] { sample.adc.bus_voltage_counts = 149 * 8; }},
        {FAULT_ENCODER, false, [this] { turns += 0.01; }},
        {FAULT_COMMAND_TIMEOUT, true, [this] { command.time_us -= COMMAND_LOST_US + 1; }},
        {FAULT_INTERRUPT_OVERRUN, false, [this] { sample.missed_interrupts = 3; }},
    };
    for (const auto &cause : causes) {
        configure(DRIVE_CONTROLLER_PAPER);
        start();
        for (int k = 0; k < 10; k++) {
            step(COMMAND_RUN);
        }
        EXPECT_GT(diagnostics.torque_reference_q24, 0);
        cause.provoke();
        if (cause.deferred) {
            EXPECT_TRUE(step_unchanged()) << cause.fault;
        }
        const int32_t torque_reference_q24 = diagnostics.torque_reference_q24;
        EXPECT_FALSE(step_unchanged()) << cause.fault;
        EXPECT_TRUE(all_open(compare));
        const fault_record_t &record = state.state_machine.record;
        EXPECT_EQ(record.fault, cause.fault);
        EXPECT_NE(record.fault_mask & FAULT_BIT(cause.fault), 0);
        EXPECT_EQ(record.state, DRIVE_STATE_RUN);
        EXPECT_EQ(record.time_us, sample.time_us);
        EXPECT_EQ(record.torque_reference_q24, torque_reference_q24) << "of the previous period";
        EXPECT_EQ(record.dc_link_voltage_q6, sample.adc.bus_voltage_counts * 8);
        EXPECT_EQ(diagnostics.torque_reference_q24, 0);
    }
}

TEST_F(Control, the_largest_current_that_is_no_trip_keeps_running) {
    start();
    sample.adc.phase_current_counts[1] = 3840; // 75 A
    EXPECT_TRUE(step(COMMAND_RUN));
    sample.adc.phase_current_counts[1] = 3841;
    EXPECT_FALSE(step(COMMAND_RUN));
}

TEST_F(Control, an_encoder_that_freezes_at_speed_is_detected_within_a_millisecond) {
    start();
    speed_rad_s = 15.7; // 150 r/min
    for (int k = 0; k < 4000; k++) {
        ASSERT_TRUE(step(COMMAND_RUN, 150.0)) << k;
    }
    speed_rad_s = 0.0;
    int periods = 0;
    while (step(COMMAND_RUN, 150.0) && periods < 100) {
        periods++;
    }
    EXPECT_EQ(state.state_machine.record.fault, FAULT_ENCODER);
    EXPECT_LT(periods, 40);
}

TEST_F(Control, a_restart_after_a_fault_requires_clearing_and_a_withdrawn_run_request) {
    start();
    sample.adc.phase_current_counts[0] = 4000;
    EXPECT_FALSE(step(COMMAND_RUN));
    sample.adc.phase_current_counts[0] = 0;
    for (int k = 0; k < 400; k++) {
        EXPECT_FALSE(step(COMMAND_RUN));
    }
    EXPECT_FALSE(step(COMMAND_CLEAR_FAULT));
    EXPECT_EQ(state.state_machine.state, DRIVE_STATE_READY);
    EXPECT_TRUE(step(COMMAND_RUN));
}

TEST_F(Control, clearing_a_fault_on_a_turning_rotor_causes_no_other) {
    for (const double rpm : {150.0, 600.0, 2500.0, 3000.0}) {
        configure(DRIVE_CONTROLLER_PAPER);
        speed_rad_s = fixed_point::rad_s(rpm);
        for (int k = 0; k < 4000; k++) {
            step(COMMAND_OFF);
        }
        ASSERT_EQ(state.state_machine.state, DRIVE_STATE_READY) << rpm;
        EXPECT_NEAR(diagnostics.speed_q22 / fixed_point::Q22, speed_rad_s, 0.01 * speed_rad_s);
        sample.adc.phase_current_counts[0] = 4000;
        step(COMMAND_OFF);
        sample.adc.phase_current_counts[0] = 0;
        for (int k = 0; k < 400; k++) {
            step(COMMAND_OFF);
        }
        ASSERT_EQ(state.state_machine.state, DRIVE_STATE_FAULT);
        step(COMMAND_CLEAR_FAULT);
        for (int k = 0; k < 4000; k++) {
            step(COMMAND_OFF);
            ASSERT_EQ(state.state_machine.state, DRIVE_STATE_READY)
                << rpm << " r/min, " << k << " fault " << state.state_machine.record.fault;
        }
        EXPECT_NEAR(diagnostics.speed_q22 / fixed_point::Q22, speed_rad_s, 0.01 * speed_rad_s);
    }
}

TEST_F(Control, a_rotor_that_turns_at_once_while_ready_is_caught_within_5_ms_by_a_slow_observer) {
    for (const double rpm : {2900.0, 4200.0}) {
        configure_with(DRIVE_CONTROLLER_TRADITIONAL, PARAMETER_OBSERVER_BANDWIDTH_RAD_S, 200);
        speed_rad_s = 0.0;
        start();
        speed_rad_s = fixed_point::rad_s(rpm);
        for (int k = 0; k < 200; k++) {
            step(COMMAND_OFF);
        }
        EXPECT_NEAR(diagnostics.speed_q22 / fixed_point::Q22, speed_rad_s, 0.01 * speed_rad_s);
        EXPECT_EQ(state.state_machine.state, DRIVE_STATE_READY);
    }
}

// From the first period of a slip that it was measured in to the last one, a run lies between.
TEST_F(Control, a_slip_of_the_observer_that_a_run_interrupts_is_measured_anew_after_it) {
    configure_with(DRIVE_CONTROLLER_TRADITIONAL, PARAMETER_OBSERVER_BANDWIDTH_RAD_S, 200);
    for (int k = 0; k < 100; k++) {
        step(COMMAND_OFF);
    }
    speed_rad_s = fixed_point::rad_s(2900.0);
    for (int k = 0; k < 50 && state.slip.periods < 5; k++) {
        step(COMMAND_OFF);
    }
    ASSERT_EQ(state.slip.periods, 5u);
    for (int k = 0; k < 60; k++) {
        ASSERT_TRUE(step(COMMAND_RUN));
    }
    for (int k = 0; k < 200; k++) {
        step(COMMAND_OFF);
        EXPECT_LT(diagnostics.speed_q22 / fixed_point::Q22, 1.02 * speed_rad_s) << k;
    }
    EXPECT_NEAR(diagnostics.speed_q22 / fixed_point::Q22, speed_rad_s, 0.01 * speed_rad_s);
    EXPECT_EQ(state.state_machine.state, DRIVE_STATE_READY);
}

TEST_F(Control, the_reference_starts_at_the_present_speed_and_follows_the_ramp) {
    parameters.speed_ramp_q22 = fixed_point::to_fixed(0.01, fixed_point::Q22); // rad/s a period
    speed_rad_s = 20.0;
    for (int k = 0; k < 4000; k++) {
        step(COMMAND_OFF);
        ASSERT_EQ(diagnostics.speed_reference_q22, 0);
    }
    double expected = 0.0;
    for (int k = 0; k < 1000; k++) {
        step(COMMAND_RUN, 600.0);
        expected = k == 0 ? diagnostics.speed_reference_q22 / fixed_point::Q22 : expected + 0.01;
        ASSERT_NEAR(diagnostics.speed_reference_q22 / fixed_point::Q22, expected, 1e-4);
    }
    EXPECT_NEAR(expected, 30.0, 0.1);
    // A stop ramps down from there, independent of the reference in the command.
    for (int k = 0; k < 500; k++) {
        step(COMMAND_STOP, 600.0);
        expected -= 0.01;
        ASSERT_NEAR(diagnostics.speed_reference_q22 / fixed_point::Q22, expected, 1e-4);
    }
}

TEST_F(Control, a_stop_opens_the_switches_at_standstill) {
    start();
    speed_rad_s = 10.0;
    for (int k = 0; k < 2000; k++) {
        ASSERT_TRUE(step(COMMAND_RUN, 100.0));
    }
    for (int k = 0; k < 400; k++) {
        ASSERT_TRUE(step(COMMAND_STOP)) << "still turning";
    }
    // Deceleration to standstill: 10 rad/s in 50 ms.
    int periods = 0;
    while (step(COMMAND_STOP) && periods < 4000) {
        speed_rad_s = std::max(0.0, speed_rad_s - 200.0 / RATE_HZ);
        periods++;
    }
    EXPECT_EQ(state.state_machine.state, DRIVE_STATE_READY);
    EXPECT_LE(std::fabs(diagnostics.speed_q22 / fixed_point::Q22), 0.5);
}

TEST_F(Control, hysteresis_control_switches_whole_periods_only) {
    for (const drive_controller_t controller : {DRIVE_CONTROLLER_TRADITIONAL, DRIVE_CONTROLLER_PAPER}) {
        configure_with(controller, PARAMETER_BP_MODE, BP_PID_OFF);
        start();
        std::mt19937 random(2);
        for (int k = 0; k < 2000; k++) {
            for (unsigned phase = 0; phase < 3; phase++) {
                sample.adc.phase_current_counts[phase] = uint16_t(random() % 2500);
            }
            ASSERT_TRUE(step(COMMAND_RUN, 100.0));
            for (unsigned phase = 0; phase < 3; phase++) {
                ASSERT_TRUE(compare.upper[phase] == 0 || compare.upper[phase] == parameters.period_ticks);
                ASSERT_TRUE(compare.lower[phase] == 0 || compare.lower[phase] == parameters.period_ticks);
                ASSERT_GE(compare.lower[phase], compare.upper[phase]);
                // States of the hysteresis: +1 both on, 0 one on, -1 both off.
                const int on = (compare.upper[phase] != 0) + (compare.lower[phase] != 0);
                ASSERT_EQ((on - 1) * 32768, state.duty_q15[phase]);
            }
        }
    }
}

TEST_F(Control, the_paper_controller_applies_the_duty_of_the_pid_to_the_regulated_phase) {
    turns = 60.0 / 360.0; // phase a in the middle of its window
    start();
    int partial = 0;
    for (int k = 0; k < 2000; k++) {
        ASSERT_TRUE(step(COMMAND_RUN, 1.0));
        const unsigned phase = state.duty.regulated;
        ASSERT_LT(phase, 3u);
        const double duty = state.duty.pid.duty_q23 / fixed_point::Q23;
        ASSERT_NEAR(diagnostics.duty_q15 / fixed_point::Q15, duty, 0.51 / fixed_point::Q15);
        const double voltage = (double(compare.upper[phase]) + compare.lower[phase]) / parameters.period_ticks - 1.0;
        ASSERT_NEAR(voltage, duty, 0.51 / parameters.period_ticks + 0.51 / fixed_point::Q15) << k;
        partial += compare.upper[phase] > 0 && compare.upper[phase] < parameters.period_ticks;
        // The current follows the voltage, half an ampere a period at the inductance there; the rotor is held.
        uint16_t &counts = sample.adc.phase_current_counts[phase];
        counts = uint16_t(std::clamp(counts + 25.0 * voltage, 0.0, 2500.0));
    }
    EXPECT_GT(partial, 10);
}

TEST_F(Control, voltage_is_saturated_while_a_phase_is_fully_on_and_never_outside_run) {
    start();
    int saturated = 0;
    for (int k = 0; k < 400; k++) {
        // Currents that are too small, then too large for the torque.
        for (unsigned phase = 0; phase < 3; phase++) {
            sample.adc.phase_current_counts[phase] = k < 200 ? 100 : 3000;
        }
        step(COMMAND_RUN, 300.0);
        bool full = false;
        for (unsigned phase = 0; phase < 3; phase++) {
            full = full || compare.upper[phase] == parameters.period_ticks;
        }
        ASSERT_EQ(diagnostics.voltage_saturated, full) << k;
        saturated += full;
    }
    EXPECT_GT(saturated, 100);
    EXPECT_LT(saturated, 300);
    step(COMMAND_OFF);
    EXPECT_FALSE(diagnostics.voltage_saturated);
}

TEST_F(Control, the_torque_reference_is_never_negative) {
    start();
    speed_rad_s = 60.0;
    for (int k = 0; k < 4000; k++) {
        step(COMMAND_RUN, k < 2000 ? -3000.0 : 0.0);
        ASSERT_GE(diagnostics.torque_reference_q24, 0);
    }
}

// Steps of the control interrupt with the salient controller; its torque is tested in closed loop.
class SalientControl : public Control {
  protected:
    SalientControl() : Control(DRIVE_CONTROLLER_SALIENT) {}
};

TEST_F(SalientControl, only_the_salient_controller_follows_a_negative_reference) {
    for (const drive_controller_t controller :
         {DRIVE_CONTROLLER_TRADITIONAL, DRIVE_CONTROLLER_PAPER, DRIVE_CONTROLLER_SALIENT}) {
        configure(controller);
        start();
        for (int k = 0; k < 100; k++) {
            ASSERT_TRUE(step(COMMAND_RUN, -600.0));
        }
        const bool salient = controller == DRIVE_CONTROLLER_SALIENT;
        EXPECT_NEAR(diagnostics.speed_reference_q22 / fixed_point::Q22, salient ? -fixed_point::rad_s(600.0) : 0.0,
                    1e-5);
        if (salient) {
            EXPECT_LT(diagnostics.torque_reference_q24 / fixed_point::Q24, -10.0);
        } else {
            EXPECT_EQ(diagnostics.torque_reference_q24, 0);
        }
    }
}

TEST_F(SalientControl, brakes_and_reverses_a_turning_rotor_with_a_torque_reference_of_the_other_sign) {
    for (const double side : {1.0, -1.0}) {
        configure(DRIVE_CONTROLLER_SALIENT);
        speed_rad_s = side * 30.0;
        for (int k = 0; k < 4000; k++) {
            step(COMMAND_OFF);
        }
        // The ramp starts at the present speed in either direction.
        parameters.speed_ramp_q22 = fixed_point::to_fixed(0.05, fixed_point::Q22);
        step(COMMAND_RUN, -side * 300.0);
        EXPECT_NEAR(diagnostics.speed_reference_q22 / fixed_point::Q22, side * 30.0, 0.2);
        for (int k = 0; k < 2000; k++) {
            ASSERT_TRUE(step(COMMAND_RUN, -side * 300.0));
        }
        EXPECT_NEAR(diagnostics.speed_reference_q22 / fixed_point::Q22, -side * fixed_point::rad_s(300.0), 1e-5);
        EXPECT_LT(side * diagnostics.torque_reference_q24 / fixed_point::Q24, -19.0);
    }
}

TEST_F(SalientControl, the_torque_is_estimated_in_the_planned_cells_which_the_end_of_a_run_discards) {
    const auto planned = [this] {
        unsigned cells = 0;
        for (unsigned phase = 0; phase < 3; phase++) {
            cells += state.predictive.cell[0][phase].located + state.predictive.cell[1][phase].located;
        }
        return cells;
    };
    start();
    for (int k = 0; k < 10; k++) {
        sample.adc.phase_current_counts[2] = uint16_t(50 * k);
        ASSERT_TRUE(step(COMMAND_RUN, 600.0));
    }
    EXPECT_GT(planned(), 0u);
    int32_t estimate_q24 = 0;
    predictive_torque_t before;
    std::memcpy(&before, &state.predictive, sizeof before);
    ASSERT_TRUE(step(COMMAND_RUN, 600.0));
    for (unsigned phase = 0; phase < 3; phase++) {
        int32_t flux = 0;
        const int32_t current_q9 = state.measurement.current_q9[phase];
        const int32_t torque =
            current_q9 > 0 ? predictive_torque_estimate(&predictive_torque_cells(&before)[phase], current_q9, &flux)
                           : 0;
        EXPECT_EQ(state.measurement.flux_linkage[phase], flux) << phase;
        estimate_q24 += phase_map_scale(&machine_tables.torque_format, torque);
    }
    EXPECT_GT(diagnostics.torque_q24, 1 << 24);
    EXPECT_EQ(diagnostics.torque_q24, estimate_q24);

    EXPECT_FALSE(step(COMMAND_OFF));
    EXPECT_EQ(planned(), 0u);
    EXPECT_FALSE(step(COMMAND_OFF));
    EXPECT_EQ(diagnostics.torque_q24, 0) << "without a plan";
    EXPECT_TRUE(step(COMMAND_RUN, 600.0));
    EXPECT_EQ(diagnostics.torque_q24, 0) << "no cell of the previous run";
}

TEST_F(SalientControl, the_number_of_pulses_per_period_is_a_parameter) {
    for (const int32_t pulses : {1, 2}) {
        configure_with(DRIVE_CONTROLLER_SALIENT, PARAMETER_PULSES_PER_PERIOD, pulses);
        start();
        for (int k = 0; k < 200; k++) {
            ASSERT_TRUE(step(COMMAND_RUN, 1.0));
            for (unsigned phase = 0; phase < 3; phase++) {
                const int upper = compare.upper[phase], lower = compare.lower[phase];
                const double duty = state.predictive.duty_q15[phase] / fixed_point::Q15;
                ASSERT_NEAR((upper + lower) / double(parameters.period_ticks) - 1.0, duty,
                            1.0 / parameters.period_ticks);
                if (pulses == 2) {
                    ASSERT_LE(std::abs(upper - lower), 1);
                } else {
                    ASSERT_TRUE(upper == 0 || lower == parameters.period_ticks);
                }
            }
        }
    }
}

TEST_F(SalientControl, the_sliding_mode_uses_the_load_torque_source_of_the_parameter) {
    for (const drive_controller_t controller : {DRIVE_CONTROLLER_PAPER, DRIVE_CONTROLLER_SALIENT}) {
        for (const unsigned bits : {12u, 14u, 16u}) {
            for (const double load_Nm : {4.0, 0.0, 12.5}) {
                configure_with(controller, PARAMETER_LOAD_SOURCE, 1, bits);
                sample.adc.bus_voltage_counts = uint16_t(BUS_COUNTS << (bits - 12));
                sample.adc.load_torque_counts = uint16_t((load_Nm + 64.0) * std::ldexp(1.0, int(bits) - 7));
                start();
                for (int k = 0; k < 100; k++) {
                    ASSERT_TRUE(step(COMMAND_RUN, 0.0));
                }
                EXPECT_NEAR(diagnostics.torque_reference_q24 / fixed_point::Q24, load_Nm, 0.05) << bits << " bits";
                EXPECT_NEAR(diagnostics.load_torque_q24 / fixed_point::Q24, 0.0, 0.1)
                    << "the observer does not use the transducer";
            }
        }
    }
    // A load of the other sign: only a controller that brakes can answer it.
    configure_with(DRIVE_CONTROLLER_SALIENT, PARAMETER_LOAD_SOURCE, 1);
    sample.adc.load_torque_counts = uint16_t((64.0 - 5.0) * 32.0);
    start();
    for (int k = 0; k < 100; k++) {
        step(COMMAND_RUN, 0.0);
    }
    EXPECT_NEAR(diagnostics.torque_reference_q24 / fixed_point::Q24, -5.0, 0.05);
    // Without the parameter the transducer is not used.
    configure(DRIVE_CONTROLLER_SALIENT);
    sample.adc.load_torque_counts = 4095;
    start();
    for (int k = 0; k < 100; k++) {
        step(COMMAND_RUN, 0.0);
    }
    EXPECT_NEAR(diagnostics.torque_reference_q24 / fixed_point::Q24, 0.0, 0.1);
}

TEST_F(SalientControl, the_angle_after_an_edge_is_extrapolated_at_the_observed_speed) {
    for (const double speed : {15.0, 100.0, -15.0, -100.0}) {
        for (const auto [age_ticks, clock_hz] : {std::pair{0u, 200000000u},
                                                 {1u, 200000000u},
                                                 {3000u, 200000000u},
                                                 {20000u, 200000000u},
                                                 {2500u, 25000000u},
                                                 {8000u, 170000000u},
                                                 {40000u, 400000000u}}) {
            configure(DRIVE_CONTROLLER_SALIENT);
            parameters = configured(DRIVE_CONTROLLER_SALIENT, uint32_t(RATE_HZ), ENCODER_BITS, 12, {}, clock_hz);
            speed_rad_s = speed;
            for (int k = 0; k < 4000; k++) {
                step(COMMAND_OFF);
            }
            const double known_rad_s = state.observer.speed_q22 / fixed_point::Q22;
            EXPECT_NEAR(known_rad_s, speed, 0.05);
            sample.encoder.edge_known = true;
            sample.encoder.edge_forward = speed > 0.0;
            sample.encoder.edge_age_ticks = age_ticks;
            step(COMMAND_OFF);
            const double boundary = sample.encoder.counts + (speed > 0.0 ? 0.0 : 1.0);
            const double turns_now =
                std::ldexp(boundary, -int(ENCODER_BITS)) + known_rad_s * age_ticks / clock_hz / (2.0 * fixed_point::PI);
            double difference = diagnostics.angle - (turns_now - std::floor(turns_now)) * fixed_point::REV;
            difference -= std::round(difference / fixed_point::REV) * fixed_point::REV;
            EXPECT_NEAR(difference, 0.0, 2.0 + 1e-6 * std::fabs(speed) * age_ticks) << speed << ", " << age_ticks;
        }
    }
}

TEST_F(SalientControl, a_rotor_that_turns_at_the_start_is_no_load_although_its_counts_are_coarse) {
    constexpr unsigned BITS = 10; // 0.94 counts a millisecond
    parameters = configured(DRIVE_CONTROLLER_SALIENT, uint32_t(RATE_HZ), BITS);
    speed_rad_s = fixed_point::rad_s(55.0);
    turns = 102.8 / (1 << BITS); // the first count comes after 0.2 ms
    for (int k = 0; k < RATE_HZ / 100; k++) {
        sample.time_us += PERIOD_US;
        turns += speed_rad_s / (2.0 * fixed_point::PI * RATE_HZ);
        sample.encoder.counts = uint32_t(std::floor((turns - std::floor(turns)) * (1 << BITS)));
        step_as_sampled();
        ASSERT_LT(fixed_abs(state.observer.load_torque_q24), 12 << 24) << k;
    }
    EXPECT_EQ(state.state_machine.state, DRIVE_STATE_READY);
    EXPECT_NEAR(state.observer.speed_q22 / 4194304.0, speed_rad_s, 0.5 * speed_rad_s);
}

TEST_F(SalientControl, without_edges_the_angle_is_the_middle_of_the_count_and_long_after_one_the_prediction_within_it) {
    speed_rad_s = 15.0;
    for (int k = 0; k < 400; k++) {
        step(COMMAND_OFF);
    }
    const auto middle = [this] { return (sample.encoder.counts << 15) + (1u << 14); };
    sample.encoder.edge_known = true;
    sample.encoder.edge_forward = true;
    for (const uint32_t age_ticks : {20001u, HAL_ENCODER_AGE_MAX_TICKS}) {
        for (const int32_t counts : {-1, 0, 1}) { // the prediction is in the count after, in this one, in that before
            sample.encoder.edge_age_ticks = age_ticks;
            const auto predicted = uint32_t(state.observer.angle_q64 >> 32);
            sample.encoder.counts = (predicted >> 15) + uint32_t(counts);
            const uint32_t count_start = sample.encoder.counts << 15;
            step_as_sampled();
            EXPECT_EQ(diagnostics.angle, counts == 0 ? predicted : count_start + (counts < 0 ? (1u << 15) - 1 : 0))
                << age_ticks;
        }
    }
    sample.encoder.edge_age_ticks = 100;
    step(COMMAND_OFF);
    EXPECT_NE(diagnostics.angle, middle());
    sample.encoder.edge_known = false;
    step(COMMAND_OFF);
    EXPECT_EQ(diagnostics.angle, middle());
}

TEST_F(SalientControl, missing_torque_is_0_with_the_other_controllers) {
    for (const drive_controller_t controller : {DRIVE_CONTROLLER_TRADITIONAL, DRIVE_CONTROLLER_PAPER}) {
        configure(controller);
        start();
        for (int k = 0; k < 400; k++) {
            step(COMMAND_RUN, 3000.0);
            ASSERT_EQ(diagnostics.torque_missing_q24, 0);
        }
    }
    configure(DRIVE_CONTROLLER_SALIENT);
    start();
    step(COMMAND_RUN, 3000.0);
    EXPECT_GT(diagnostics.torque_missing_q24, 10 << 24) << "no current yet";
    EXPECT_TRUE(diagnostics.voltage_saturated);
    step(COMMAND_OFF);
    EXPECT_EQ(diagnostics.torque_missing_q24, 0);
}

} // namespace
