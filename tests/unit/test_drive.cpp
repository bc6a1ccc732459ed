// drive.c between a HAL that remembers and the laws: what it starts, writes, opens and passes on.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <deque>
#include <functional>
#include <random>
#include <vector>

#include <gtest/gtest.h>

#if defined(__x86_64__)
#include <csignal>

#include <ucontext.h>
#endif

extern "C" {
#include "comms/e2e.h"
#include "comms/node.h"
#include "comms/xcp_memory.h"
#include "drive/background_checks.h"
#include "drive/drive.h"
#include "drive/telemetry_collect.h"
#include "drive_codec.h"
#include "hal_adc.h"
#include "hal_can.h"
#include "hal_encoder.h"
#include "hal_interrupt.h"
#include "hal_memory.h"
#include "hal_nvm.h"
#include "hal_pwm.h"
#include "hal_random.h"
#include "hal_time.h"
#include "hal_watchdog.h"
#include "interrupts/deferred.h"
#include "rig/nvm.h"
}
#include "support/equal_parameters.h"
#include "support/frames.h"
#include "support/phase_map_results.h"

struct hal {
    hal_adc_sample_t adc{};
    std::array<uint16_t, HAL_ADC_TEMPERATURES> temperature_code = warm();
    hal_memory_t memory{};
    bool registers_intact = true;
    unsigned encoder_bits = 17;
    uint32_t encoder_counts = 1000;
    uint32_t time_us = 0;
    uint32_t clock_hz = 200000000;
    uint32_t missed = 0;
    uint32_t break_causes = 0, break_lasts = 0;
    uint32_t elapsed_ticks = 0;
    uint32_t random = 1;
    std::deque<hal_can_frame_t> to_drive;
    std::vector<hal_can_frame_t> from_drive;
    std::vector<uint16_t> starts;
    unsigned writes = 0, opens = 0;
    bool open = true;
    bool critical = false;
    hal_can_status_t can_status{};
    unsigned rejoins = 0;
    std::function<void()> before_critical_section; // interrupts that are not masked yet
    std::function<void()> after_critical_section;  // interrupts that were masked
    std::function<void()> while_telemetry_is_read, while_ticks_are_read;
    unsigned deferred_requests = 0;
    hal_pwm_compare_t written{};
    hal_reset_cause_t reset_cause = HAL_RESET_POWER;
    unsigned watchdog_starts = 0, kicks = 0;
    uint32_t kicked_us = 0;
    nvm_t nvm = erased();

    static std::array<uint16_t, HAL_ADC_TEMPERATURES> warm() {
        std::array<uint16_t, HAL_ADC_TEMPERATURES> codes{};
        codes.fill(20480); // 25 C
        return codes;
    }
    static nvm_t erased() {
        nvm_t nvm;
        nvm_init(&nvm);
        return nvm;
    }
};

extern "C" {
void hal_adc_read(const hal_t *hal, hal_adc_sample_t *sample) {
    *sample = hal->adc;
}
unsigned hal_adc_bits(const hal_t *) {
    return 12;
}
uint16_t hal_adc_temperature(const hal_t *hal, unsigned sensor) {
    return hal->temperature_code[sensor];
}
void hal_memory(const hal_t *hal, hal_memory_t *memory) {
    *memory = hal->memory;
}
bool hal_registers_intact(const hal_t *hal) {
    return hal->registers_intact;
}
uint32_t hal_time_reference_us(const hal_t *hal) {
    return hal->time_us;
}
unsigned hal_encoder_bits(const hal_t *hal) {
    return hal->encoder_bits;
}
void hal_encoder_read(const hal_t *hal, hal_encoder_sample_t *sample) {
    *sample = {};
    sample->counts = hal->encoder_counts;
}
uint32_t hal_random_u32(hal_t *hal) {
    return hal->random = 1664525 * hal->random + 1013904223;
}
uint32_t hal_time_us(const hal_t *hal) {
    return hal->time_us;
}
hal_reset_cause_t hal_reset_cause(const hal_t *hal) {
    return hal->reset_cause;
}
void hal_watchdog_start(hal_t *hal) {
    hal->watchdog_starts++;
}
void hal_watchdog_kick(hal_t *hal) {
    hal->kicks++;
    hal->kicked_us = hal->time_us;
}
void hal_critical_enter(hal_t *hal) {
    if (hal->before_critical_section) {
        hal->before_critical_section();
    }
    EXPECT_FALSE(hal->critical) << "it does not nest";
    hal->critical = true;
}
void hal_critical_leave(hal_t *hal) {
    EXPECT_TRUE(hal->critical);
    hal->critical = false;
    if (hal->after_critical_section) {
        hal->after_critical_section();
    }
}
uint64_t hal_nvm_read(const hal_t *hal, unsigned page, unsigned word) {
    return nvm_read(&hal->nvm, page, word);
}
bool hal_nvm_program(hal_t *hal, unsigned page, unsigned word, uint64_t value) {
    EXPECT_FALSE(hal->critical);
    return nvm_program(&hal->nvm, page, word, value);
}
bool hal_nvm_erase(hal_t *hal, unsigned page) {
    EXPECT_FALSE(hal->critical);
    return nvm_erase(&hal->nvm, page);
}
uint32_t hal_pwm_clock_hz(const hal_t *hal) {
    return hal->clock_hz;
}
void hal_pwm_start(hal_t *hal, uint16_t period_ticks) {
    EXPECT_TRUE(hal->open) << "the switches are opened before the timer starts";
    hal->starts.push_back(period_ticks);
}
void hal_pwm_write(hal_t *hal, const hal_pwm_compare_t *compare) {
    hal->written = *compare;
    hal->open = false;
    hal->writes++;
}
void hal_pwm_open_all(hal_t *hal) {
    hal->open = true;
    hal->opens++;
}
uint32_t hal_pwm_break(const hal_t *hal) {
    return hal->break_causes;
}
void hal_pwm_clear_break(hal_t *hal) {
    EXPECT_TRUE(hal->open) << "the switches are opened before a break is cleared";
    hal->break_causes &= hal->break_lasts;
}
uint32_t hal_interrupt_missed_triggers(hal_t *hal) {
    const uint32_t missed = hal->missed;
    hal->missed = 0;
    return missed;
}
uint32_t hal_interrupt_elapsed_ticks(const hal_t *hal) {
    const uint32_t ticks = hal->elapsed_ticks;
    if (hal->while_ticks_are_read) {
        hal->while_ticks_are_read();
    }
    return ticks;
}
void hal_interrupt_request_deferred(hal_t *hal) {
    hal->deferred_requests++;
}
bool hal_can_receive(hal_t *hal, hal_can_frame_t *frame) {
    if (hal->to_drive.empty()) {
        return false;
    }
    *frame = hal->to_drive.front();
    hal->to_drive.pop_front();
    return true;
}
uint32_t hal_can_receive_overflows(const hal_t *hal) {
    if (hal->while_telemetry_is_read) {
        hal->while_telemetry_is_read();
    }
    return 0;
}
bool hal_can_transmit(hal_t *hal, const hal_can_frame_t *frame) {
    hal->from_drive.push_back(*frame);
    return true;
}
void hal_can_status(const hal_t *hal, hal_can_status_t *status) {
    *status = hal->can_status;
}
void hal_can_rejoin(hal_t *hal) {
    hal->rejoins++;
}
}

namespace {

class Drive : public testing::Test {
  protected:
    void SetUp() override {
        hal.adc.bus_voltage_counts = 240 * 8;
        start(DRIVE_CONTROLLER_PAPER);
    }

    // Starts the drive anew.
    void start(drive_controller_t controller, bool stored_tables = false) {
        const drive_config_t config = {
            .control_rate_hz = 40000, .controller = controller, .stored_tables = stored_tables};
        ASSERT_TRUE(drive_init(&drive, &hal, &config));
    }

    // The same, which runs on without phase b.
    void start_without_phase_b() {
        ASSERT_NO_FATAL_FAILURE(start(DRIVE_CONTROLLER_SALIENT));
        parameters_set(&drive.parameters, PARAMETER_DEGRADED_RUNNING, 1);
        periods(100);
        drive.degraded.lost = 2u;
        drive.control.lost_phase = 2u;
    }

    // The response to a command of XCP, and the passes of the background until it came; {}: none in PASSES_MAX.
    std::vector<uint8_t> xcp(const std::vector<uint8_t> &bytes) {
        hal_can_frame_t frame{};
        frame.identifier = DRIVE_XCP_COMMAND_FRAME_ID;
        frame.length = uint8_t(bytes.size());
        std::copy(bytes.begin(), bytes.end(), frame.data);
        hal.from_drive.clear();
        hal.to_drive.push_back(frame);
        for (passes = 1; passes <= PASSES_MAX; passes++) {
            periods(1);
            for (const hal_can_frame_t &sent : hal.from_drive) {
                if (sent.identifier == DRIVE_XCP_RESPONSE_FRAME_ID) {
                    return {sent.data, sent.data + sent.length};
                }
            }
        }
        return {};
    }

    // The deferred interrupt, when it is requested.
    static void deferred_interrupt(drive_t *drive, hal_t *hal) {
        if (hal->deferred_requests > 0) {
            EXPECT_EQ(hal->deferred_requests, 1u);
            hal->deferred_requests = 0;
            drive_deferred_interrupt(drive, hal);
        }
    }

    void periods(int count) {
        for (int k = 0; k < count; k++) {
            hal.time_us += 25;
            drive_control_interrupt(&drive, &hal);
            conduct();
            deferred_interrupt(&drive, &hal);
            drive_background(&drive, &hal);
        }
    }

    // Currents of a rotor at standstill at the end of the period: what was written acts one period later.
    void conduct() {
        const double both_ticks = 2500.0;
        for (unsigned phase = 0; phase < 3; phase++) {
            const double duty = hal.open ? -1.0 : acting_ticks[phase] / both_ticks - 1.0;
            acting_ticks[phase] = hal.open ? 0u : unsigned(hal.written.upper[phase] + hal.written.lower[phase]);
            const double drop_V = drive.parameters.values[PARAMETER_RESISTANCE_OHM] / 16777216.0 *
                                  hal.adc.phase_current_counts[phase] * 10.0 / 512.0;
            flux_Wb[phase] = std::max(0.0, flux_Wb[phase] + (duty * 240.0 - drop_V) * 25e-6);
            const uint32_t angle = (hal.encoder_counts << 15) * 4u - phase * 0x55555555u;
            unsigned counts = 0;
            for (unsigned bit = flux_Wb[phase] > 0.0 ? 2048 : 0; bit > 0; bit /= 2) {
                const int32_t trial_q29 =
                    phase_map_results::flux_q29(machine_tables, angle, int32_t(counts + bit) * 10);
                counts += trial_q29 <= flux_Wb[phase] * 536870912.0 ? bit : 0;
            }
            hal.adc.phase_current_counts[phase] = uint16_t(counts);
        }
    }

    // A command; to run one that is not armed, with the arming but its last frame's effect.
    void command(command_request_t request, double reference_rpm = 600.0) {
        send(request, reference_rpm);
        if (request == COMMAND_RUN && !drive.comms.commands.arming.armed) {
            arm_for_run(7);
        }
    }

    // The sender's arming for a run, but the effect of its last frame.
    void arm_for_run(uint8_t arming_counter) {
        hal.to_drive.push_back(frames::arm(arming_counter, ARMING_STEP_REQUEST_RUN));
        periods(10);
        hal.to_drive.push_back(
            frames::arm(uint8_t(arming_counter + 1), ARMING_STEP_CONFIRM_RUN, ~drive.comms.commands.arming.challenge));
    }

    void send(command_request_t request, double reference_rpm = 600.0) {
        hal.to_drive.push_back(frames::command(++counter, request, int32_t(reference_rpm * 1000.0)));
    }

    // Periods with a command of the running drive every 10 ms.
    void run(double seconds, double reference_rpm = 600.0) {
        for (int k = 0; k < int(seconds * 100.0 + 0.5); k++) {
            send(COMMAND_RUN, reference_rpm);
            periods(400);
        }
    }

    // Arms for configuration; the counter of the first frame of the set.
    uint8_t arm_for_configuration() {
        hal.to_drive.push_back(frames::arm(7, ARMING_STEP_REQUEST_CONFIGURATION));
        periods(10);
        hal.to_drive.push_back(
            frames::arm(8, ARMING_STEP_CONFIRM_CONFIGURATION, ~drive.comms.commands.arming.challenge));
        return 9;
    }

    // The last response to a step of a set; status 255: none.
    drive_parameter_response_t set_response() {
        drive_parameter_response_t response{};
        response.status = 255;
        for (const hal_can_frame_t &sent : hal.from_drive) {
            if (sent.identifier == DRIVE_PARAMETER_RESPONSE_FRAME_ID &&
                sent.data[0] == PARAMETER_OPERATION_SET_CONTROL) {
                drive_parameter_response_unpack(&response, sent.data, sent.length);
            }
        }
        return response;
    }

    // A set over the bus; the response to its last frame.
    drive_parameter_response_t set(const frames::parameter_writes_t &writes) {
        for (const hal_can_frame_t &frame : frames::parameter_set(arm_for_configuration(), writes)) {
            hal.to_drive.push_back(frame);
        }
        hal.from_drive.clear();
        periods(int(writes.size()) + 4);
        return set_response();
    }

    // A set of one parameter; its status.
    int write(unsigned index, int32_t value) { return set({{index, value}}).status; }

    // The content of the only frame of an identifier since from_drive was cleared.
    template <typename frame_t>
    frame_t only_frame(uint32_t identifier, int (*unpack)(frame_t *, const uint8_t *, size_t)) {
        frame_t content{};
        unsigned seen = 0;
        for (const hal_can_frame_t &sent : hal.from_drive) {
            if (sent.identifier == identifier) {
                unpack(&content, sent.data, sent.length);
                seen++;
            }
        }
        EXPECT_EQ(seen, 1u);
        return content;
    }

    hal_t hal;
    drive_t drive;
    static constexpr unsigned PASSES_MAX = 100;
    unsigned passes = 0;
    uint8_t counter = 0;
    double flux_Wb[3] = {};
    unsigned acting_ticks[3] = {};
};

TEST_F(Drive, starts_the_timer_once_with_the_rate_s_period_and_the_machine_s_defaults) {
    EXPECT_EQ(hal.starts, std::vector<uint16_t>{2500});
    EXPECT_EQ(drive.parameters.values[PARAMETER_CONTROLLER], DRIVE_CONTROLLER_PAPER);
    EXPECT_EQ(drive.parameters.values[PARAMETER_INERTIA_KG_M2],
              machine_tables.parameter_default[PARAMETER_INERTIA_KG_M2]);
    EXPECT_EQ(drive.parameters.values[PARAMETER_FRICTION_NM_S],
              machine_tables.parameter_default[PARAMETER_FRICTION_NM_S]);
}

TEST_F(Drive, refuses_a_rate_that_the_timer_cannot_make_and_starts_nothing) {
    for (const uint32_t rate_hz : {0u, 10000u, 39999u, 200000u}) {
        hal_t other;
        drive_t refused;
        const drive_config_t config = {.control_rate_hz = rate_hz, .controller = DRIVE_CONTROLLER_TRADITIONAL};
        EXPECT_FALSE(drive_init(&refused, &other, &config));
        EXPECT_TRUE(other.starts.empty());
        EXPECT_EQ(other.writes, 0u);
    }
}

TEST_F(Drive, has_one_of_eight_nodes_and_no_other) {
    for (const unsigned node : {0u, 1u, NODE_MAX, NODE_MAX + 1, 255u}) {
        hal_t other;
        drive_t started;
        const drive_config_t config = {
            .control_rate_hz = 40000, .controller = DRIVE_CONTROLLER_TRADITIONAL, .node = uint8_t(node)};
        EXPECT_EQ(drive_init(&started, &other, &config), node < 8) << node;
        EXPECT_EQ(other.starts.size(), node < 8 ? 1u : 0u) << node;
    }
}

// [SR-03]
TEST_F(Drive, lines_of_the_torque_off_that_differ_for_200_ms_are_a_failed_check_and_before_they_are_none) {
    periods(100);
    hal.break_causes = hal.break_lasts = HAL_PWM_BREAK_STO_2;
    periods(7900); // 197.5 ms
    EXPECT_EQ(drive.control.reported_fault_mask & FAULT_BIT(FAULT_STO_DISCREPANCY), 0u);
    periods(200);
    EXPECT_EQ(drive.control.reported_fault_mask & FAULT_BIT(FAULT_STO_DISCREPANCY), FAULT_BIT(FAULT_STO_DISCREPANCY));
}

TEST_F(Drive,
       what_a_run_has_learned_of_the_phases_is_of_those_that_the_machine_has_and_no_misalignment_is_left_after_it) {
    hal.open = true;
    ASSERT_NO_FATAL_FAILURE(start(DRIVE_CONTROLLER_SALIENT));
    periods(100);
    command(COMMAND_RUN);
    run(0.05);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    const table_scale_phase_t none{};
    for (unsigned phase = 0; phase < HAL_PHASES_MAX; phase++) {
        const bool untouched = std::memcmp(&drive.table_scale.phase[phase], &none, sizeof none) == 0;
        EXPECT_EQ(untouched, phase >= machine_tables.phases) << phase;
        drive.control.flux_misalignment[phase] = 12345;
    }
    send(COMMAND_OFF);
    periods(100);
    ASSERT_NE(drive.control.state_machine.state, DRIVE_STATE_RUN);
    for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
        EXPECT_EQ(drive.control.flux_misalignment[phase], 0) << phase;
    }
}

// [SR-47]
TEST_F(Drive, starts_the_watchdog_and_kicks_it_every_millisecond_while_everything_advances) {
    EXPECT_EQ(hal.watchdog_starts, 1u);
    periods(4000); // 100 ms
    EXPECT_GE(hal.kicks, 98u);
    EXPECT_LE(hal.kicks, 100u);
}

// [SR-47]
TEST_F(Drive, kicks_the_watchdog_no_more_when_one_of_the_three_stands_still) {
    const std::vector<std::function<void()>> without = {
        // Background, deferred interrupt, control interrupt.
        [&] { drive_control_interrupt(&drive, &hal), deferred_interrupt(&drive, &hal); },
        [&] { drive_control_interrupt(&drive, &hal), drive_background(&drive, &hal); },
        [&] { drive_background(&drive, &hal); },
    };
    for (const std::function<void()> &step : without) {
        hal = hal_t{};
        SetUp();
        periods(400);
        const uint32_t stopped_us = hal.time_us;
        for (int k = 0; k < 800; k++) {
            hal.time_us += 25;
            step();
        }
        EXPECT_LE(hal.kicked_us, stopped_us + WATCHDOG_KICK_US);
        EXPECT_GE(hal.kicked_us, stopped_us - WATCHDOG_KICK_US);
    }
}

// [SR-48]
TEST_F(Drive, after_a_reset_by_the_watchdog_is_in_fault_and_runs_only_when_cleared_and_armed) {
    hal.reset_cause = HAL_RESET_WATCHDOG;
    SetUp();
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_FAULT);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_WATCHDOG);
    hal.writes = 0;
    for (int k = 0; k < 50; k++) { // a sender that simply continues
        send(COMMAND_RUN);
        periods(400);
    }
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_FAULT);
    EXPECT_FALSE(drive.comms.commands.arming.armed);
    EXPECT_EQ(hal.writes, 0u);
    nvm_store_fault_t logged{};
    ASSERT_TRUE(nvm_store_read_fault(&drive.store, &hal, 1, &logged));
    EXPECT_EQ(logged.fault, FAULT_WATCHDOG);
    send(COMMAND_CLEAR_FAULT);
    periods(100);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
    command(COMMAND_RUN);
    periods(3);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
}

// [SR-53]
TEST_F(Drive, with_a_changed_program_starts_in_a_fault_that_is_not_cleared) {
    const std::array<uint32_t, 3> program{1, 2, 3};
    hal_t changed;
    changed.memory = {.code = program.data(), .code_words = 3, .code_crc = 12345, .stack = nullptr, .stack_words = 0};
    changed.adc.bus_voltage_counts = hal.adc.bus_voltage_counts;
    drive_t other{};
    const drive_config_t config = {.control_rate_hz = 40000, .controller = DRIVE_CONTROLLER_PAPER};
    ASSERT_TRUE(drive_init(&other, &changed, &config));
    EXPECT_EQ(other.control.state_machine.state, DRIVE_STATE_FAULT);
    EXPECT_EQ(other.control.state_machine.record.fault, FAULT_CODE);
    EXPECT_EQ(other.control.reported_fault_mask, FAULT_BIT(FAULT_CODE));
    other.command.request = COMMAND_CLEAR_FAULT;
    for (int i = 0; i < 2000; i++) {
        changed.time_us += 25;
        drive_control_interrupt(&other, &changed);
        drive_deferred_interrupt(&other, &changed);
        drive_background(&other, &changed);
    }
    EXPECT_EQ(other.control.state_machine.state, DRIVE_STATE_FAULT);
    EXPECT_TRUE(changed.open);
}

// [SR-18]
TEST_F(Drive, with_an_open_temperature_sensor_is_kept_from_starting_by_that) {
    hal.temperature_code[HAL_ADC_INVERTER + 1] = 65520;
    periods(100);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_INITIALISE);
    EXPECT_EQ(drive.control.state_machine.start_inhibit_mask, FAULT_BIT(FAULT_TEMPERATURE_SENSOR));
    hal.temperature_code[HAL_ADC_INVERTER + 1] = 20480;
    periods(500);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
}

// [SR-58]
TEST_F(Drive, a_stored_set_that_cannot_be_used_keeps_it_from_starting_in_every_background) {
    drive.store.inhibited = true;
    periods(100);
    EXPECT_EQ(drive.control.reported_fault_mask, FAULT_BIT(FAULT_PARAMETER_MEMORY));
    EXPECT_EQ(drive.control.state_machine.start_inhibit_mask, FAULT_BIT(FAULT_PARAMETER_MEMORY));
    command(COMMAND_RUN, 0);
    periods(10);
    EXPECT_TRUE(hal.open);
}

// [SR-58]
TEST_F(Drive, a_stored_set_that_is_damaged_keeps_it_from_starting_before_the_first_background) {
    parameter_store_save(&drive.store);
    periods(400);
    ASSERT_EQ(nvm_read(&hal.nvm, 0, 0) != UINT64_MAX, true) << "stored";
    const drive_config_t config = {.control_rate_hz = 40000, .controller = DRIVE_CONTROLLER_PAPER};
    ASSERT_TRUE(drive_init(&drive, &hal, &config));
    EXPECT_EQ(drive.control.reported_fault_mask, 0u);
    hal.nvm.word[0][4] ^= 1;
    ASSERT_TRUE(drive_init(&drive, &hal, &config));
    EXPECT_EQ(drive.control.reported_fault_mask, FAULT_BIT(FAULT_PARAMETER_MEMORY));
    for (int k = 0; k < 100; k++) { // interrupts alone
        hal.time_us += 25;
        drive_control_interrupt(&drive, &hal);
        deferred_interrupt(&drive, &hal);
    }
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_INITIALISE);
    EXPECT_EQ(drive.control.state_machine.start_inhibit_mask, FAULT_BIT(FAULT_PARAMETER_MEMORY));
}

// The ramp of overdue commands runs after a request to stop, and the request before a bus-off ages.
// [SR-51]
TEST_F(Drive, a_request_in_effect_may_differ_from_the_received_one_in_the_ramp_after_a_stop_and_after_bus_off_alone) {
    periods(100);
    command(COMMAND_RUN);
    run(0.02);
    const drive_t running = drive;
    const hal_t before = hal;
    const struct {
        bool ramping, inhibited;
        command_request_t in_effect, received;
        bool intact;
    } cases[] = {
        {false, false, COMMAND_RUN, COMMAND_RUN, true},   {true, false, COMMAND_RUN, COMMAND_STOP, true},
        {false, false, COMMAND_RUN, COMMAND_STOP, false}, {true, false, COMMAND_STOP, COMMAND_RUN, false},
        {true, false, COMMAND_RUN, COMMAND_OFF, false},   {true, false, COMMAND_OFF, COMMAND_STOP, false},
        {false, true, COMMAND_RUN, COMMAND_OFF, true},
    };
    for (const auto &one : cases) {
        drive = running;
        hal = before;
        drive.ramping = one.ramping;
        drive.comms.bus.run_inhibited = one.inhibited;
        drive.command.request = one.in_effect;
        drive.comms.command.request = one.received;
        drive_background(&drive, &hal);
        EXPECT_EQ((drive.self_test.failed & SELF_TEST_FAULT_LATCH) == 0, one.intact)
            << one.ramping << one.inhibited << one.in_effect << one.received;
    }
}

// [SR-51]
TEST_F(Drive, a_changed_latch_is_the_fault_memory_from_the_next_background_on) {
    periods(100);
    command(COMMAND_RUN);
    run(0.05);
    for (int i = 0; i < 4; i++) {
        hal.to_drive.push_back(frames::command(uint8_t(counter + 100), COMMAND_RUN, -600000));
        periods(1);
    }
    periods(3);
    ASSERT_EQ(drive.control.state_machine.record.fault, FAULT_COMMAND_ERROR);
    drive.control.state_machine.state = DRIVE_STATE_READY; // as by a flipped bit
    drive_background(&drive, &hal);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_FAULT);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_MEMORY);
    periods(100);
    EXPECT_TRUE(hal.open);
    EXPECT_EQ(drive.self_test.failed, SELF_TEST_FAULT_LATCH);
}

// [SR-50]
TEST_F(Drive, a_changed_constant_of_the_heat_is_a_failed_check_within_2_ms) {
    uint32_t *const words[] = {&drive.control_parameters.thermal.winding.inverse_q48,
                               &drive.control_parameters.thermal.switches.rate_q48,
                               reinterpret_cast<uint32_t *>(&drive.control_parameters.temperature.limit[0]),
                               reinterpret_cast<uint32_t *>(&drive.control_parameters.temperature.limit[1]),
                               reinterpret_cast<uint32_t *>(&drive.control_parameters.temperature.torque_max_q24)};
    for (uint32_t *const word : words) {
        periods(100);
        ASSERT_EQ(drive.self_test.failed, 0u);
        *word ^= 1u << 15;
        periods(80);
        EXPECT_EQ(drive.self_test.failed, SELF_TEST_CONSTANTS);
        *word ^= 1u << 15;
        periods(80); // the pass that the changed word began
        drive.self_test.failed = 0;
    }
}

// [SR-51]
TEST_F(Drive, of_a_run_that_a_changed_state_ends_the_next_background_leaves_neither_duties_nor_a_torque) {
    periods(100);
    command(COMMAND_RUN);
    periods(20);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    ASSERT_GT(drive.control.torque_reference_q24, 0);
    for (const drive_state_t changed : {DRIVE_STATE_INITIALISE, DRIVE_STATE_READY, DRIVE_STATE_FAULT}) {
        drive_t ended = drive;
        ended.control.state_machine.state = changed; // as by a flipped bit
        ended.control.state_machine.rearmed = false;
        drive_control_interrupt(&ended, &hal);
        EXPECT_TRUE(hal.open) << changed;
        drive_background(&ended, &hal);
        EXPECT_EQ(ended.control.state_machine.record.fault, FAULT_MEMORY) << changed;
        EXPECT_EQ(ended.control.torque_reference_q24, 0) << changed;
        for (const int32_t duty_q15 : ended.control.duty_q15) {
            EXPECT_EQ(duty_q15, -32768) << changed;
        }
    }
}

TEST_F(Drive, opens_the_switches_every_period_until_it_runs) {
    periods(100);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
    EXPECT_EQ(hal.writes, 0u);
    EXPECT_GE(hal.opens, 100u);
}

TEST_F(Drive, a_command_closes_switches_and_off_opens_them) {
    periods(100);
    command(COMMAND_RUN);
    periods(3);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    EXPECT_FALSE(hal.open);
    EXPECT_GT(hal.written.upper[0] + hal.written.upper[1] + hal.written.upper[2], 0);
    command(COMMAND_OFF);
    periods(3);
    EXPECT_TRUE(hal.open);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
}

// [SR-51]
TEST_F(Drive, a_command_to_run_that_has_not_come_is_the_fault_memory_from_the_next_background_on) {
    periods(100);
    send(COMMAND_OFF);
    arm_for_run(7);
    periods(10);
    ASSERT_TRUE(drive.comms.commands.arming.armed);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
    drive.command.request = COMMAND_RUN; // as by a flipped bit
    periods(1);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_MEMORY);
    EXPECT_EQ(drive.self_test.failed, SELF_TEST_FAULT_LATCH);
    periods(1);
    EXPECT_TRUE(hal.open);
    EXPECT_EQ(drive.command.request, COMMAND_OFF) << "withdrawn";
}

// A bit of a member that begins at a byte of the drive.
void flip(drive_t &drive, size_t at, size_t bit) {
    uint8_t *bytes = reinterpret_cast<uint8_t *>(&drive) + at;
    bytes[bit / 8] = uint8_t(bytes[bit / 8] ^ 1u << bit % 8);
}

// Members by which the drive finds others; without a limit where they are used a bit of them crashes this program.
#define INDEX(member)                                                                                                  \
    { #member, offsetof(drive_t, member), sizeof(drive_t{}.member) }
const struct {
    const char *name;
    size_t at, bytes;
} INDICES[] = {
    INDEX(control.bandwidth.stage),
    INDEX(control.lost_phase),
    INDEX(control.duty.regulated),
    INDEX(control.predictive.turn),
    INDEX(control.predictive.column),
    INDEX(control.deferred_request.input.bandwidth.stage),
    INDEX(control.deferred_request.initial.predictive.conduction),
    INDEX(control.deferred.response.latest),
    INDEX(control.deferred.response.results[0].predictive.conduction),
    INDEX(control.deferred.response.results[1].predictive.conduction),
    INDEX(control.deferred.response.results[0].bandwidth),
    INDEX(control.deferred.response.results[1].bandwidth),
    INDEX(control.deferred.misalignment.phase_index),
    INDEX(control.deferred.periodic_load.index),
    INDEX(control.deferred.periodic_load.reviewed_index),
    INDEX(control.deferred.stroke_mean.ended.phase),
    INDEX(control.deferred.conduction.braking),
    INDEX(control.deferred.conduction.latest),
    INDEX(control.deferred.conduction_update),
    INDEX(control.deferred.turn),
    INDEX(degraded.lost),
    INDEX(self_test.sum_word),
    INDEX(self_test.crc_word),
    INDEX(self_test.stack_word),
    INDEX(comms.telemetry.queue.first),
    INDEX(comms.telemetry.queue.count),
    INDEX(comms.responses.first),
    INDEX(comms.responses.count),
    INDEX(store.waiting_count),
    INDEX(trace.next),
};

TEST_F(Drive, a_flipped_bit_of_an_index_leads_nowhere_outside_of_its_array) {
    for (const drive_controller_t controller : {DRIVE_CONTROLLER_PAPER, DRIVE_CONTROLLER_SALIENT}) {
        const drive_config_t config = {.control_rate_hz = 40000, .controller = controller};
        hal.time_us += 100000;
        ASSERT_TRUE(drive_init(&drive, &hal, &config));
        counter = 0;
        periods(100);
        command(COMMAND_RUN);
        run(0.05);
        ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
        const drive_t before = drive;
        const hal_t board = hal;
        for (const auto &index : INDICES) {
            for (size_t bit = 0; bit < 8 * index.bytes; bit++) {
                flip(drive, index.at, bit);
                periods(40);
                EXPECT_LT(unsigned(drive.control.state_machine.state), DRIVE_STATE_COUNT) << index.name << ' ' << bit;
                drive = before;
                hal = board;
            }
        }
    }
}

// [SR-51]
TEST_F(Drive, notes_of_the_lost_phase_that_do_not_agree_are_the_fault_memory) {
    periods(100);
    command(COMMAND_RUN);
    run(0.02);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    const drive_t before = drive;
    for (unsigned bit = 0; bit < 32; bit++) {
        for (uint32_t *const note : {&drive.control.lost_phase, &drive.degraded.lost}) {
            *note ^= UINT32_C(1) << bit;
            periods(2);
            EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_MEMORY) << bit;
            EXPECT_TRUE(hal.open) << bit;
            drive = before;
        }
    }
}

// The log has sixteen faults, and a page of the memory some thousand erasures. [SR-51] [SR-60]
TEST_F(Drive, memory_that_stays_changed_is_one_fault_at_the_time_of_its_first_check) {
    const std::function<void()> changes[] = {
        [this] { drive.control.lost_phase = 2; },
        [this] { drive.comms.command.request = COMMAND_OFF; },
        [this] { drive.control.deferred.misalignment.phase[1].offset = INT32_MIN; },
    };
    for (const auto &change : changes) {
        hal.nvm = hal_t::erased();
        SetUp();
        counter = 0;
        std::fill_n(hal.adc.phase_current_counts, 3, uint16_t(0));
        std::fill(std::begin(flux_Wb), std::end(flux_Wb), 0.0);
        periods(100);
        command(COMMAND_RUN);
        periods(20);
        ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
        change();
        periods(2);
        ASSERT_EQ(drive.control.state_machine.record.fault, FAULT_MEMORY);
        const uint32_t time_us = drive.control.state_machine.record.time_us;
        const uint32_t generation = drive.control.deferred_request.generation;
        periods(800);
        EXPECT_EQ(drive.control.state_machine.record.time_us, time_us);
        EXPECT_LE(drive.control.deferred_request.generation, generation + 1);
        EXPECT_EQ(nvm_store_newest_fault(&drive.store), 1u);
        EXPECT_EQ(drive.self_test.failed, SELF_TEST_FAULT_LATCH);
    }
}

// [SR-51]
TEST_F(Drive, memory_that_changes_in_a_fault_leaves_its_record_and_keeps_it_from_being_cleared) {
    hal.break_causes = hal.break_lasts = HAL_PWM_BREAK_OVER_CURRENT;
    periods(100);
    hal.break_lasts = 0;
    hal.break_causes = 0;
    periods(100);
    ASSERT_EQ(drive.control.state_machine.record.fault, FAULT_NONE) << "not before ready";
    hal.break_causes = HAL_PWM_BREAK_OVER_CURRENT;
    periods(2);
    ASSERT_EQ(drive.control.state_machine.record.fault, FAULT_HARDWARE_OVER_CURRENT);
    drive.control.lost_phase = 2;
    periods(2);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_HARDWARE_OVER_CURRENT);
    EXPECT_EQ(drive.self_test.failed, SELF_TEST_FAULT_LATCH);
    periods(600);
    send(COMMAND_CLEAR_FAULT);
    periods(600);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_FAULT);
}

// [SR-51]
TEST_F(Drive, a_state_that_is_none_is_the_fault_memory) {
    periods(100);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
    for (unsigned bit = 2; bit < 32; bit++) {
        const drive_t before = drive;
        drive.control.state_machine.state = drive_state_t(DRIVE_STATE_READY | 1u << bit);
        periods(2);
        EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_MEMORY) << bit;
        drive = before;
    }
}

TEST_F(Drive, a_control_rate_that_has_changed_in_memory_gives_no_constants) {
    periods(100);
    drive.parameters.control_rate_hz ^= 1u << 14;
    drive.parameters.revision++; // as a set would
    periods(50);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_MEMORY);
    EXPECT_EQ(drive.self_test.failed & SELF_TEST_PARAMETERS, SELF_TEST_PARAMETERS);
}

// [SR-51]
TEST_F(Drive, a_received_command_that_changes_in_a_run_is_the_fault_memory) {
    periods(100);
    command(COMMAND_RUN);
    run(0.05);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    drive.comms.command.request = COMMAND_OFF; // as by a flipped bit
    periods(2);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_MEMORY);
    EXPECT_TRUE(hal.open);
}

// [SR-51] [SR-52]
TEST_F(Drive, a_bit_of_a_run_s_request_or_arming_that_flips_does_not_end_the_run_without_a_fault) {
    periods(100);
    command(COMMAND_RUN);
    run(0.05);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    const drive_t before = drive;
    const hal_t board = hal;
    const struct {
        const char *name;
        size_t at, bytes;
    } members[] = {INDEX(command.request), INDEX(comms.command.request), INDEX(comms.commands.arming.armed),
                   INDEX(comms.commands.arming.check), INDEX(comms.commands.last_received_us)};
    unsigned faults = 0;
    for (const auto &member : members) {
        for (size_t bit = 0; bit < 8 * member.bytes; bit++) {
            flip(drive, member.at, bit);
            periods(40);
            const bool runs = drive.control.state_machine.state == DRIVE_STATE_RUN;
            EXPECT_NE(runs, drive.control.state_machine.record.fault == FAULT_MEMORY) << member.name << ' ' << bit;
            EXPECT_TRUE(runs || hal.open) << member.name << ' ' << bit;
            faults += !runs;
            drive = before;
            hal = board;
        }
    }
    EXPECT_GT(faults, 32u + 32u + 1u + 16u) << "requests, armed, check, and times that are not in order";
}

TEST_F(Drive, an_angle_beyond_what_is_learned_is_the_fault_memory) {
    periods(100);
    command(COMMAND_RUN);
    run(0.05);
    const int32_t most = int32_t(7 * drive.control_parameters.misalignment.probe_angle);
    for (const int32_t sign : {-1, 1}) {
        for (unsigned phase = 0; phase < machine_tables.phases; phase++) {
            const drive_t before = drive;
            drive.control.deferred.misalignment.phase[phase].offset = sign * most;
            periods(2);
            EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_NONE) << phase;
            drive = before;
            drive.control.deferred.misalignment.phase[phase].offset = sign * (most / 7 * 8 + 8);
            periods(2);
            EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_MEMORY) << phase;
            drive = before;
        }
    }
}

// [SR-07]
TEST_F(Drive, counts_faster_than_the_limit_are_over_speed_within_a_millisecond_in_either_direction) {
    for (const int direction : {1, -1}) {
        SetUp();
        periods(100);
        double counts = hal.encoder_counts;
        const auto turn = [&](double part) {
            counts += direction * part * drive.parameters.values[PARAMETER_OVER_SPEED_RPM] / 60.0 * 25e-6 * 131072.0;
            hal.encoder_counts = uint32_t(int64_t(std::floor(counts))) & 131071u;
            periods(1);
        };
        for (int k = 0; k < 8000; k++) {
            turn(0.95 * std::min(k / 4000.0, 1.0));
        }
        ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY) << direction;
        int until = 0;
        while (until < 400 && drive.control.state_machine.state == DRIVE_STATE_READY) {
            turn(1.15);
            until++;
        }
        EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_OVER_SPEED) << direction;
        EXPECT_LE(until, 44) << "1 ms, and the period of the background's check";
        EXPECT_GE(until, 4);
    }
}

// A phase without current while there is voltage. [SR-31]
TEST_F(Drive, a_lost_phase_is_switched_off_where_that_is_allowed_until_a_fault_is_cleared_outside_of_the_run) {
    for (const bool allowed : {false, true}) {
        SetUp();
        counter = 0;
        hal.adc.phase_current_counts[0] = hal.adc.phase_current_counts[1] = hal.adc.phase_current_counts[2] = 0;
        std::fill(std::begin(flux_Wb), std::end(flux_Wb), 0.0);
        parameters_set(&drive.parameters, PARAMETER_DEGRADED_RUNNING, allowed ? 1 : 0);
        drive.parameters.revision++;
        periods(100);
        command(COMMAND_RUN);
        int lost = -1;
        for (int k = 0; k < 40 && lost < 0 && drive.control.state_machine.state != DRIVE_STATE_FAULT; k++) {
            periods(1);
            for (int phase = 0; phase < 3; phase++) { // the first phase that is switched on is open
                if (lost < 0 && !hal.open && hal.written.upper[phase] + hal.written.lower[phase] > 2600) {
                    lost = phase;
                }
            }
        }
        ASSERT_GE(lost, 0);
        for (int k = 0; k < 40 && drive.control.state_machine.state == DRIVE_STATE_RUN && drive.degraded.lost == 0;
             k++) {
            hal.adc.phase_current_counts[lost] = 0;
            flux_Wb[lost] = 0.0;
            periods(1);
        }
        if (!allowed) {
            EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_PHASE_OPEN);
            EXPECT_EQ(drive.control.lost_phase, 0u);
            continue;
        }
        EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
        EXPECT_EQ(drive.degraded.lost, 1u << lost);
        EXPECT_EQ(drive.control.lost_phase, unsigned(lost) + 1u);
        periods(4);
        EXPECT_LE(hal.written.upper[lost] + hal.written.lower[lost], 0) << "its switches stay open";
        send(COMMAND_CLEAR_FAULT); // refused in a run
        periods(4);
        EXPECT_EQ(drive.control.lost_phase, unsigned(lost) + 1u);
        send(COMMAND_OFF);
        periods(4);
        EXPECT_EQ(drive.control.lost_phase, unsigned(lost) + 1u) << "the end of the run gives nothing back";
        send(COMMAND_CLEAR_FAULT);
        periods(8);
        EXPECT_EQ(drive.control.lost_phase, 0u);
        EXPECT_EQ(drive.degraded.lost, 0u);
    }
}

TEST_F(Drive, a_lost_phase_comes_back_outside_of_the_run_when_running_without_it_is_no_longer_allowed) {
    parameters_set(&drive.parameters, PARAMETER_DEGRADED_RUNNING, 1);
    periods(8);
    command(COMMAND_RUN);
    periods(8);
    drive.degraded.lost = 2u;
    drive.control.lost_phase = 2u;
    send(COMMAND_OFF);
    periods(8);
    ASSERT_NE(drive.control.state_machine.state, DRIVE_STATE_RUN);
    EXPECT_EQ(drive.degraded.lost, 2u) << "allowed still";
    parameters_set(&drive.parameters, PARAMETER_DEGRADED_RUNNING, 0);
    periods(8);
    EXPECT_EQ(drive.degraded.lost, 0u);
    EXPECT_EQ(drive.control.lost_phase, 0u);
}

TEST_F(Drive, a_position_command_reaches_the_interrupt_with_the_parameter_s_homing_and_telemetry_has_its_state) {
    ASSERT_NO_FATAL_FAILURE(start(DRIVE_CONTROLLER_SALIENT));
    periods(100);
    hal.to_drive.push_back(frames::position_command(++counter, COMMAND_RUN, POSITION_ORDER_PROFILE, 1 << 16));
    arm_for_run(7);
    periods(4);
    hal.to_drive.push_back(frames::position_command(++counter, COMMAND_RUN, POSITION_ORDER_PROFILE, 1 << 16));
    periods(4);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    EXPECT_EQ(drive.command.mode, DRIVE_MODE_POSITION);
    EXPECT_EQ(drive.control.position_command.set_point.order, POSITION_ORDER_PROFILE);
    EXPECT_EQ(drive.control.position_command.set_point.target, POSITION_ONE_REV / 4);
    EXPECT_EQ(int(drive.control.position_command.set_point.homing), drive.parameters.values[PARAMETER_HOMING_METHOD]);
    EXPECT_TRUE(drive.control.position.status.active);
    const auto state = [this] {
        drive_telemetry_t values{};
        telemetry_collect(&drive, &hal, hal.time_us, &values);
        EXPECT_EQ(values.status.mode, DRIVE_MODE_POSITION);
        return drive_position_state_t(values.position.position_state);
    };
    position_status_t *status = &drive.control.position.status;
    for (const auto &[set, expected] : std::vector<std::pair<position_status_t, drive_position_state_t>>{
             {{.reference_ended = false}, DRIVE_POSITION_STATE_MOVING},
             {{.reference_ended = true}, DRIVE_POSITION_STATE_ARRIVED},
             {{.in_position = true, .reference_ended = true}, DRIVE_POSITION_STATE_IN_POSITION},
             {{.homing = true, .in_position = true}, DRIVE_POSITION_STATE_HOMING},
             {{.homing = true, .following_error = true}, DRIVE_POSITION_STATE_FOLLOWING_ERROR}}) {
        *status = set;
        status->active = true;
        EXPECT_EQ(state(), expected);
    }
}

TEST_F(Drive, an_experiment_drives_its_phase_and_is_over_with_its_limit_or_without_commands) {
    ASSERT_NO_FATAL_FAILURE(start(DRIVE_CONTROLLER_SALIENT));
    periods(100);
    const auto experiment = [this](uint8_t number) {
        hal.to_drive.push_back(frames::identify_command(++counter, COMMAND_RUN, IDENTIFY_KIND_PULSE, 1, number));
    };
    experiment(1);
    arm_for_run(7);
    periods(2);
    experiment(2); // another number begins
    int most[3] = {};
    for (int k = 0; k < 40; k++) {
        periods(1);
        for (unsigned phase = 0; phase < 3; phase++) {
            most[phase] = std::max(most[phase], int(hal.adc.phase_current_counts[phase]));
        }
    }
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    EXPECT_TRUE(drive.control.state_machine.identifies);
    EXPECT_FALSE(hal.open);
    EXPECT_GT(most[1], 0);
    EXPECT_EQ(most[0] + most[2], 0);
    // Commands that are overdue end it at once: there is no torque to ramp.
    hal.adc.phase_current_counts[1] = 0;
    periods(int(51000 - (hal.time_us - drive.command.time_us)) / 25);
    EXPECT_EQ(drive.command.request, COMMAND_OFF);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_NONE);
    EXPECT_TRUE(hal.open);
}

// Whatever comes instead of an experiment begins after its end: with a rotor that turns, a stop too, and a run in the
// same period as that. [SR-39]
TEST_F(Drive, an_experiment_on_a_rotor_that_turns_is_over_with_any_other_request) {
    const drive_config_t config = {.control_rate_hz = 40000, .controller = DRIVE_CONTROLLER_SALIENT};
    for (const std::vector<command_request_t> &requests : std::vector<std::vector<command_request_t>>{
             {COMMAND_OFF}, {COMMAND_STOP}, {COMMAND_STOP, COMMAND_RUN}, {COMMAND_STOP, COMMAND_STOP}}) {
        ASSERT_TRUE(drive_init(&drive, &hal, &config));
        counter = 0;
        hal.encoder_counts = 1000;
        periods(100);
        hal.to_drive.push_back(frames::identify_command(++counter, COMMAND_RUN, IDENTIFY_KIND_REST, 0));
        arm_for_run(7);
        periods(8);
        ASSERT_TRUE(drive.control.state_machine.identifies);
        for (int k = 0; k < 400; k++) { // to 300 r/min
            hal.encoder_counts += k % 16 < k / 25 ? 1 : 0;
            periods(1);
        }
        ASSERT_GT(drive.control.observer.speed_q22, 1 << 22);
        for (const command_request_t request : requests) {
            send(request);
            drive_background(&drive, &hal); // no interrupt between them
        }
        hal.time_us += 25;
        drive_control_interrupt(&drive, &hal);
        deferred_interrupt(&drive, &hal);
        EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY) << requests.size() << requests[0];
        EXPECT_FALSE(drive.control.state_machine.identifies);
        EXPECT_TRUE(hal.open);
        periods(40);
        EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY) << "the end of a run disarms";
        EXPECT_EQ(drive.self_test.failed, 0u);
    }
}

// [SR-31]
TEST_F(Drive, an_experiment_closes_no_switch_of_a_lost_phase) {
    ASSERT_NO_FATAL_FAILURE(start_without_phase_b());
    uint8_t number = 0;
    for (const uint8_t phase : {1, 2, 1}) {
        for (const unsigned kind : {IDENTIFY_KIND_PULSE, IDENTIFY_KIND_HOLD}) {
            hal.to_drive.push_back(frames::identify_command(++counter, COMMAND_RUN, kind, phase, ++number));
            if (number == 1) {
                arm_for_run(7);
                periods(2);
                hal.to_drive.push_back(frames::identify_command(++counter, COMMAND_RUN, kind, phase, ++number));
            }
            bool closed = false;
            for (int k = 0; k < 80; k++) {
                periods(1);
                closed = closed || hal.written.upper[phase] + hal.written.lower[phase] > 0;
            }
            ASSERT_TRUE(drive.control.state_machine.identifies);
            EXPECT_EQ(closed, phase == 2) << int(phase) << kind;
        }
    }
}

// An experiment is one number's: whatever comes with the number of the present one changes nothing. [SR-31]
TEST_F(Drive, an_experiment_goes_on_as_it_began_until_another_number_comes_and_closes_no_switch_of_a_lost_phase) {
    ASSERT_NO_FATAL_FAILURE(start_without_phase_b());
    const auto pulse = [this](unsigned phase, uint8_t number, uint16_t begin, uint16_t width) {
        hal.to_drive.push_back(frames::identify_window(++counter, begin, width));
        hal.to_drive.push_back(frames::identify_command(++counter, COMMAND_RUN, IDENTIFY_KIND_PULSE, phase, number));
    };
    bool closed[3] = {};
    const auto follow = [&](int count) {
        std::fill(std::begin(closed), std::end(closed), false);
        for (int k = 0; k < count; k++) {
            periods(1);
            for (unsigned phase = 0; phase < 3; phase++) {
                closed[phase] |= hal.written.upper[phase] + hal.written.lower[phase] > 0;
            }
        }
    };
    pulse(2, 1, 0x8000, 16);
    arm_for_run(100);
    periods(2);
    pulse(2, 2, 0x8000, 16); // a window in which the rotor is not
    follow(40);
    ASSERT_TRUE(drive.control.state_machine.identifies);
    ASSERT_EQ(drive.identify.state, IDENTIFY_WAITS);
    for (const unsigned phase : {1u, 0u, 2u}) {
        pulse(phase, 2, 0, 0); // at once
        follow(40);
        EXPECT_FALSE(closed[0] || closed[1] || closed[2]) << phase;
        EXPECT_EQ(drive.identify.state, IDENTIFY_WAITS) << phase;
        EXPECT_EQ(drive.identify.command.phase, 2) << phase;
        EXPECT_EQ(drive.identify.command.width_q16, 16) << phase;
    }
    uint8_t number = 2;
    for (const unsigned phase : {1u, 0u, 2u}) {
        pulse(phase, ++number, 0, 0);
        follow(40);
        EXPECT_EQ(closed[phase], phase != 1) << phase;
    }
}

// A current that the voltage does not explain: tables that are not the machine's have it in experiments. [SR-31]
TEST_F(Drive, an_experiment_loses_no_phase_by_tables_that_need_not_be_the_machine_s_and_a_run_does) {
    const drive_config_t config = {.control_rate_hz = 40000, .controller = DRIVE_CONTROLLER_SALIENT};
    for (const bool experiment : {true, false}) {
        ASSERT_TRUE(drive_init(&drive, &hal, &config));
        counter = 0;
        hal.adc.phase_current_counts[0] = hal.adc.phase_current_counts[1] = hal.adc.phase_current_counts[2] = 0;
        std::fill(std::begin(flux_Wb), std::end(flux_Wb), 0.0);
        parameters_set(&drive.parameters, PARAMETER_DEGRADED_RUNNING, 1);
        drive.parameters.revision++;
        periods(100);
        if (experiment) {
            hal.to_drive.push_back(frames::identify_command(++counter, COMMAND_RUN, IDENTIFY_KIND_REST, 1));
            arm_for_run(7);
        } else {
            command(COMMAND_RUN, 0.0);
        }
        periods(20);
        ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
        ASSERT_EQ(drive.control.state_machine.identifies, experiment);
        for (int k = 0; k < 80; k++) { // 2 ms
            hal.time_us += 25;
            hal.adc.phase_current_counts[1] = 500; // 10 A
            drive_control_interrupt(&drive, &hal);
            deferred_interrupt(&drive, &hal);
            drive_background(&drive, &hal);
        }
        EXPECT_EQ(drive.control.lost_phase, experiment ? 0u : 2u);
        EXPECT_EQ(drive.degraded.lost, experiment ? 0u : 2u);
        if (experiment) {
            EXPECT_TRUE(drive.control.state_machine.identifies);
        }
    }
}

TEST_F(Drive, an_experiment_that_has_met_a_limit_withdraws_its_command) {
    ASSERT_NO_FATAL_FAILURE(start(DRIVE_CONTROLLER_TRADITIONAL)); // experiments are the controller salient's
    periods(100);
    hal.to_drive.push_back(frames::identify_command(++counter, COMMAND_RUN, IDENTIFY_KIND_HOLD, 1));
    arm_for_run(7);
    periods(2);
    hal.to_drive.push_back(frames::identify_command(++counter, COMMAND_RUN, IDENTIFY_KIND_HOLD, 1));
    periods(4);
    EXPECT_EQ(drive.identify.state, IDENTIFY_ENDED);
    EXPECT_EQ(drive.identify.limit, IDENTIFY_CONTROLLER);
    EXPECT_EQ(drive.command.request, COMMAND_OFF);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
    EXPECT_TRUE(hal.open);
}

TEST_F(Drive, an_experiment_begins_after_a_run_that_a_limit_has_ended) {
    ASSERT_NO_FATAL_FAILURE(start(DRIVE_CONTROLLER_SALIENT));
    periods(100);
    for (const uint8_t arming_counter : {7, 17}) {
        hal.to_drive.push_back(frames::identify_command(++counter, COMMAND_RUN, IDENTIFY_KIND_REST, 1));
        arm_for_run(arming_counter);
        periods(4);
        ASSERT_TRUE(drive.control.state_machine.identifies) << int(arming_counter);
        EXPECT_EQ(drive.identify.limit, IDENTIFY_WITHIN);
        drive.identify.run_periods = IDENTIFY_TIME_MS * 40u + 1u;
        periods(4);
        EXPECT_EQ(drive.identify.limit, IDENTIFY_TIME);
        ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
        EXPECT_EQ(drive.command.request, COMMAND_OFF);
        periods(400);
    }
}

TEST_F(Drive, the_end_of_an_experiment_withdraws_no_command_but_its_own) {
    ASSERT_NO_FATAL_FAILURE(start(DRIVE_CONTROLLER_SALIENT));
    periods(100);
    for (const command_request_t request : {COMMAND_STOP, COMMAND_IDENTIFY}) {
        drive.identify.begun = true; // between the interrupt that has ended it and the next one
        drive.identify.state = IDENTIFY_ENDED;
        drive.comms.commands.arming.armed = true;
        drive.command.request = request;
        drive_background(&drive, &hal);
        EXPECT_EQ(drive.command.request, request == COMMAND_STOP ? COMMAND_STOP : COMMAND_OFF);
    }
}

// Torque that would carry the speed beyond the last reference ends at once; towards it, and in torque mode, it ramps.
// [SR-04]
TEST_F(Drive, without_commands_no_torque_carries_the_speed_beyond_its_reference_in_either_direction) {
    ASSERT_NO_FATAL_FAILURE(start(DRIVE_CONTROLLER_SALIENT));
    periods(100);
    command(COMMAND_RUN);
    periods(3);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    const drive_t running = drive;
    const uint32_t time_us = hal.time_us;
    const double rad_s = 2.0 * 3.14159265358979 / 60.0 * 4194304.0;
    for (const drive_mode_t mode : {DRIVE_MODE_SPEED, DRIVE_MODE_TORQUE}) {
        for (const int direction : {1, -1}) {
            for (const double speed_rpm : {500.0, 630.0, 645.0}) {
                drive = running;
                drive.command.mode = mode;
                drive.command.speed_reference_q22 = int32_t(direction * 600.0 * rad_s);
                drive.control.observer.speed_q22 = int32_t(direction * speed_rpm * rad_s);
                drive.control.torque_reference_q24 = direction * (4 << 24);
                hal.time_us = drive.command.time_us + 60000;
                drive_background(&drive, &hal);
                const bool beyond = mode == DRIVE_MODE_SPEED && speed_rpm > 640.0; // by a sixteenth
                EXPECT_NEAR(drive.command.torque_reference_q24 / 16777216.0, beyond ? 0.0 : direction * 3.6, 0.01)
                    << mode << direction << speed_rpm;
            }
        }
    }
    hal.time_us = time_us;
}

// Boot-up, heartbeat and SDO instead of the frames of drive.dbc, whose commands have no effect. [SR-38]
TEST_F(Drive, as_a_node_of_canopen_it_speaks_that_protocol_alone_and_is_enabled_by_its_state_machine_alone) {
    drive_config_t config = {.control_rate_hz = 40000, .controller = DRIVE_CONTROLLER_SALIENT};
    config.canopen_node = 5;
    hal.from_drive.clear();
    ASSERT_TRUE(drive_init(&drive, &hal, &config));
    const auto receive = [this](uint32_t identifier, const std::vector<uint8_t> &data) {
        hal_can_frame_t frame{};
        frame.identifier = identifier;
        frame.length = uint8_t(data.size());
        std::copy(data.begin(), data.end(), frame.data);
        hal.to_drive.push_back(frame);
        periods(44);
    };
    const auto sent = [this](uint32_t identifier) {
        return std::count_if(hal.from_drive.begin(), hal.from_drive.end(),
                             [&](const hal_can_frame_t &frame) { return frame.identifier == identifier; });
    };
    const auto control = [&](uint8_t word) { receive(0x605, {0x2B, 0x40, 0x60, 0, word, 0, 0, 0}); };
    periods(400);
    EXPECT_EQ(sent(0x705), 1) << "boot-up";
    command(COMMAND_RUN);
    periods(44);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
    EXPECT_EQ(drive.comms.commands.counters.accepted, 0);
    receive(0, {1, 5});
    receive(0x605, {0x2F, 0x60, 0x60, 0, 1, 0, 0, 0}); // profile position
    control(6);
    control(7);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
    control(15);
    periods(44);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    EXPECT_EQ(drive.command.mode, DRIVE_MODE_POSITION);
    EXPECT_EQ(int(drive.control.position_command.set_point.homing), drive.parameters.values[PARAMETER_HOMING_METHOD]);
    EXPECT_EQ(drive.comms.canopen.place.position, drive.control.position.status.position);
    EXPECT_GE(sent(0x585), 4) << "answers of SDO";
    EXPECT_EQ(sent(DRIVE_STATUS_FRAME_ID), 0);
    hal.can_status.state = HAL_CAN_BUS_OFF;
    periods(4);
    EXPECT_FALSE(drive.comms.bus.run_inhibited) << "what was enabled has to be enabled anew";
    hal.can_status.state = HAL_CAN_ERROR_ACTIVE;
    periods(4000);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_NONE);
}

TEST_F(Drive, telemetry_has_the_scale_of_the_tables_single_pulses_and_the_controller) {
    drive_telemetry_t values{};
    for (const double scale : {0.75, 1.0, 1.25}) {
        drive.control.table_scale.excess_q31 = int32_t((scale - 1.0) * 0x1p31);
        drive.control.deferred.conduction.single_pulse = scale > 1.0;
        for (const drive_state_t state : {DRIVE_STATE_READY, DRIVE_STATE_RUN, DRIVE_STATE_FAULT}) {
            drive.control.state_machine.state = state;
            telemetry_collect(&drive, &hal, hal.time_us, &values);
            EXPECT_EQ(values.estimates.table_scale, unsigned(scale * 0x1p15));
            EXPECT_EQ(values.status.single_pulse, state == DRIVE_STATE_RUN && scale > 1.0) << "nothing conducts";
        }
    }
    EXPECT_EQ(values.heartbeat.controller, unsigned(DRIVE_CONTROLLER_PAPER));
}

TEST_F(Drive, has_the_period_of_telemetry_of_its_configuration_and_else_the_parameter_s) {
    const int32_t usual = drive.parameters.values[PARAMETER_TELEMETRY_PERIOD_MS];
    drive_config_t config = {.control_rate_hz = 40000, .controller = DRIVE_CONTROLLER_PAPER};
    config.telemetry_period_ms = uint32_t(usual) + 7u;
    ASSERT_TRUE(drive_init(&drive, &hal, &config));
    EXPECT_EQ(drive.parameters.values[PARAMETER_TELEMETRY_PERIOD_MS], usual + 7);
}

// [SR-05]
TEST_F(Drive, opens_the_switches_when_commands_stop_coming) {
    periods(100);
    command(COMMAND_RUN);
    periods(3);
    ASSERT_FALSE(hal.open);
    const uint32_t last_us = drive.command.time_us;
    periods(int(500000 - (hal.time_us - last_us)) / 25);
    EXPECT_FALSE(hal.open);
    periods(2);
    EXPECT_TRUE(hal.open);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_COMMAND_TIMEOUT);
    EXPECT_FALSE(drive.comms.commands.arming.armed);
    EXPECT_EQ(drive.command.request, COMMAND_OFF);
}

// [SR-04]
TEST_F(Drive, without_commands_the_torque_ramps_to_zero_in_a_tenth_of_a_second_and_comes_back_with_them) {
    for (const drive_mode_t mode : {DRIVE_MODE_SPEED, DRIVE_MODE_TORQUE}) {
        SetUp();
        counter = 0;
        periods(100);
        command(COMMAND_RUN, 1000.0);
        periods(3);
        if (mode == DRIVE_MODE_TORQUE) {
            hal.to_drive.push_back(frames::torque_command(++counter, COMMAND_RUN, 5 << 16));
            periods(3);
        }
        const auto torque = [&](uint32_t age_us) {
            periods(int(age_us - (hal.time_us - drive.command.time_us)) / 25);
            EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
            return drive.control.torque_reference_q24;
        };
        const int32_t full_q24 = torque(50000);
        ASSERT_GT(full_q24, 4 << 24);
        int32_t before_q24 = full_q24;
        for (uint32_t age_us = 51000; age_us < 150000; age_us += 1000) {
            const int32_t torque_q24 = torque(age_us);
            EXPECT_LE(torque_q24, before_q24) << age_us;
            EXPECT_NEAR(torque_q24, full_q24 * (1.0 - (age_us - 50000.0) / 100000.0), full_q24 * 0.02) << age_us;
            before_q24 = torque_q24;
        }
        EXPECT_EQ(torque(151100), 0);
        EXPECT_EQ(torque(499000), 0);
        // The same sender goes on, in sequence: no arming, no fault.
        if (mode == DRIVE_MODE_TORQUE) {
            hal.to_drive.push_back(frames::torque_command(++counter, COMMAND_RUN, 5 << 16));
        } else {
            send(COMMAND_RUN, 1000.0);
        }
        periods(10);
        EXPECT_EQ(drive.control.torque_reference_q24, full_q24);
        EXPECT_TRUE(drive.comms.commands.arming.armed);
    }
}

// [SR-04]
TEST_F(Drive, a_second_ramp_to_zero_begins_at_the_torque_of_its_time) {
    periods(100);
    command(COMMAND_RUN, 1000.0);
    periods(3);
    for (const int torque_Nm : {5, 2}) {
        hal.to_drive.push_back(frames::torque_command(++counter, COMMAND_RUN, torque_Nm << 16));
        periods(75000 / 25); // a quarter of the ramp, from 50 to 150 ms
        EXPECT_NEAR(drive.control.torque_reference_q24, 0.75 * (torque_Nm << 24), 0.02 * (torque_Nm << 24));
        ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    }
}

// [SR-05]
TEST_F(Drive, a_background_that_hangs_ends_the_run_after_half_a_second) {
    periods(100);
    command(COMMAND_RUN);
    periods(3);
    const uint32_t last_us = drive.command.time_us;
    while (hal.time_us - last_us <= 500000) {
        EXPECT_FALSE(hal.open);
        hal.time_us += 25;
        drive_control_interrupt(&drive, &hal);
        deferred_interrupt(&drive, &hal);
    }
    hal.time_us += 25;
    drive_control_interrupt(&drive, &hal);
    EXPECT_TRUE(hal.open);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_COMMAND_TIMEOUT);
}

// [SR-34]
TEST_F(Drive, one_frame_after_a_silence_does_not_start_it) {
    periods(100);
    command(COMMAND_RUN);
    run(0.05);
    periods(600000 / 25);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_FAULT);
    send(COMMAND_OFF);
    periods(10);
    send(COMMAND_CLEAR_FAULT);
    periods(10);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
    periods(40000);
    const unsigned writes = hal.writes;
    run(0.1);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
    EXPECT_EQ(hal.writes, writes);
    command(COMMAND_RUN);
    periods(3);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
}

// [SR-33]
TEST_F(Drive, four_bad_commands_end_the_run_with_the_record_of_the_moment) {
    periods(100);
    command(COMMAND_RUN);
    run(0.05);
    const int32_t torque_q24 = drive.control.torque_reference_q24;
    for (int i = 0; i < 4; i++) {
        EXPECT_FALSE(hal.open);
        hal.to_drive.push_back(frames::command(uint8_t(counter + 100), COMMAND_RUN, -600000));
        periods(1);
    }
    periods(3); // background, deferred interrupt, control interrupt
    EXPECT_TRUE(hal.open);
    const fault_record_t &record = drive.control.state_machine.record;
    EXPECT_EQ(record.fault, FAULT_COMMAND_ERROR);
    EXPECT_EQ(record.fault_mask, FAULT_BIT(FAULT_COMMAND_ERROR));
    EXPECT_EQ(record.state, DRIVE_STATE_RUN);
    EXPECT_EQ(record.time_us, hal.time_us);
    EXPECT_EQ(record.current_max_q9, drive.control.measurement.current_max_q9);
    EXPECT_GT(record.current_max_q9, 2000);
    EXPECT_EQ(record.torque_reference_q24, torque_q24);
    EXPECT_EQ(drive.control.torque_reference_q24, 0);
    const unsigned writes = hal.writes;
    periods(100);
    EXPECT_EQ(hal.writes, writes);
    EXPECT_EQ(drive.command.request, COMMAND_OFF);
    send(COMMAND_CLEAR_FAULT);
    periods(305); // since the fault 10 ms
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
}

TEST_F(Drive, a_valid_command_in_the_pass_of_the_fourth_bad_one_does_not_end_the_run_without_the_fault) {
    for (const command_request_t request : {COMMAND_RUN, COMMAND_OFF}) {
        SetUp();
        periods(100);
        command(COMMAND_RUN);
        run(0.05);
        const auto bad = frames::command(uint8_t(counter + 100), COMMAND_RUN, -600000);
        for (int i = 0; i < 3; i++) {
            hal.to_drive.push_back(bad);
            periods(1);
        }
        const uint16_t accepted = drive.comms.commands.counters.accepted;
        hal.to_drive.push_back(bad);
        send(request);
        periods(5);
        EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_FAULT);
        EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_COMMAND_ERROR);
        EXPECT_EQ(drive.comms.commands.counters.accepted, accepted + 1);
        send(COMMAND_OFF);
        periods(2);
        EXPECT_EQ(drive.command.request, COMMAND_OFF) << "commands count again";
        hal = {};
    }
}

TEST_F(Drive, reports_that_it_is_not_armed_with_its_first_telemetry) {
    periods(100);
    const auto report = only_frame(DRIVE_ARMING_FRAME_ID, drive_arming_unpack);
    EXPECT_EQ(report.armed, 0);
    EXPECT_EQ(report.attempt, ARMING_ATTEMPT_NONE);
}

TEST_F(Drive, reports_its_arming_at_once_and_then_cyclically) {
    periods(150); // telemetry is due 0.25 ms later
    hal.from_drive.clear();
    hal.to_drive.push_back(frames::arm(7, ARMING_STEP_REQUEST_RUN));
    periods(1);
    ASSERT_EQ(hal.from_drive.size(), 1u) << "the challenge, and telemetry gives way to it";
    const auto challenged = only_frame(DRIVE_ARMING_FRAME_ID, drive_arming_unpack);
    EXPECT_EQ(challenged.challenge, hal.random);
    EXPECT_EQ(challenged.attempt, ARMING_ATTEMPT_RUN);
    EXPECT_EQ(challenged.armed, 0);
    send(COMMAND_OFF);
    periods(19);
    EXPECT_EQ(hal.from_drive.size(), 1u) << "0.5 ms";
    hal.from_drive.clear();
    hal.to_drive.push_back(frames::arm(8, ARMING_STEP_CONFIRM_RUN, ~challenged.challenge));
    periods(1);
    const auto armed = only_frame(DRIVE_ARMING_FRAME_ID, drive_arming_unpack);
    EXPECT_EQ(armed.armed, 1);
    EXPECT_EQ(armed.challenge, 0u);
    hal.from_drive.clear();
    periods(200);
    EXPECT_GE(hal.from_drive.size(), 4u) << "telemetry goes on";
    hal.from_drive.clear();
    for (int k = 0; k < 10; k++) {
        send(COMMAND_OFF);
        periods(400);
    }
    EXPECT_EQ(only_frame(DRIVE_ARMING_FRAME_ID, drive_arming_unpack).armed, 1);
}

// At 40 kHz, with a background in each period or after many.
TEST_F(Drive, checks_phases_and_encoder_in_each_four_control_periods_or_as_soon_as_the_background_comes) {
    const uint32_t &checked = drive.flux.residual.sample.periods;
    periods(100);
    uint32_t last = checked;
    for (const unsigned each : {1u, 3u, 4u, 7u, 400u, 1u}) {
        const unsigned apart = (each + 3) / each * each; // from 4 on
        unsigned checks = 0;
        for (unsigned k = 0; k < 12; k++) {
            for (unsigned period = 1; period < each; period++) {
                hal.time_us += 25;
                drive_control_interrupt(&drive, &hal);
                deferred_interrupt(&drive, &hal);
            }
            periods(1);
            checks += checked != last;
            EXPECT_TRUE(checked == last || checks == 1 || checked - last == apart) << each << " " << checked - last;
            last = checked;
        }
        EXPECT_EQ(checks, 12 * each / apart) << each;
    }
}

// [SR-24]
TEST_F(Drive, a_rotor_held_at_its_place_is_not_pushed_in_vain_and_one_beside_it_or_under_way_is) {
    ASSERT_NO_FATAL_FAILURE(start(DRIVE_CONTROLLER_SALIENT));
    periods(100);
    command(COMMAND_RUN);
    run(0.02);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    const drive_t before = drive;
    const hal_t board = hal;
    const auto vain = [&](const position_status_t &place, const std::function<void()> &change) {
        drive = before;
        hal = board;
        drive.control.position.status = place;
        auto *results = const_cast<deferred_results_t *>(deferred_in_effect(&drive.control));
        results->speed.speed_reference_q22 = 4 << 22;
        results->speed.torque_max_q24 = drive.control.torque_reference_q24 = 10 << 24;
        drive.control.observer.speed_q22 = 0;
        drive.control.deferred_request.skipped_total += 8;
        change();
        background_checks(&drive, &hal, hal.time_us + 200);
        EXPECT_EQ(drive.stall.looked_us, hal.time_us + 200) << "checked";
        return drive.stall.vain;
    };
    const auto nothing = [] {};
    const auto most = int32_t(std::max<int64_t>(4 * int64_t(drive.control_parameters.encoder_middle),
                                                drive.control_parameters.position.law.window >> 16));
    EXPECT_FALSE(vain({.active = true, .error = most}, nothing));
    EXPECT_FALSE(vain({.active = true, .error = -most}, nothing));
    EXPECT_TRUE(vain({.active = true, .error = most + 1}, nothing));
    EXPECT_TRUE(vain({.active = true, .error = -most - 1}, nothing));
    EXPECT_TRUE(vain({.active = false, .error = 0}, nothing)) << "speed mode";
    EXPECT_TRUE(vain({.active = true, .error = 0, .speed_reference_q22 = 1}, nothing)) << "it moves";
    const position_status_t away = {.active = true, .error = most + 1};
    EXPECT_FALSE(vain(away, [&] { drive.control.position.homing = POSITION_HOMING_SEEKS; })) << "a stop is sought";
    EXPECT_TRUE(vain(away, [&] { drive.control.position.homing = POSITION_HOMING_RETURNS; }));
    EXPECT_FALSE(vain(away, [&] { drive.control.deferred.mode = DRIVE_MODE_TORQUE; }));
    EXPECT_FALSE(vain(away, [&] { drive.control.state_machine.identifies = true; }));
    EXPECT_FALSE(vain(away, [&] { drive.control.state_machine.state = DRIVE_STATE_READY; }));
}

TEST_F(Drive, the_shaft_s_torque_is_learned_in_torque_mode_with_known_scale_and_inertia_and_used_where_chosen) {
    ASSERT_NO_FATAL_FAILURE(start(DRIVE_CONTROLLER_SALIENT));
    periods(100);
    command(COMMAND_RUN);
    run(0.02);
    const drive_t before = drive;
    const hal_t board = hal;
    const auto check = [&](const std::function<void()> &change) {
        drive = before;
        hal = board;
        deferred_t &deferred = drive.control.deferred;
        deferred.mode = DRIVE_MODE_TORQUE;
        deferred.inertia.shift = 0;
        deferred.inertia.updates += 2u << drive.control_parameters.inertia.window_shift;
        deferred.inertia.torque_variance_q14 = deferred.inertia.acceleration_variance_q14 =
            deferred.inertia.covariance_q14 = 100 * drive.control_parameters.inertia.variance_min_q14;
        drive.table_scale.intervals = TABLE_SCALE_INTERVALS_MIN;
        drive.control.deferred_request.skipped_total += 8;
        change();
        background_checks(&drive, &hal, hal.time_us + 200);
    };
    check([] {});
    EXPECT_GT(drive.shaft_torque.variance, 0);
    check([&] { drive.control.deferred.mode = DRIVE_MODE_SPEED; });
    EXPECT_EQ(drive.shaft_torque.variance, 0) << "the torque follows a load";
    check([&] { drive.control.deferred.inertia.shift = 1; });
    EXPECT_EQ(drive.shaft_torque.variance, 0) << "another inertia";
    check([&] { drive.table_scale.intervals--; });
    EXPECT_EQ(drive.shaft_torque.variance, 0) << "no scale yet";
    for (const bool used : {false, true}) {
        for (const bool known : {false, true}) {
            for (const bool follows : {false, true}) {
                check([&] {
                    drive.shaft_torque.window = drive.control.deferred.inertia.updates >>
                                                drive.control_parameters.inertia.window_shift; /* seen */
                    drive.shaft_torque.variance = known ? 1 : 0;
                    drive.shaft_torque.factor_q30 = TABLE_SCALE_ONE_Q30 + TABLE_SCALE_ONE_Q30 / 20;
                    drive.table_scale.smooth_q30 = TABLE_SCALE_ONE_Q30;
                    drive.table_scale.smooth_complement = ~TABLE_SCALE_ONE_Q30;
                    drive.control_parameters.scale_by_shaft = used;
                    drive.control_parameters.table_scale_part_q31 = follows ? 1 << 24 : 0;
                });
                EXPECT_EQ(drive.table_scale.smooth_q30 > TABLE_SCALE_ONE_Q30, used && known && follows);
                const flux_observer_parameters_t nominal = drive.control_parameters.predictive.flux;
                const table_scale_factors_t one =
                    table_scale_factors(TABLE_SCALE_ONE_Q30, drive.control_parameters.predictive.period_q40, &nominal);
                const bool neutral = std::memcmp(&drive.control.table_scale, &one, sizeof one) == 0;
                EXPECT_TRUE(neutral || follows) << "without following the tables act as they are";
                EXPECT_FALSE(neutral && used && known && follows);
            }
        }
    }
}

TEST_F(Drive, a_misalignment_by_the_flux_linkage_is_solved_when_a_phase_has_enough_samples_and_before_it_is_kept) {
    ASSERT_NO_FATAL_FAILURE(start(DRIVE_CONTROLLER_SALIENT));
    periods(100);
    command(COMMAND_RUN);
    periods(200);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    constexpr unsigned ENOUGH = 5120;
    for (flux_angle_t &flux_angle : drive.flux_angle) {
        flux_angle.samples = ENOUGH - 40;
    }
    unsigned solved = 0;
    for (int k = 0; k < 600 && solved == 0; k++) {
        unsigned samples[3];
        for (unsigned phase = 0; phase < 3; phase++) {
            samples[phase] = drive.flux_angle[phase].samples;
            drive.control.flux_misalignment[phase] = 12345;
        }
        drive.control.observer.speed_q22 = 100 << 22; // as of a rotor that turns
        hal.time_us += 25;
        drive_control_interrupt(&drive, &hal);
        conduct();
        deferred_interrupt(&drive, &hal);
        drive.control.observer.speed_q22 = 100 << 22;
        drive_background(&drive, &hal);
        for (unsigned phase = 0; phase < 3; phase++) {
            const bool enough = samples[phase] == ENOUGH - 1 && drive.flux_angle[phase].samples == ENOUGH;
            EXPECT_EQ(drive.control.flux_misalignment[phase],
                      enough ? flux_angle_solve(&drive.flux_angle[phase]) : 12345)
                << k << ' ' << phase;
            solved += enough;
        }
    }
    EXPECT_GT(solved, 0u);
}

#if defined(__x86_64__)
// Interrupts after instructions of the background, by the processor's trap flag; masked ones wait.
std::function<void()> *interrupt = nullptr;
const bool *masked_now = nullptr;
unsigned instructions = 0, interrupt_at = 0, interrupt_again = 0;

void trap(int, siginfo_t *, void *) {
    if (++instructions >= interrupt_at && !*masked_now) {
        interrupt_at = interrupt_again > 0 ? instructions + interrupt_again : UINT32_MAX;
        (*interrupt)();
    }
}

class DriveInterrupted : public Drive {
  protected:
    void SetUp() override {
        hal.adc.bus_voltage_counts = 240 * 8;
        const drive_config_t config = {.control_rate_hz = 40000, .controller = DRIVE_CONTROLLER_SALIENT};
        ASSERT_TRUE(drive_init(&drive, &hal, &config));
        periods(100);
        command(COMMAND_RUN);
        periods(400);
        ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
        periods(int(drive.flux.residual.sample.periods + 4 - counted())); // a check is due in the next background
        counts_at = hal.encoder_counts - counted();
        hal.time_us += 25;
        once();
        drive.flux.suspicious = true;
        before = drive;
        board = hal;
        struct sigaction action {};
        action.sa_sigaction = trap;
        action.sa_flags = SA_SIGINFO;
        sigaction(SIGTRAP, &action, &others);
    }
    void TearDown() override { sigaction(SIGTRAP, &others, nullptr); }

    uint32_t counted() const {
        return drive.control.deferred_request.requests + drive.control.deferred_request.skipped_total;
    }
    // A control period in which the encoder counts on.
    void once() {
        hal.encoder_counts = counts_at + counted() + 1;
        drive_control_interrupt(&drive, &hal);
        hal.deferred_requests = 0;
        drive_deferred_interrupt(&drive, &hal);
    }
    // The background's checks, interrupted after a number of instructions and then after each further ones; how many
    // instructions they had.
    unsigned checks(unsigned at, unsigned again) {
        drive = before;
        hal = board;
        std::function<void()> event = [this] { once(); };
        interrupt = &event;
        masked_now = &hal.critical;
        instructions = 0;
        interrupt_at = at;
        interrupt_again = again;
        __asm__ volatile("pushfq\n\torq $0x100, (%%rsp)\n\tpopfq" ::: "memory", "cc");
        background_checks(&drive, &hal, hal.time_us);
        __asm__ volatile("pushfq\n\tandq $~0x100, (%%rsp)\n\tpopfq" ::: "memory", "cc");
        return instructions;
    }

    drive_t before{};
    hal_t board{};
    uint32_t counts_at = 0;
    struct sigaction others {};
};

TEST_F(DriveInterrupted, whichever_instruction_an_interrupt_comes_after_the_checks_take_the_sample_of_one_period) {
    const unsigned all = checks(UINT32_MAX, 0);
    const flux_sample_t alone = drive.flux.residual.sample;
    ASSERT_EQ(alone.periods, counted());
    unsigned of_before = 0, of_after = 0;
    for (unsigned at = 1; at < all; at += 1 + all / 150) {
        checks(at, 0);
        const flux_sample_t &sample = drive.flux.residual.sample;
        const uint32_t later = sample.periods - alone.periods;
        EXPECT_LE(later, 1u) << at;
        EXPECT_EQ(sample.encoder_angle - alone.encoder_angle, later << 15) << at;
        for (unsigned phase = 0; phase < 3; phase++) {
            if (later == 0) {
                EXPECT_EQ(sample.next_q29[phase], alone.next_q29[phase]) << at;
            } else {
                EXPECT_EQ(sample.flux_q29[phase], drive.control.applied_flux.at_sample_q29[phase]) << at;
            }
        }
        of_before += later == 0;
        of_after += later == 1;
    }
    EXPECT_GT(of_before, 0u);
    EXPECT_GT(of_after, 0u);
}

TEST_F(DriveInterrupted, interrupts_that_leave_no_time_for_a_sample_let_the_check_wait_and_change_no_verdict) {
    before.failed_checks = FAULT_BIT(FAULT_STALL);
    checks(1, 40);
    EXPECT_EQ(drive.flux.residual.sample.periods, before.flux.residual.sample.periods);
    EXPECT_EQ(drive.failed_checks, FAULT_BIT(FAULT_STALL));
    EXPECT_EQ(drive.control.reported_fault_mask & FAULT_BIT(FAULT_STALL), FAULT_BIT(FAULT_STALL));
    background_checks(&drive, &hal, hal.time_us);
    EXPECT_EQ(drive.flux.residual.sample.periods, counted()) << "the next one has time";
    EXPECT_EQ(drive.failed_checks & FAULT_BIT(FAULT_STALL), 0u);
}
#endif

// [SR-46]
TEST_F(Drive, lost_interrupts_reach_the_protection) {
    periods(100);
    command(COMMAND_RUN);
    periods(3);
    hal.missed = 3;
    periods(1);
    EXPECT_TRUE(hal.open);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_INTERRUPT_OVERRUN);
}

// [SR-02] [SR-12] [SR-45]
TEST_F(Drive, break_of_the_pwm_is_a_fault_that_lasts_as_long_as_its_cause) {
    const struct {
        uint32_t cause;
        fault_t fault;
    } breaks[] = {{HAL_PWM_BREAK_OVER_CURRENT, FAULT_HARDWARE_OVER_CURRENT},
                  {HAL_PWM_BREAK_NOT_RENEWED, FAULT_INTERRUPT_OVERRUN},
                  {HAL_PWM_BREAK_STO_1, FAULT_STO},
                  {HAL_PWM_BREAK_STO_2, FAULT_STO}};
    periods(100);
    for (const auto &expected : breaks) {
        command(COMMAND_OFF);
        periods(500); // two challenges are 10 ms apart
        command(COMMAND_RUN);
        periods(3);
        ASSERT_FALSE(hal.open);
        hal.break_causes = hal.break_lasts = expected.cause;
        periods(1);
        EXPECT_TRUE(hal.open);
        EXPECT_EQ(drive.control.state_machine.record.fault, expected.fault);
        EXPECT_EQ(drive.control.state_machine.record.fault_mask, FAULT_BIT(expected.fault));
        command(COMMAND_CLEAR_FAULT);
        periods(3);
        EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_FAULT);
        hal.break_lasts = 0;
        command(COMMAND_OFF);
        periods(3);
        command(COMMAND_CLEAR_FAULT);
        periods(405);
        EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
    }
}

// With coarse counts 16 bits of the angle show where in its count it is. [SR-40]
TEST_F(Drive, the_record_of_a_fault_has_the_angle_that_the_laws_use_up_to_the_period_of_the_fault) {
    hal.encoder_bits = 10;
    hal.encoder_counts = 300;
    hal.open = true;
    ASSERT_NO_FATAL_FAILURE(start(DRIVE_CONTROLLER_PAPER));
    periods(100);
    hal.encoder_counts = 301;
    hal.break_causes = HAL_PWM_BREAK_STO_1 | HAL_PWM_BREAK_STO_2;
    periods(1);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_FAULT);
    EXPECT_EQ(fault_trace_period(&drive.trace, FAULT_TRACE_PERIODS - 1)->adc.load_torque_counts, 64 * 301)
        << "within the count as near as possible to the prediction";
    EXPECT_EQ(fault_trace_period(&drive.trace, FAULT_TRACE_PERIODS - 2)->adc.load_torque_counts, 64 * 300 + 32);
    EXPECT_EQ(fault_trace_period(&drive.trace, 0)->adc.load_torque_counts, 64 * 300 + 32);
    EXPECT_EQ(fault_trace_period(&drive.trace, FAULT_TRACE_PERIODS), nullptr);
}

// [SR-46]
TEST_F(Drive, three_late_interrupts_in_a_row_open_the_switches_and_two_do_not) {
    const auto late = [this](int count) {
        for (int k = 0; k < count; k++) {
            hal.missed = 1;
            hal.time_us += 25;
            periods(1);
        }
    };
    periods(100);
    command(COMMAND_RUN);
    periods(3);
    late(2);
    periods(1);
    late(2);
    EXPECT_FALSE(hal.open);
    EXPECT_EQ(drive.control.protection.late_interrupts, 4u);
    late(1);
    EXPECT_TRUE(hal.open);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_INTERRUPT_OVERRUN);
    EXPECT_EQ(drive.control.state_machine.record.fault_mask, FAULT_BIT(FAULT_INTERRUPT_OVERRUN));
    EXPECT_EQ(drive.control.protection.late_interrupts, 5u);
}

// [SR-46]
TEST_F(Drive, an_interrupt_that_loses_three_triggers_is_one_late_interrupt_and_a_fault) {
    periods(100);
    command(COMMAND_RUN);
    periods(3);
    hal.missed = 3;
    hal.time_us += 75;
    periods(1);
    EXPECT_TRUE(hal.open);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_INTERRUPT_OVERRUN);
    EXPECT_EQ(drive.control.protection.late_interrupts, 1u);
}

TEST_F(Drive, processor_time_is_recorded_and_reported_without_any_reaction) {
    periods(100);
    command(COMMAND_RUN);
    periods(3);
    hal.elapsed_ticks = 70000; // far beyond the period, and yet no trigger was lost
    periods(1);
    hal.elapsed_ticks = 1234;
    hal.from_drive.clear();
    periods(4000 + 40);
    EXPECT_EQ(drive.used_ticks, 1234u);
    EXPECT_EQ(drive.worst_ticks, 70000u);
    EXPECT_EQ(drive.control.protection.late_interrupts, 0u);
    const auto processor = only_frame(DRIVE_PROCESSOR_FRAME_ID, drive_processor_unpack);
    EXPECT_EQ(processor.used_us, 1234);
    EXPECT_EQ(processor.worst_us, 65535) << "held at its end";
    EXPECT_EQ(processor.available_us, 5000);
    EXPECT_EQ(processor.late_interrupts, 0);
}

TEST_F(Drive, a_board_with_another_timer_clock_has_its_ticks_and_the_same_microseconds) {
    hal.clock_hz = 170000000;
    hal.open = true;
    ASSERT_NO_FATAL_FAILURE(start(DRIVE_CONTROLLER_PAPER));
    EXPECT_EQ(hal.starts.back(), 2125);
    hal.elapsed_ticks = 1700; // 10 us
    periods(100);
    hal.from_drive.clear();
    periods(4000 + 40);
    const auto processor = only_frame(DRIVE_PROCESSOR_FRAME_ID, drive_processor_unpack);
    EXPECT_NEAR(processor.used_us, 2000, 1);
    EXPECT_NEAR(processor.available_us, 5000, 1);
}

TEST_F(Drive, does_not_start_on_a_timer_that_cannot_make_the_rate) {
    for (const uint32_t clock_hz : {0u, 24960000u, 170000001u, 400080000u}) {
        hal = {.clock_hz = clock_hz};
        const drive_config_t config = {.control_rate_hz = 40000, .controller = DRIVE_CONTROLLER_PAPER};
        EXPECT_FALSE(drive_init(&drive, &hal, &config)) << clock_hz;
        EXPECT_TRUE(hal.starts.empty());
    }
}

TEST_F(Drive, the_time_of_the_deferred_interrupt_counts_from_the_trigger_of_its_period) {
    periods(100);
    hal.elapsed_ticks = 1500;
    drive_control_interrupt(&drive, &hal);
    EXPECT_EQ(hal.deferred_requests, 1u);
    drive_control_interrupt(&drive, &hal); // before the deferred interrupt
    drive_control_interrupt(&drive, &hal);
    EXPECT_EQ(hal.deferred_requests, 1u) << "none while one is pending";
    hal.elapsed_ticks = 2000;
    deferred_interrupt(&drive, &hal);
    EXPECT_EQ(drive.deferred_used_ticks, 2 * 5000 + 2000u);
    drive_deferred_interrupt(&drive, &hal); // not requested
    EXPECT_EQ(drive.deferred_used_ticks, 2 * 5000 + 2000u);
    hal.from_drive.clear();
    periods(4000 + 40);
    EXPECT_EQ(drive.deferred_used_ticks, 2000u);
    EXPECT_EQ(drive.deferred_worst_ticks, 2 * 5000 + 2000u);
    const auto deferred = only_frame(DRIVE_DEFERRED_FRAME_ID, drive_deferred_unpack);
    EXPECT_EQ(deferred.used_us, 2000);
    EXPECT_EQ(deferred.worst_us, 12000);
    EXPECT_EQ(deferred.skipped_periods, 2);
}

// The next control interrupt pre-empts it between the reading of both words of the time.
TEST_F(Drive, the_time_of_a_deferred_interrupt_that_is_pre_empted_while_it_is_read_is_that_of_the_end) {
    periods(100);
    drive_control_interrupt(&drive, &hal);
    ASSERT_EQ(hal.deferred_requests, 1u);
    hal.elapsed_ticks = 4990;
    hal.while_ticks_are_read = [this] {
        hal.while_ticks_are_read = nullptr;
        hal.elapsed_ticks = 20;
        drive_control_interrupt(&drive, &hal);
    };
    deferred_interrupt(&drive, &hal);
    EXPECT_EQ(drive.deferred_used_ticks, 5000 + 20u);
    EXPECT_EQ(drive.deferred_worst_ticks, 5000 + 20u);
}

TEST_F(Drive, telemetry_is_of_one_period_and_masks_the_interrupts_only_when_two_attempts_were_interrupted) {
    const drive_t before = (periods(100), drive);
    const hal_t board = hal;
    for (const int interrupts : {0, 1, 2, 100}) {
        drive = before;
        hal = board;
        hal.from_drive.clear();
        int left = interrupts, attempts = 0, masked = 0;
        uint32_t angle = 0;
        hal.while_telemetry_is_read = [&] {
            attempts++;
            masked += hal.critical;
            if (left > 0 && !hal.critical) {
                left--;
                hal.encoder_counts += 16;
                drive_control_interrupt(&drive, &hal);
                deferred_interrupt(&drive, &hal);
            }
            angle = drive.control.measurement.encoder_angle;
        };
        for (int k = 0; k < 400 && attempts == 0; k++) {
            hal.time_us += 25;
            drive_control_interrupt(&drive, &hal);
            deferred_interrupt(&drive, &hal);
            drive_background(&drive, &hal);
        }
        EXPECT_EQ(attempts, std::min(interrupts, 2) + 1) << interrupts;
        EXPECT_EQ(masked, interrupts >= 2 ? 1 : 0) << interrupts;
        EXPECT_EQ(angle, drive.control.measurement.encoder_angle) << interrupts;
        EXPECT_FALSE(hal.critical);
    }
}

// The end of a run by an interrupt before any of the background's critical sections. [SR-04]
TEST_F(Drive, the_ramp_of_overdue_commands_commands_no_run_that_an_interrupt_has_ended_before) {
    periods(100);
    command(COMMAND_RUN);
    run(0.05);
    while (hal.time_us - drive.command.time_us <= 49900) {
        periods(1);
    }
    hal.time_us += 200;
    drive_control_interrupt(&drive, &hal);
    deferred_interrupt(&drive, &hal);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    ASSERT_EQ(drive.command.mode, DRIVE_MODE_SPEED);
    const drive_t before = drive;
    const hal_t board = hal;
    int ramp = -1, sections = 0; // the section in which the mode changes
    hal.before_critical_section = [&] { sections++; };
    hal.after_critical_section = [&] { ramp = ramp < 0 && drive.command.mode == DRIVE_MODE_TORQUE ? sections : ramp; };
    drive_background(&drive, &hal);
    ASSERT_GT(ramp, 0);
    for (int at = 1; at <= ramp + 1; at++) {
        drive = before;
        hal = board;
        int section = 0;
        hal.before_critical_section = [&] {
            if (++section == at) {
                hal.break_causes = HAL_PWM_BREAK_STO_1;
                drive_control_interrupt(&drive, &hal);
            }
        };
        drive_background(&drive, &hal);
        EXPECT_EQ(drive.command.mode, at <= ramp ? DRIVE_MODE_SPEED : DRIVE_MODE_TORQUE) << at;
        EXPECT_EQ(drive.control.state_machine.state, section >= at ? DRIVE_STATE_FAULT : DRIVE_STATE_RUN) << at;
    }
}

// [SR-60]
TEST_F(Drive, a_fault_that_an_interrupt_clears_while_it_is_logged_is_no_entry_without_a_fault) {
    periods(100);
    command(COMMAND_RUN);
    run(0.02);
    hal.break_causes = HAL_PWM_BREAK_STO_1;
    periods(400);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_FAULT);
    send(COMMAND_CLEAR_FAULT);
    drive_background(&drive, &hal);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_FAULT);
    drive.store.fault_seen = false; // it is about to be logged
    const drive_t before = drive;
    const hal_t board = hal;
    bool cleared = true;
    for (int at = 1; cleared; at++) {
        drive = before;
        hal = board;
        int section = 0;
        cleared = false;
        hal.before_critical_section = [&] {
            if (++section == at) {
                for (int k = 0; k < 4000 && drive.control.state_machine.state == DRIVE_STATE_FAULT; k++) {
                    drive_control_interrupt(&drive, &hal);
                }
                cleared = true;
                EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
            }
        };
        drive_background(&drive, &hal);
        for (unsigned entry = 0; entry < drive.store.waiting_count; entry++) {
            EXPECT_NE(drive.store.waiting[entry].fault, FAULT_NONE) << at;
        }
        ASSERT_LT(at, 100);
    }
}

TEST_F(Drive, the_recorder_has_each_event_s_periods_and_no_other_s) {
    ASSERT_NO_FATAL_FAILURE(start(DRIVE_CONTROLLER_SALIENT));
    periods(100);
    sampler_setup_t setup{};
    setup.channels = 1;
    setup.divider = 1;
    const auto records = [&](sampler_event_t event, int count) {
        setup.event = event;
        EXPECT_TRUE(sampler_arm(&drive.sampler, &setup, true, &drive, DRIVE_WORDS));
        periods(count);
        const uint32_t written = drive.sampler.written;
        uint32_t record[1 + SAMPLER_CHANNELS_MAX] = {}, expected_us = hal.time_us - uint32_t(written) * 25u;
        for (uint32_t k = 0; k < written && sampler_take(&drive.sampler, record); k++) {
            expected_us += 25;
            EXPECT_TRUE(record[0] == expected_us || event == SAMPLER_EVENT_IDENTIFY) << event << ' ' << k;
        }
        sampler_stop(&drive.sampler);
        return written;
    };
    EXPECT_EQ(records(SAMPLER_EVENT_CONTROL, 7), 7u);
    EXPECT_EQ(records(SAMPLER_EVENT_BACKGROUND, 7), 7u);
    EXPECT_EQ(records(SAMPLER_EVENT_IDENTIFY, 80), 0u) << "no experiment";
    hal.to_drive.push_back(frames::identify_command(++counter, COMMAND_RUN, IDENTIFY_KIND_REST, 0));
    arm_for_run(7);
    periods(80);
    ASSERT_TRUE(drive.control.state_machine.identifies);
    EXPECT_EQ(records(SAMPLER_EVENT_IDENTIFY, 200), 5u) << "one in a millisecond";
    EXPECT_EQ(records(SAMPLER_EVENT_CONTROL, 7), 7u);
}

TEST_F(Drive, a_position_command_has_the_torque_that_a_load_of_either_sign_leaves_and_in_a_move_what_it_left_before) {
    ASSERT_NO_FATAL_FAILURE(start(DRIVE_CONTROLLER_SALIENT));
    periods(100);
    for (const int32_t moves : {1, -1, 0}) {
        drive.left_q14 = 1234;
        drive.control.position.status.speed_reference_q22 = moves;
        hal.to_drive.push_back(frames::position_command(++counter, COMMAND_OFF, POSITION_ORDER_PROFILE, 1 << 16));
        drive_background(&drive, &hal);
        EXPECT_EQ(drive.left_q14 == 1234, moves != 0) << moves;
    }
    EXPECT_NEAR(drive.left_q14, 15.0 / 16.0 * 16384.0, 2.0) << "all but a 16th";
    for (const int32_t direction : {1, -1}) {
        drive.control.observer.load_torque_q24 = direction * (drive.control_parameters.conduction.torque_max_q24 / 4);
        hal.to_drive.push_back(frames::position_command(++counter, COMMAND_OFF, POSITION_ORDER_PROFILE, 1 << 16));
        drive_background(&drive, &hal);
        EXPECT_NEAR(drive.left_q14, 11.0 / 16.0 * 16384.0, 2.0) << direction;
    }
}

// [SR-46]
TEST_F(Drive, a_deferred_interrupt_that_does_not_come_opens_the_switches) {
    periods(100);
    command(COMMAND_RUN);
    periods(3);
    ASSERT_FALSE(hal.open);
    for (int k = 0; k < 9; k++) {
        EXPECT_FALSE(hal.open) << k;
        hal.time_us += 25;
        drive_control_interrupt(&drive, &hal);
    }
    drive_control_interrupt(&drive, &hal);
    EXPECT_TRUE(hal.open);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_INTERRUPT_OVERRUN);
}

TEST_F(Drive, a_written_parameter_acts_in_the_interrupt_and_not_while_it_runs) {
    periods(100);
    EXPECT_EQ(write(PARAMETER_TORQUE_MAX_NM, 5 << 24), DRIVE_PARAMETER_RESPONSE_STATUS_DONE_CHOICE);
    EXPECT_EQ(drive.control_parameters.torque_mode.torque_max_q24, 5 << 24);
    command(COMMAND_RUN);
    periods(3);
    EXPECT_EQ(drive.control.torque_reference_q24, 5 << 24);
    EXPECT_EQ(write(PARAMETER_TORQUE_MAX_NM, 6 << 24), DRIVE_PARAMETER_RESPONSE_STATUS_NOT_WHILE_RUNNING_CHOICE);
    EXPECT_EQ(drive.control_parameters.torque_mode.torque_max_q24, 5 << 24);
}

// [SR-16]
TEST_F(Drive, heat_stays_what_it_is_and_is_another_part_of_another_continuous_current) {
    periods(100);
    const int32_t before_q9 = drive.parameters.values[PARAMETER_WINDING_CURRENT_A];
    for (const int32_t divisor : {3, 1}) {
        drive.thermal.winding_q56[1] = int64_t(1) << 53; // 1/8
        drive.thermal.switches_q56[1] = int64_t(1) << 53;
        const int32_t present_q9 = drive.parameters.values[PARAMETER_WINDING_CURRENT_A];
        ASSERT_EQ(write(PARAMETER_WINDING_CURRENT_A, before_q9 / divisor), DRIVE_PARAMETER_RESPONSE_STATUS_DONE_CHOICE);
        const double ratio = double(present_q9) / (before_q9 / divisor);
        EXPECT_NEAR(thermal_winding_load_q16(&drive.thermal) / 65536.0, ratio * ratio / 8.0, 2e-3);
        EXPECT_NEAR(thermal_switch_load_q16(&drive.thermal) / 65536.0, 1.0 / 8.0, 2e-3);
        periods(100);
        EXPECT_EQ(drive.control.state_machine.record.fault, divisor == 3 ? FAULT_WINDING_OVERLOAD : FAULT_NONE);
        drive.thermal.winding_q56[1] = 0;
        periods(100);
        send(COMMAND_CLEAR_FAULT);
        periods(600);
        ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
    }
}

// [SR-31]
TEST_F(Drive, the_torque_without_a_phase_is_found_anew_with_other_parameters) {
    parameters_set(&drive.parameters, PARAMETER_DEGRADED_RUNNING, 1);
    drive.degraded.lost = 2u;
    drive.control.lost_phase = 2u;
    periods(400);
    const int32_t most_q24 = drive.degraded.most_q24, mean_q24 = drive.degraded.mean_q24;
    ASSERT_GT(mean_q24, 0);
    const int32_t limit_q9 = drive.parameters.values[PARAMETER_CURRENT_LIMIT_A];
    ASSERT_EQ(write(PARAMETER_CURRENT_LIMIT_A, limit_q9 / 2), DRIVE_PARAMETER_RESPONSE_STATUS_DONE_CHOICE);
    periods(400);
    EXPECT_EQ(drive.degraded.lost, 2u);
    EXPECT_GT(drive.degraded.mean_q24, 0);
    EXPECT_LT(drive.degraded.mean_q24, mean_q24 / 4 * 3);
    EXPECT_LT(drive.control.torque_limit_q24, most_q24 / 4 * 3);
}

TEST_F(Drive, another_inertia_forgets_what_the_shaft_has_shown_by_the_one_before_and_no_other_parameter_does) {
    periods(100);
    const int32_t inertia_q30 = drive.parameters.values[PARAMETER_INERTIA_KG_M2];
    const int32_t band_q24 = drive.parameters.values[PARAMETER_TORQUE_BAND_INNER_NM];
    const std::pair<unsigned, int32_t> sets[] = {{PARAMETER_TORQUE_BAND_INNER_NM, band_q24 / 2},
                                                 {PARAMETER_INERTIA_KG_M2, inertia_q30 / 20 * 19}};
    for (const auto &[index, value] : sets) {
        drive.shaft_torque = {.variance = INT64_C(1) << 40, .covariance = INT64_C(19) << 35, .factor_q30 = 31 << 25};
        ASSERT_EQ(write(index, value), DRIVE_PARAMETER_RESPONSE_STATUS_DONE_CHOICE);
        drive.table_scale.smooth_q30 = 1 << 30;
        drive.table_scale.smooth_complement = ~drive.table_scale.smooth_q30;
        command(COMMAND_RUN);
        run(0.05);
        ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
        const double excess = drive.control.table_scale.excess_q31 / 0x1p31, followed = 1.0 - std::exp(-0.05 / 0.2);
        EXPECT_NEAR(excess, index == PARAMETER_INERTIA_KG_M2 ? 0.0 : -followed / 32.0, 0.001) << index;
        send(COMMAND_OFF);
        periods(4);
    }
}

// [SR-56]
TEST_F(Drive, five_unprotected_frames_change_nothing) {
    periods(100);
    const parameters_t before = drive.parameters;
    const control_parameters_t control_before = drive.control_parameters;
    for (const auto &[index, value] : frames::parameter_writes_t{{PARAMETER_CURRENT_TRIP_A, 79 << 9},
                                                                 {PARAMETER_OVER_VOLTAGE_V, 510 << 6},
                                                                 {PARAMETER_UNDER_VOLTAGE_V, 0},
                                                                 {PARAMETER_COMMAND_TIMEOUT_MS, 400},
                                                                 {PARAMETER_CONTROLLER, DRIVE_CONTROLLER_SALIENT}}) {
        hal.from_drive.clear();
        hal.to_drive.push_back(frames::parameter_request(PARAMETER_OPERATION_WRITE, index, 0, value));
        periods(2);
        const auto response = only_frame(DRIVE_PARAMETER_RESPONSE_FRAME_ID, drive_parameter_response_unpack);
        EXPECT_EQ(response.status, PARAMETER_STATUS_UNPROTECTED);
        EXPECT_EQ(response.value, before.values[index]);
    }
    for (const unsigned operation : {PARAMETER_OPERATION_SAVE, PARAMETER_OPERATION_RESTORE_DEFAULTS}) {
        hal.from_drive.clear();
        hal.to_drive.push_back(frames::parameter_request(operation, 0, 0, 0));
        periods(2);
        const auto response = only_frame(DRIVE_PARAMETER_RESPONSE_FRAME_ID, drive_parameter_response_unpack);
        EXPECT_EQ(response.status, PARAMETER_STATUS_UNPROTECTED);
    }
    EXPECT_EQ(std::memcmp(&before, &drive.parameters, sizeof before), 0);
    EXPECT_EQ(std::memcmp(&control_before, &drive.control_parameters, sizeof control_before), 0);
    EXPECT_EQ(drive.store.saving, NVM_STORE_IDLE);
}

TEST_F(Drive, what_waits_for_the_memory_when_a_run_begins_is_stored_after_it) {
    periods(400);
    command(COMMAND_RUN);
    run(0.05);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    parameter_store_save(&drive.store);
    const nvm_t before = hal.nvm;
    run(0.05);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    EXPECT_EQ(std::memcmp(&before, &hal.nvm, sizeof before), 0);
    EXPECT_EQ(drive.store.saving, NVM_STORE_SAVING);
    send(COMMAND_OFF);
    periods(4000);
    EXPECT_EQ(drive.store.saving, NVM_STORE_SAVED);
}

// Commands of XCP in their order; a response that waits for the memory comes in a later pass.
class DriveWithTables : public Drive {
  protected:
    void SetUp() override {
        hal.adc.bus_voltage_counts = 240 * 8;
        start(DRIVE_CONTROLLER_PAPER, true);
    }

    void unlock() {
        const std::vector<uint8_t> seed = xcp({0xF8, 0, XCP_RESOURCE_PROGRAMMING});
        ASSERT_EQ(seed.size(), 6u);
        const std::vector<uint8_t> unlocked =
            xcp({0xF7, 4, uint8_t(~seed[2]), uint8_t(~seed[3]), uint8_t(~seed[4]), uint8_t(~seed[5])});
        ASSERT_EQ(unlocked.at(0), 0xFF);
    }

    static constexpr unsigned LATER = 2; // passes after the operations: the response is made, and sent
};

// [SR-61]
TEST_F(DriveWithTables, answers_a_command_that_writes_the_memory_when_the_memory_has_it) {
    const std::vector<uint8_t> DONE{0xFF};
    EXPECT_EQ(xcp({0xFF, 0}).at(1), XCP_RESOURCE_CALIBRATION | XCP_RESOURCE_DAQ | XCP_RESOURCE_PROGRAMMING);
    ASSERT_NO_FATAL_FAILURE(unlock());
    EXPECT_EQ(xcp({0xD2}).at(0), 0xFF);
    EXPECT_EQ(xcp({0xF6, 0, 0, 0, uint8_t(XCP_AREA_TABLES), uint8_t(XCP_AREA_TABLES >> 8),
                   uint8_t(XCP_AREA_TABLES >> 16), uint8_t(XCP_AREA_TABLES >> 24)}),
              DONE);
    EXPECT_EQ(passes, 1u);
    const uint32_t bytes = sizeof(machine_tables_t);
    EXPECT_EQ(xcp({0xD1, 0, 0, 0, uint8_t(bytes), uint8_t(bytes >> 8), 0, 0}), DONE);
    EXPECT_EQ(passes, 2 + LATER) << "header and identity into an erased memory";
    EXPECT_EQ(drive.tables.state, TABLE_STORE_TAKING);
    EXPECT_EQ(xcp({0xD0, 6, 1, 2, 3, 4, 5, 6}), DONE);
    EXPECT_EQ(passes, 1u) << "less than a word of the memory";
    EXPECT_EQ(xcp({0xD0, 6, 7, 8, 9, 10, 11, 12}), DONE);
    EXPECT_EQ(passes, 1 + LATER) << "a word";
    EXPECT_EQ(drive.tables.taken, 12u);
}

TEST_F(Drive, without_a_memory_of_tables_programming_is_no_resource) {
    const std::vector<uint8_t> response = xcp({0xFF, 0});
    ASSERT_EQ(response.size(), 8u);
    EXPECT_EQ(response[1], XCP_RESOURCE_CALIBRATION | XCP_RESOURCE_DAQ);
}

// [SR-56]
TEST_F(Drive, a_set_acts_as_a_whole_with_its_last_frame_and_not_before) {
    periods(100);
    const parameters_t before = drive.parameters;
    const auto frames = frames::parameter_set(arm_for_configuration(), {{PARAMETER_TORQUE_MAX_NM, 5 << 24},
                                                                        {PARAMETER_CURRENT_LIMIT_A, 40 << 9},
                                                                        {PARAMETER_CURRENT_TRIP_A, 41 << 9}});
    for (const hal_can_frame_t &frame : frames) {
        EXPECT_EQ(std::memcmp(before.values, drive.parameters.values, sizeof before.values), 0);
        hal.to_drive.push_back(frame);
        periods(3);
    }
    EXPECT_EQ(drive.control_parameters.torque_mode.torque_max_q24, 5 << 24);
    EXPECT_EQ(drive.control_parameters.predictive.current_limit_q9, 40 << 9);
    EXPECT_EQ(drive.control_parameters.protection.current_trip_q9, 41 << 9);
    EXPECT_FALSE(drive.comms.commands.arming.configuring);
}

// A set copies, applies and stores only values that have not changed in memory since they were set. [SR-57]
TEST_F(Drive, a_parameter_that_changed_in_memory_is_a_fault_and_neither_put_into_effect_nor_stored) {
    periods(100);
    const int32_t trip_q9 = drive.control_parameters.protection.current_trip_q9;
    const std::vector<hal_can_frame_t> sets[] = {frames::parameter_set(9, {{PARAMETER_TORQUE_MAX_NM, 5 << 24}}),
                                                 {frames::parameter_set_control(9, PARAMETER_SET_STEP_SAVE)}};
    drive.parameters.values[PARAMETER_CURRENT_TRIP_A] ^= 1 << 11;
    for (const auto &set : sets) {
        arm_for_configuration();
        hal.from_drive.clear();
        hal.to_drive.insert(hal.to_drive.end(), set.begin(), set.end());
        periods(10);
        EXPECT_EQ(set_response().status, PARAMETER_STATUS_MEMORY);
    }
    EXPECT_EQ(drive.control_parameters.protection.current_trip_q9, trip_q9);
    EXPECT_EQ(drive.store.saving, NVM_STORE_IDLE);
    periods(100);
    EXPECT_EQ(drive.self_test.failed, SELF_TEST_PARAMETERS);
    command(COMMAND_RUN);
    run(0.05);
    EXPECT_TRUE(hal.open);
    parameter_store_save(&drive.store); // changed after the frame
    send(COMMAND_OFF);
    periods(4000);
    EXPECT_EQ(drive.store.saving, NVM_STORE_FAILED);
    EXPECT_EQ(drive.store.parameters.sequence, 0u);
}

// [SR-57]
TEST_F(Drive, a_staged_value_that_changed_in_memory_is_not_applied) {
    periods(100);
    auto set = frames::parameter_set(arm_for_configuration(), {{PARAMETER_TORQUE_MAX_NM, 5 << 24}});
    const hal_can_frame_t apply = set.back();
    set.pop_back();
    hal.to_drive.insert(hal.to_drive.end(), set.begin(), set.end());
    periods(10);
    drive.comms.set.values[PARAMETER_CURRENT_TRIP_A] ^= 1 << 11;
    const parameters_t before = drive.parameters;
    hal.from_drive.clear();
    hal.to_drive.push_back(apply);
    periods(10);
    EXPECT_EQ(set_response().status, PARAMETER_STATUS_MEMORY);
    EXPECT_EQ(std::memcmp(&before, &drive.parameters, sizeof before), 0);
}

// [SR-56]
TEST_F(Drive, a_recording_of_a_set_changes_nothing) {
    periods(100);
    std::vector<hal_can_frame_t> recording{frames::arm(7, ARMING_STEP_REQUEST_CONFIGURATION)};
    arm_for_configuration();
    recording.push_back(hal.to_drive.back());
    const auto set = frames::parameter_set(9, {{PARAMETER_CURRENT_TRIP_A, 79 << 9}});
    recording.insert(recording.end(), set.begin(), set.end());
    hal.to_drive.insert(hal.to_drive.end(), set.begin(), set.end());
    periods(10);
    ASSERT_EQ(drive.parameters.values[PARAMETER_CURRENT_TRIP_A], 79 << 9);
    ASSERT_EQ(write(PARAMETER_CURRENT_TRIP_A, 75 << 9), PARAMETER_STATUS_DONE);
    for (const int distance : {1, 10, 1000, 100000}) { // periods between the frames
        hal.from_drive.clear();
        for (const hal_can_frame_t &frame : recording) {
            hal.to_drive.push_back(frame);
            periods(distance);
        }
        EXPECT_EQ(set_response().status, PARAMETER_STATUS_NOT_ARMED);
        EXPECT_EQ(drive.parameters.values[PARAMETER_CURRENT_TRIP_A], 75 << 9);
    }
    EXPECT_GE(drive.comms.commands.arming.refused, 4 * 4);
}

// [SR-56]
TEST_F(Drive, a_set_with_a_missing_a_changed_or_an_additional_frame_is_refused) {
    periods(100);
    const parameters_t before = drive.parameters;
    const frames::parameter_writes_t writes = {
        {PARAMETER_TORQUE_MAX_NM, 5 << 24}, {PARAMETER_CURRENT_LIMIT_A, 40 << 9}, {PARAMETER_OVER_SPEED_RPM, 1000}};
    for (int kind = 0; kind < 8; kind++) {
        auto set = frames::parameter_set(arm_for_configuration(), writes);
        commands_counters_t counted = drive.comms.commands.counters;
        int status = PARAMETER_STATUS_INCOMPLETE;
        switch (kind) {
        case 0: // no begin
        case 1: // no first write
        case 2:
        case 3:
            set.erase(set.begin() + kind);
            break;
        case 4: // a bit of a value
            set[2].data[5] ^= 1;
            counted.wrong_checksum++;
            break;
        case 5: // twice: as the acknowledgement's disturbance does; the copy is dropped
            set.insert(set.begin() + 2, set[1]);
            counted.wrong_counter++;
            status = PARAMETER_STATUS_DONE;
            break;
        case 6: // other order
            std::swap(set[1], set[2]);
            counted.wrong_counter++;
            break;
        default: // another write instead of one
            set[2] = frames::parameter_write(set[2].data[2], PARAMETER_CURRENT_LIMIT_A, 41 << 9);
            break;
        }
        hal.from_drive.clear();
        hal.to_drive.insert(hal.to_drive.end(), set.begin(), set.end());
        periods(10);
        EXPECT_EQ(set_response().status, status) << kind;
        EXPECT_EQ(drive.comms.commands.counters.wrong_checksum, counted.wrong_checksum) << kind;
        EXPECT_EQ(drive.comms.commands.counters.wrong_counter, counted.wrong_counter) << kind;
        if (status == PARAMETER_STATUS_DONE) {
            EXPECT_EQ(drive.parameters.values[PARAMETER_OVER_SPEED_RPM], 1000);
            const auto restored = frames::parameter_set(arm_for_configuration(), {}, PARAMETER_SET_STEP_BEGIN_DEFAULTS);
            hal.to_drive.insert(hal.to_drive.end(), restored.begin(), restored.end());
            periods(10);
        }
        EXPECT_EQ(std::memcmp(before.values, drive.parameters.values, sizeof before.values), 0) << kind;
    }
    // More than two in succession are missing: the sequence counter.
    auto set = frames::parameter_set(arm_for_configuration(), writes);
    set.erase(set.begin() + 1, set.begin() + 4);
    hal.from_drive.clear();
    hal.to_drive.insert(hal.to_drive.end(), set.begin(), set.end());
    const uint16_t counted = drive.comms.commands.counters.wrong_counter;
    periods(10);
    EXPECT_EQ(set_response().value & 0xFF, PARAMETER_SET_STEP_BEGIN) << "apply has no response";
    EXPECT_EQ(drive.comms.commands.counters.wrong_counter, counted + 1);
    EXPECT_EQ(std::memcmp(before.values, drive.parameters.values, sizeof before.values), 0);
}

// [SR-56]
TEST_F(Drive, a_refused_set_names_its_parameters_and_changes_nothing) {
    periods(100);
    const parameters_t before = drive.parameters;
    const struct {
        frames::parameter_writes_t writes;
        parameter_status_t status;
        unsigned index, other;
    } cases[] = {
        {{{PARAMETER_OVER_SPEED_RPM, 1000}, {PARAMETER_CURRENT_TRIP_A, 80 << 9}},
         PARAMETER_STATUS_OUT_OF_RANGE,
         PARAMETER_CURRENT_TRIP_A,
         0},
        {{{PARAMETER_OVER_SPEED_RPM, 9}}, PARAMETER_STATUS_OUT_OF_RANGE, PARAMETER_OVER_SPEED_RPM, 0},
        {{{PARAMETER_OVER_SPEED_RPM, 1000}, {PARAMETER_CURRENT_LIMIT_A, 60 << 9}, {PARAMETER_CURRENT_TRIP_A, 50 << 9}},
         PARAMETER_STATUS_CONTRADICTION,
         PARAMETER_CURRENT_LIMIT_A,
         PARAMETER_CURRENT_TRIP_A},
        {{{PARAMETER_CURRENT_LIMIT_A, (75 << 9) + 1}},
         PARAMETER_STATUS_CONTRADICTION,
         PARAMETER_CURRENT_LIMIT_A,
         PARAMETER_CURRENT_TRIP_A},
        {{{PARAMETER_UNDER_VOLTAGE_V, 300 << 6}},
         PARAMETER_STATUS_CONTRADICTION,
         PARAMETER_UNDER_VOLTAGE_V,
         PARAMETER_OVER_VOLTAGE_V},
        {{{PARAMETER_TURN_ON_ANGLE_DEG, 300 << 7}},
         PARAMETER_STATUS_CONTRADICTION,
         PARAMETER_TURN_ON_ANGLE_DEG,
         PARAMETER_TURN_OFF_ANGLE_DEG},
        {{{PARAMETER_TURN_OFF_ANGLE_DEG, (348 << 7) + 1}},
         PARAMETER_STATUS_CONTRADICTION,
         PARAMETER_TURN_OFF_ANGLE_DEG,
         PARAMETER_OUTGOING_OFF_ANGLE_DEG},
        {{{PARAMETER_TURN_ON_ANGLE_DEG, 90 << 7},
          {PARAMETER_TURN_OFF_ANGLE_DEG, 360 << 7},
          {PARAMETER_OUTGOING_OFF_ANGLE_DEG, 360 << 7}},
         PARAMETER_STATUS_CONTRADICTION,
         PARAMETER_TURN_ON_ANGLE_DEG,
         PARAMETER_TURN_OFF_ANGLE_DEG},
        {{{PARAMETER_TORQUE_BAND_INNER_NM, (1 << 24) + 1}},
         PARAMETER_STATUS_CONTRADICTION,
         PARAMETER_TORQUE_BAND_INNER_NM,
         PARAMETER_TORQUE_BAND_OUTER_NM},
        {{{PARAMETER_OVER_VOLTAGE_V, (240 << 6) - 1}}, PARAMETER_STATUS_EXCLUDES_SUPPLY, PARAMETER_OVER_VOLTAGE_V, 0},
        {{{PARAMETER_UNDER_VOLTAGE_V, (240 << 6) + 1}}, PARAMETER_STATUS_EXCLUDES_SUPPLY, PARAMETER_UNDER_VOLTAGE_V, 0},
    };
    for (const auto &refused : cases) {
        const auto response = set(refused.writes);
        EXPECT_EQ(response.status, refused.status);
        EXPECT_EQ(response.index, refused.index);
        EXPECT_EQ(response.part, refused.other);
        EXPECT_EQ(std::memcmp(&before, &drive.parameters, sizeof before), 0);
    }
    // One LSB less of each is accepted.
    for (const frames::parameter_writes_t &accepted :
         {frames::parameter_writes_t{{PARAMETER_CURRENT_LIMIT_A, 75 << 9}},
          {{PARAMETER_UNDER_VOLTAGE_V, 240 << 6}, {PARAMETER_OVER_VOLTAGE_V, (240 << 6) + 1}},
          {{PARAMETER_TURN_ON_ANGLE_DEG, (300 << 7) - 1}},
          {{PARAMETER_TURN_OFF_ANGLE_DEG, 348 << 7}},
          {{PARAMETER_TORQUE_BAND_INNER_NM, 1 << 24}},
          {{PARAMETER_CURRENT_TRIP_A, 20 << 9}}}) {
        EXPECT_EQ(set(accepted).status, PARAMETER_STATUS_DONE) << accepted.front().first;
    }
    // Without its supply nothing is said about the thresholds.
    hal.adc.bus_voltage_counts = 0;
    periods(10);
    EXPECT_EQ(set({{PARAMETER_OVER_VOLTAGE_V, 300 << 6}}).status, PARAMETER_STATUS_DONE);
}

// [SR-56]
TEST_F(Drive, armed_for_configuration_ends_with_the_set_a_run_bus_off_and_two_seconds) {
    periods(100);
    const auto armed = [this] { return drive.comms.commands.arming.configuring; };
    const auto arm = [&] {
        const uint8_t next = arm_for_configuration();
        periods(2);
        EXPECT_TRUE(armed());
        return next;
    };
    for (const unsigned step : {PARAMETER_SET_STEP_APPLY, PARAMETER_SET_STEP_ABANDON, PARAMETER_SET_STEP_SAVE}) {
        hal.to_drive.push_back(frames::parameter_set_control(arm(), step));
        periods(2);
        EXPECT_FALSE(armed()) << step;
    }
    uint8_t next = arm();
    hal.to_drive.push_back(frames::parameter_set_control(next, PARAMETER_SET_STEP_BEGIN));
    periods(70000); // 1.75 s
    hal.to_drive.push_back(frames::parameter_write(++next, PARAMETER_OVER_SPEED_RPM, 1000));
    periods(70000);
    EXPECT_TRUE(armed());
    periods(10100);
    EXPECT_FALSE(armed());
    arm();
    hal.can_status.state = HAL_CAN_BUS_OFF;
    periods(100);
    EXPECT_FALSE(armed());
    hal.can_status.state = HAL_CAN_ERROR_ACTIVE;
    periods(2000);
    // Another challenge, of which the response is missing.
    arm();
    hal.to_drive.push_back(frames::arm(50, ARMING_STEP_REQUEST_CONFIGURATION));
    periods(2);
    EXPECT_FALSE(armed());
    periods(20000);
    // A run.
    send(COMMAND_OFF);
    arm_for_run(1);
    periods(10);
    arm();
    send(COMMAND_RUN);
    periods(4);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    EXPECT_FALSE(armed());
    arm(); // for tunable parameters
}

// A rotor at 9.6 rad/s, which a stop ramps down. [SR-56]
TEST_F(Drive, while_a_stop_lasts_only_tunable_parameters_change) {
    const auto turn = [this](int count) {
        for (int k = 0; k < count; k++) {
            hal.encoder_counts = (hal.encoder_counts + 5) % (1u << 17);
            periods(1);
        }
    };
    turn(100);
    send(COMMAND_RUN);
    hal.to_drive.push_back(frames::arm(7, ARMING_STEP_REQUEST_RUN));
    turn(10);
    hal.to_drive.push_back(frames::arm(8, ARMING_STEP_CONFIRM_RUN, ~drive.comms.commands.arming.challenge));
    turn(100);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    send(COMMAND_STOP);
    turn(10);
    for (const unsigned index : {PARAMETER_BP_KP_MAX, PARAMETER_CURRENT_LIMIT_A}) {
        const int32_t before = drive.parameters.values[index];
        hal.to_drive.push_back(frames::arm(7, ARMING_STEP_REQUEST_CONFIGURATION));
        turn(10);
        hal.to_drive.push_back(
            frames::arm(8, ARMING_STEP_CONFIRM_CONFIGURATION, ~drive.comms.commands.arming.challenge));
        for (const hal_can_frame_t &frame : frames::parameter_set(9, {{index, before - 1}})) {
            hal.to_drive.push_back(frame);
        }
        hal.from_drive.clear();
        turn(10);
        ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
        ASSERT_EQ(drive.command.request, COMMAND_STOP);
        const bool tunable = parameters_tunable(index);
        EXPECT_EQ(set_response().status, tunable ? PARAMETER_STATUS_DONE : PARAMETER_STATUS_NOT_WHILE_RUNNING);
        EXPECT_EQ(drive.parameters.values[index], tunable ? before - 1 : before);
        EXPECT_EQ(tunable, index == PARAMETER_BP_KP_MAX);
    }
}

// The control parameters always belong to the whole set, though a run takes over parts of them only. [SR-56]
TEST_F(Drive, tunable_parameters_change_in_a_run_and_others_do_not) {
    periods(100);
    command(COMMAND_RUN);
    periods(100);
    unsigned tuned = 0;
    for (unsigned index = 0; index < PARAMETER_COUNT; index++) {
        ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
        const parameter_row_t *row = parameters_row(index);
        const parameters_t before = drive.parameters;
        const int32_t middle = int32_t((int64_t(row->minimum) + row->maximum) / 2);
        const int32_t value = before.values[index] == middle ? row->maximum : middle;
        send(COMMAND_RUN);
        const auto response = set({{index, value}});
        if (parameters_tunable(index)) {
            EXPECT_EQ(response.status, PARAMETER_STATUS_DONE) << parameters_name(index);
            EXPECT_EQ(drive.parameters.values[index], value);
            tuned++;
        } else {
            EXPECT_EQ(response.status, PARAMETER_STATUS_NOT_WHILE_RUNNING) << parameters_name(index);
            EXPECT_EQ(response.index, index);
            EXPECT_EQ(std::memcmp(&before, &drive.parameters, sizeof before), 0);
        }
        const control_parameters_t expected =
            configure_control(&drive.parameters, &machine_tables, 40000, 17, 12, 200000000);
        EXPECT_STREQ(difference(expected, drive.control_parameters), "") << parameters_name(index);
    }
    EXPECT_EQ(tuned, 25u);
    EXPECT_EQ(drive.control.deferred.speed_smc.gain_q24, drive.control_parameters.speed_smc.gain_q24);
    EXPECT_EQ(drive.control.deferred.speed_smc.delta_q27, drive.control_parameters.speed_smc.delta_q27);
}

// [SR-56]
TEST_F(Drive, an_interrupt_after_any_critical_section_never_has_its_parameters_changed_in_run) {
    periods(100);
    // Armed for a run by commands other than run.
    send(COMMAND_OFF);
    arm_for_run(1);
    periods(10);
    ASSERT_TRUE(drive.comms.commands.arming.armed);
    // The set and the command to run wait together: one call of the background takes apply and command.
    const auto set =
        frames::parameter_set(arm_for_configuration(), {{PARAMETER_CURRENT_TRIP_A, 60 << 9},
                                                        {PARAMETER_CONTROLLER, DRIVE_CONTROLLER_TRADITIONAL}});
    hal.to_drive.insert(hal.to_drive.end(), set.begin(), set.end());
    send(COMMAND_RUN);
    ASSERT_EQ(hal.to_drive.size(), 6u);
    static_assert(COMMS_FRAMES_PER_CALL == 4, "confirm, begin and the writes in one call, apply and run in the next");
    bool ran = false;
    control_parameters_t in_run{};
    hal.after_critical_section = [&] {
        hal.time_us += 25;
        drive_control_interrupt(&drive, &hal);
        conduct();
        deferred_interrupt(&drive, &hal);
        if (!ran && drive.control.state_machine.state == DRIVE_STATE_RUN) {
            ran = true;
            in_run = drive.control_parameters;
        }
    };
    for (int call = 0; call < 10; call++) {
        drive_background(&drive, &hal);
    }
    hal.after_critical_section = nullptr;
    periods(3);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    ASSERT_TRUE(ran);
    EXPECT_EQ(in_run.protection.current_trip_q9, 60 << 9);
    EXPECT_EQ(in_run.controller, DRIVE_CONTROLLER_TRADITIONAL);
    EXPECT_EQ(std::memcmp(&in_run, &drive.control_parameters, sizeof in_run), 0);
}

// Frames of sets in any order, lost, damaged, recorded, with runs between: a model of the host says what may change.
// [SR-56]
TEST_F(Drive, random_frames_change_parameters_only_as_a_whole_checked_set_of_an_armed_host) {
    periods(100);
    std::mt19937 random(16);
    std::vector<hal_can_frame_t> recorded;
    uint8_t next = 0; // sequence counter of the set
    std::vector<int32_t> staged(drive.parameters.values, drive.parameters.values + PARAMETER_COUNT);
    uint32_t check = 0;
    unsigned applied = 0, refused = 0, tuned = 0;
    const auto send_frame = [&](const hal_can_frame_t &frame) {
        recorded.push_back(frame);
        hal.to_drive.push_back(frame);
    };
    for (int step = 0; step < 40000; step++) {
        const parameters_t before = drive.parameters;
        const bool armed = drive.comms.commands.arming.configuring;
        bool may_apply = false;
        switch (random() % 16) {
        case 0: // arms, mostly
            if (random() % 4 != 0 && !armed) {
                send_frame(frames::arm(50, ARMING_STEP_REQUEST_CONFIGURATION));
                periods(10);
                send_frame(frames::arm(51, ARMING_STEP_CONFIRM_CONFIGURATION, ~drive.comms.commands.arming.challenge));
                next = 52;
            }
            break;
        case 1:
        case 2:
        case 3: { // begins
            const bool defaults = random() % 3 == 0;
            send_frame(frames::parameter_set_control(next++, defaults ? PARAMETER_SET_STEP_BEGIN_DEFAULTS
                                                                      : PARAMETER_SET_STEP_BEGIN));
            for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
                staged[i] = defaults ? parameters_default(&before, i) : before.values[i];
            }
            check = 0;
            break;
        }
        case 4: // any frame of before
            if (!recorded.empty()) {
                const hal_can_frame_t &frame = recorded[random() % recorded.size()];
                if (uint8_t(frame.data[2] - next) >= 3) { // else it is one that the host could send now
                    hal.to_drive.push_back(frame);
                }
            }
            break;
        case 5: { // commands, a run now and then
            const unsigned kind = random() % 8;
            command(kind == 0 ? COMMAND_CLEAR_FAULT : kind == 1 ? COMMAND_OFF : COMMAND_RUN);
            break;
        }
        case 6:
            periods(random() % 8 == 0 ? 4000 : 40);
            break;
        case 7:
        case 8:
        case 9: // applies, with the right check or not
            may_apply = armed;
            send_frame(frames::parameter_set_control(next++, PARAMETER_SET_STEP_APPLY, check + (random() % 4 == 0)));
            break;
        default: { // writes; one of 16 is lost
            unsigned index = random() % PARAMETER_COUNT;
            while (drive.control.state_machine.state == DRIVE_STATE_RUN && random() % 8 != 0 &&
                   !parameters_tunable(index)) {
                index = random() % PARAMETER_COUNT;
            }
            const parameter_row_t *row = parameters_row(index);
            const int64_t width = int64_t(row->maximum) - row->minimum;
            const int32_t value =
                random() % 64 == 0 ? int32_t(random()) : int32_t(row->minimum + int64_t(random()) % (width + 1));
            const hal_can_frame_t frame = frames::parameter_write(next++, index, value);
            check = crc32_continue(check, frame.data + E2E_HEADER_BYTES, 5);
            staged[index] = value;
            if (random() % 16 != 0) {
                send_frame(frame);
            }
        }
        }
        const bool running = drive.control.state_machine.state == DRIVE_STATE_RUN;
        periods(3);
        const int32_t *values = drive.parameters.values;
        if (std::memcmp(before.values, values, sizeof before.values) != 0) {
            ASSERT_TRUE(may_apply) << step;
            ASSERT_TRUE(std::equal(staged.begin(), staged.end(), values)) << step;
            applied++;
            for (unsigned i = 0; i < PARAMETER_COUNT; i++) {
                ASSERT_GE(values[i], parameters_row(i)->minimum) << step;
                ASSERT_LE(values[i], parameters_row(i)->maximum) << step;
                ASSERT_TRUE(!running || parameters_tunable(i) || values[i] == before.values[i]) << step;
            }
            ASSERT_LT(values[PARAMETER_UNDER_VOLTAGE_V], values[PARAMETER_OVER_VOLTAGE_V]) << step;
            tuned += running;
        } else {
            refused += may_apply;
        }
    }
    EXPECT_GT(applied, 100u);
    EXPECT_GT(refused, 100u);
    EXPECT_GT(tuned, 5u);
    std::printf("%u sets applied, %u of them in a run, %u refused\n", applied, tuned, refused);
}

TEST_F(Drive, telemetry_reports_what_the_interrupt_saw_and_did) {
    periods(100);
    command(COMMAND_RUN);
    periods(1000);
    hal.from_drive.clear();
    const control_state_t &control = drive.control;
    unsigned seen = 0;
    unsigned most_counts[3] = {};
    for (int k = 0; k < 400; k++) { // a whole slow cycle
        const hal_adc_sample_t sampled = hal.adc;
        periods(1);
        std::vector<hal_can_frame_t> sent;
        std::swap(sent, hal.from_drive);
        for (const hal_can_frame_t &frame : sent) {
            if (frame.identifier == DRIVE_STATUS_FRAME_ID) {
                drive_status_t status{};
                drive_status_unpack(&status, frame.data, frame.length);
                EXPECT_EQ(status.state, DRIVE_STATE_RUN);
                EXPECT_EQ(status.controller, DRIVE_CONTROLLER_PAPER);
                EXPECT_EQ(status.fault, FAULT_NONE);
                seen |= 1;
            } else if (frame.identifier == DRIVE_TORQUE_FRAME_ID) {
                drive_torque_t torque{};
                drive_torque_unpack(&torque, frame.data, frame.length);
                EXPECT_EQ(torque.torque_reference_nm, (control.torque_reference_q24 + 32768) >> 16);
                EXPECT_EQ(torque.torque_estimate_nm, (control.measurement.torque_sum_q24 + 32768) >> 16);
                EXPECT_EQ(torque.bus_voltage_v, 240 << 6);
                seen |= 2;
            } else if (frame.identifier == DRIVE_CURRENTS_FRAME_ID) {
                drive_currents_t currents{};
                drive_currents_unpack(&currents, frame.data, frame.length);
                EXPECT_EQ(currents.current_a_a, sampled.phase_current_counts[0] * 10);
                most_counts[0] = std::max(most_counts[0], unsigned(sampled.phase_current_counts[0]));
                EXPECT_EQ(currents.current_b_a, sampled.phase_current_counts[1] * 10);
                most_counts[1] = std::max(most_counts[1], unsigned(sampled.phase_current_counts[1]));
                EXPECT_EQ(currents.current_c_a, sampled.phase_current_counts[2] * 10);
                most_counts[2] = std::max(most_counts[2], unsigned(sampled.phase_current_counts[2]));
                EXPECT_EQ(currents.current_d_a, 0);
                seen |= 4;
            } else if (frame.identifier == DRIVE_BP_PID_FRAME_ID) {
                // Gains per N m: those per scaled error over the scale.
                drive_bp_pid_t pid{};
                drive_bp_pid_unpack(&pid, frame.data, frame.length);
                const double inverse = drive.control_parameters.duty.pid.error_scale_inverse_q24 / 16777216.0;
                EXPECT_NEAR(pid.kp_per_nm, drive.control.duty.pid.gain_q24[0] / 512.0 * inverse, 0.51);
                EXPECT_NEAR(pid.ki_per_nm, drive.control.duty.pid.gain_q24[1] / 512.0 * inverse, 0.51);
                EXPECT_NEAR(pid.kd_per_nm, drive.control.duty.pid.gain_q24[2] / 512.0 * inverse, 0.51);
                EXPECT_NE(pid.kp_per_nm, pid.ki_per_nm);
                EXPECT_NE(pid.ki_per_nm, pid.kd_per_nm);
                seen |= 8;
            }
        }
    }
    EXPECT_EQ(seen, 15u);
    EXPECT_GT(*std::max_element(most_counts, most_counts + 3), 200u);
}

// [SR-09]
TEST_F(Drive, telemetry_reports_the_available_torque_of_each_direction_and_what_limits_it) {
    for (const drive_controller_t controller : {DRIVE_CONTROLLER_PAPER, DRIVE_CONTROLLER_SALIENT}) {
        const drive_config_t config = {.control_rate_hz = 40000, .controller = controller};
        ASSERT_TRUE(drive_init(&drive, &hal, &config));
        periods(100);
        hal.from_drive.clear();
        periods(4000); // the cycle of the message
        const auto sent = only_frame(DRIVE_AVAILABLE_TORQUE_FRAME_ID, drive_available_torque_unpack);
        const bool backwards = controller == DRIVE_CONTROLLER_SALIENT; // the other one has one quadrant
        const int32_t most_q8 = (drive.parameters.values[PARAMETER_TORQUE_MAX_NM] + 32768) >> 16;
        EXPECT_EQ(sent.forward_nm, most_q8);
        EXPECT_EQ(sent.backward_nm, backwards ? -most_q8 : 0);
        EXPECT_EQ(sent.forward_limited_by, DRIVE_AVAILABLE_TORQUE_FORWARD_LIMITED_BY_CURRENT_CHOICE);
        EXPECT_EQ(sent.backward_limited_by, backwards ? DRIVE_AVAILABLE_TORQUE_BACKWARD_LIMITED_BY_CURRENT_CHOICE
                                                      : DRIVE_AVAILABLE_TORQUE_BACKWARD_LIMITED_BY_CONTROLLER_CHOICE);
    }
}

TEST_F(Drive, telemetry_reports_in_a_run_that_a_reference_backwards_is_limited_with_a_controller_of_one_quadrant) {
    const auto limited = [this] {
        drive_telemetry_t telemetry;
        telemetry_collect(&drive, &hal, hal.time_us, &telemetry);
        return bool(telemetry.status.speed_limited);
    };
    periods(100);
    EXPECT_FALSE(limited());
    command(COMMAND_RUN);
    periods(10);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    EXPECT_FALSE(limited());
    send(COMMAND_RUN, -600.0);
    periods(1);
    EXPECT_TRUE(limited());
    send(COMMAND_OFF, -600.0);
    periods(2);
    EXPECT_FALSE(limited());
}

TEST_F(Drive, the_background_leaves_what_belongs_to_no_phase_of_the_machine_as_it_is) {
    ASSERT_NO_FATAL_FAILURE(start(DRIVE_CONTROLLER_SALIENT));
    ASSERT_LT(machine_tables.phases, HAL_PHASES_MAX);
    const unsigned beyond = machine_tables.phases;
    table_scale_phase_t &interval = drive.table_scale.phase[beyond];
    for (const bool run : {false, true}) {
        periods(100);
        if (run) {
            command(COMMAND_RUN);
            periods(10);
        }
        ASSERT_EQ(drive.control.state_machine.state, run ? DRIVE_STATE_RUN : DRIVE_STATE_READY);
        drive.control.flux_misalignment[beyond] = 99;
        interval.whole = true;
        interval.current_q9 = 99;
        periods(20);
        EXPECT_EQ(drive.control.flux_misalignment[beyond], 99) << run;
        EXPECT_TRUE(interval.whole && !interval.ended) << run;
    }
}

#if HAL_PHASES_MAX > 4
TEST_F(Drive, telemetry_names_each_of_six_phases_that_fails_or_is_lost_or_whose_sensors_have_failed) {
    for (unsigned phase = 0; phase < 6; phase++) {
        drive.flux.phases = drive.degraded.lost = 1u << phase;
        drive.temperature.failed_sensors[TEMPERATURE_WINDING] = uint8_t(1u << phase);
        drive.temperature.failed_sensors[TEMPERATURE_INVERTER] = uint8_t(32u >> phase);
        drive_telemetry_t telemetry;
        telemetry_collect(&drive, &hal, 0, &telemetry);
        EXPECT_EQ(telemetry.phase_fault & 63u, 1u << phase);
        EXPECT_EQ(telemetry.phases_e_f.phase_e, phase == 4);
        EXPECT_EQ(telemetry.phases_e_f.phase_f, phase == 5);
        EXPECT_EQ(telemetry.phases_e_f.lost_phase_e, phase == 4);
        EXPECT_EQ(telemetry.phases_e_f.lost_phase_f, phase == 5);
        EXPECT_EQ(telemetry.phases_e_f.winding_sensor_e, phase == 4);
        EXPECT_EQ(telemetry.phases_e_f.winding_sensor_f, phase == 5);
        EXPECT_EQ(telemetry.phases_e_f.inverter_sensor_e, phase == 1);
        EXPECT_EQ(telemetry.phases_e_f.inverter_sensor_f, phase == 0);
    }
}
#endif

// [SR-09]
TEST_F(Drive, telemetry_names_the_lost_phase_s_limit_of_the_available_torque_whichever_is_lost) {
    for (const uint32_t lost : {1u, 2u, 4u}) {
        drive.degraded.lost = lost;
        drive.degraded.angle = DEGRADED_ANGLES;
        drive.degraded.mean_q24 = 3 << 24;
        drive.degraded.most_q24 = 9 << 24;
        drive.control_parameters.degraded.allowed = true;
        periods(100);
        drive_telemetry_t telemetry;
        telemetry_collect(&drive, &hal, hal.time_us, &telemetry);
        EXPECT_EQ(telemetry.available_torque.forward_nm, 3 * 256) << lost;
        EXPECT_EQ(telemetry.available_torque.forward_limited_by,
                  DRIVE_AVAILABLE_TORQUE_FORWARD_LIMITED_BY_DEGRADED_CHOICE)
            << lost;
    }
}

TEST_F(Drive, the_scale_of_the_tables_that_has_been_found_takes_effect_in_the_interrupt_during_a_run) {
    periods(100);
    command(COMMAND_RUN);
    periods(10);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    for (const double scale : {1.1, 0.9}) {
        drive.table_scale.differs = true;
        drive.table_scale.scale_q30 = drive.table_scale.smooth_q30 = int32_t(std::lround(scale * 0x1p30));
        drive.table_scale.smooth_complement = ~drive.table_scale.smooth_q30;
        periods(10);
        EXPECT_NEAR(drive.control.table_scale.excess_q31 / 0x1p31, scale - 1.0, 1e-4);
        EXPECT_NEAR(drive.control.table_scale.inverse_excess_q31 / 0x1p31, 1.0 / scale - 1.0, 1e-4);
    }
}

// [SR-60]
TEST_F(Drive, a_logged_fault_names_the_phases_that_have_had_one) {
    periods(100);
    drive.flux.phases = 4u;
    hal.break_causes = hal.break_lasts = HAL_PWM_BREAK_OVER_CURRENT;
    periods(2000);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_FAULT);
    hal.from_drive.clear();
    hal.to_drive.push_back(frames::parameter_request(PARAMETER_OPERATION_FAULT_LOG, 0, 16, 1));
    periods(10);
    EXPECT_EQ(only_frame(DRIVE_PARAMETER_RESPONSE_FRAME_ID, drive_parameter_response_unpack).value, 4);
}

TEST_F(Drive, telemetry_reports_the_resistance_of_the_parameter_and_what_is_found_beyond_it) {
    const double ohm = drive.parameters.values[PARAMETER_RESISTANCE_OHM] / 16777216.0;
    for (const double beyond_ohm : {0.0, 0.01, -0.01}) {
        drive.table_scale.resistance_q40 = int32_t(std::lround(beyond_ohm * 25e-6 * 0x1p40));
        drive_telemetry_t telemetry;
        telemetry_collect(&drive, &hal, 0, &telemetry);
        EXPECT_NEAR(telemetry.estimates.resistance_ohm / 65536.0, ohm + beyond_ohm, 2.0 / 65536.0) << beyond_ohm;
    }
}

TEST_F(Drive, two_drives_in_a_process_do_not_know_of_each_other) {
    hal_t other_hal;
    other_hal.adc.bus_voltage_counts = 240 * 8;
    drive_t other;
    const drive_config_t config = {.control_rate_hz = 20000, .controller = DRIVE_CONTROLLER_TRADITIONAL};
    ASSERT_TRUE(drive_init(&other, &other_hal, &config));
    periods(100);
    command(COMMAND_RUN);
    for (int k = 0; k < 50; k++) {
        periods(1);
        other_hal.time_us += 50;
        drive_control_interrupt(&other, &other_hal);
        deferred_interrupt(&other, &other_hal);
        drive_background(&other, &other_hal);
    }
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_RUN);
    EXPECT_EQ(other.control.state_machine.state, DRIVE_STATE_READY);
    EXPECT_TRUE(other_hal.open);
    EXPECT_EQ(other_hal.starts, std::vector<uint16_t>{5000});
}

// [SR-35]
TEST_F(Drive, a_run_of_a_sender_long_silent_starts_nothing_when_the_clock_comes_round) {
    hal.adc.bus_voltage_counts = 0; // the link is off: the drive stays in its initial state
    command(COMMAND_OFF);
    periods(10);
    command(COMMAND_RUN);
    periods(10);
    ASSERT_EQ(drive.control.state_machine.state, DRIVE_STATE_INITIALISE);
    ASSERT_EQ(drive.command.request, COMMAND_RUN);
    periods(10000); // 0.25 s of silence
    EXPECT_EQ(drive.command.request, COMMAND_OFF);

    hal.time_us = drive.command.time_us; // 71 minutes later the command looks new
    hal.adc.bus_voltage_counts = 240 * 8;
    periods(200);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
    EXPECT_EQ(hal.writes, 0u);
}

// Bus-off: the error counter is above 255 until the controller has rejoined. [SR-38]
TEST_F(Drive, rejoins_the_bus_with_a_back_off_that_doubles_up_to_320_ms_and_an_error_free_second_resets) {
    const auto wait_us = [this] {
        hal.can_status = {.state = HAL_CAN_BUS_OFF, .transmit_errors = 256, .receive_errors = 0};
        const unsigned rejoins = hal.rejoins;
        int waited = 0;
        for (; hal.rejoins == rejoins && waited < 40000; waited++) {
            periods(1);
        }
        periods(700);
        EXPECT_EQ(hal.rejoins, rejoins + 1) << "one request, until the next wait is over";
        hal.can_status = {.state = HAL_CAN_ERROR_ACTIVE, .transmit_errors = 0, .receive_errors = 0};
        periods(40);
        return (waited - 1) * 25;
    };
    for (const int expected_us : {10000, 20000, 40000, 80000, 160000, 320000, 320000, 320000}) {
        EXPECT_NEAR(wait_us(), expected_us, 1000) << "a step each millisecond";
    }
    EXPECT_EQ(drive.comms.bus.bus_off_count, 8u);
    hal.can_status.state = HAL_CAN_ERROR_PASSIVE; // on the bus, but not free of errors
    periods(80000);
    EXPECT_NEAR(wait_us(), 320000, 1000);
    periods(40100);
    EXPECT_NEAR(wait_us(), 10000, 1000);
    hal.from_drive.clear();
    periods(4040);
    const auto state = only_frame(DRIVE_BUS_STATE_FRAME_ID, drive_bus_state_unpack);
    EXPECT_EQ(state.bus_off_count, 10);
    EXPECT_EQ(state.bus_state, BUS_STATE_ERROR_ACTIVE);
}

// The controller has gone off the bus again before the drive has seen that it had rejoined. [SR-38]
TEST_F(Drive, requests_to_rejoin_again_when_bus_off_has_not_ended) {
    hal.can_status.state = HAL_CAN_BUS_OFF;
    periods(440); // 11 ms
    EXPECT_EQ(hal.rejoins, 1u);
    periods(720); // 29 ms
    EXPECT_EQ(hal.rejoins, 1u);
    periods(120); // 32 ms
    EXPECT_EQ(hal.rejoins, 2u);
    periods(40000);
    EXPECT_EQ(hal.rejoins, 7u); // 40, 80, 160, 320, 320 ms later
}

// [SR-38]
TEST_F(Drive, after_bus_off_a_run_request_counts_only_once_it_has_been_withdrawn) {
    periods(100);
    command(COMMAND_RUN, 0);
    periods(3);
    ASSERT_FALSE(hal.open);
    hal.can_status.state = HAL_CAN_BUS_OFF;
    periods(500);
    EXPECT_EQ(hal.rejoins, 1u);
    EXPECT_FALSE(drive.comms.commands.arming.armed);
    hal.can_status.state = HAL_CAN_ERROR_ACTIVE;
    for (int k = 0; k < 60; k++) { // a sender that simply continues
        command(COMMAND_RUN, 0);
        periods(400);
    }
    EXPECT_TRUE(hal.open);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_COMMAND_TIMEOUT);
    command(COMMAND_OFF);
    command(COMMAND_CLEAR_FAULT);
    periods(10);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
    command(COMMAND_RUN, 0);
    periods(10);
    EXPECT_FALSE(hal.open);
}

TEST_F(Drive, error_counters_are_reported) {
    hal.can_status = {.state = HAL_CAN_ERROR_PASSIVE, .transmit_errors = 200, .receive_errors = 17};
    periods(4040);
    drive_bus_state_t state{};
    for (const hal_can_frame_t &sent : hal.from_drive) {
        if (sent.identifier == DRIVE_BUS_STATE_FRAME_ID) {
            drive_bus_state_unpack(&state, sent.data, sent.length);
        }
    }
    EXPECT_EQ(state.bus_state, BUS_STATE_ERROR_PASSIVE);
    EXPECT_EQ(state.transmit_error_counter, 200);
    EXPECT_EQ(state.receive_error_counter, 17);
    EXPECT_EQ(state.bus_off_count, 0);
    EXPECT_EQ(hal.rejoins, 0u);
}

// [SR-37]
TEST_F(Drive, a_frame_of_another_node_with_an_identifier_of_the_drive_is_a_fault_until_a_second_without) {
    periods(100);
    command(COMMAND_RUN);
    periods(3);
    ASSERT_FALSE(hal.open);
    hal_can_frame_t foreign{};
    foreign.identifier = DRIVE_MOTION_FRAME_ID;
    foreign.length = 8;
    hal.to_drive.push_back(foreign);
    periods(4); // background, deferred check, control interrupt
    EXPECT_TRUE(hal.open);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_IDENTIFIER_CONFLICT);
    EXPECT_EQ(drive.comms.bus.foreign_count, 1);
    const auto clear = [this] {
        command(COMMAND_OFF);
        command(COMMAND_CLEAR_FAULT);
        periods(405);
        return drive.control.state_machine.state;
    };
    periods(1000000 / 25 - 500);
    EXPECT_EQ(clear(), DRIVE_STATE_FAULT) << "its cause has not gone";
    periods(200);
    EXPECT_EQ(clear(), DRIVE_STATE_READY);
}

// [SR-37]
TEST_F(Drive, no_other_identifier_length_or_flag_is_an_identifier_conflict_or_changes_the_state) {
    const std::vector<uint32_t> for_drive = {DRIVE_COMMAND_FRAME_ID, DRIVE_TORQUE_COMMAND_FRAME_ID,
                                             DRIVE_PARAMETER_REQUEST_FRAME_ID};
    std::vector<uint32_t> own = {DRIVE_PARAMETER_RESPONSE_FRAME_ID};
    for (const auto &message : drive_telemetry_messages) {
        if (machine_tables.phases > message.phases_above) {
            own.push_back(message.identifier);
        }
    }
    const auto contains = [](const std::vector<uint32_t> &list, uint32_t identifier) {
        return std::find(list.begin(), list.end(), identifier) != list.end();
    };
    periods(100);
    const control_parameters_t parameters = drive.control_parameters;
    const parameters_t table = drive.parameters;
    std::mt19937 random(20261122);
    // All frames are received by the background of one period, which is all that sees them.
    const auto receive = [&](hal_can_frame_t frame) {
        for (uint8_t &byte : frame.data) {
            byte = static_cast<uint8_t>(random());
        }
        hal.to_drive.push_back(frame);
        if (hal.to_drive.size() == COMMS_FRAMES_PER_CALL) {
            drive_background(&drive, &hal);
            ASSERT_TRUE(hal.to_drive.empty());
        }
    };
    unsigned foreign = 0;
    for (const bool extended : {false, true}) {
        for (const bool remote : {false, true}) {
            for (uint32_t identifier = 0; identifier < 0x800; identifier++) {
                for (uint8_t length = 0; length < 16; length++) {
                    if (!extended && !remote && contains(own, identifier)) {
                        continue; // they are a conflict: below
                    }
                    receive({identifier, extended, remote, length, {}});
                }
            }
        }
    }
    for (int i = 0; i < 1000000; i++) {
        receive({uint32_t(random()) & 0x1FFFFFFFu, true, random() % 8 == 0, uint8_t(random() % 16), {}});
    }
    EXPECT_EQ(drive.comms.bus.foreign_count, 0);
    periods(10);
    EXPECT_EQ(drive.control.state_machine.state, DRIVE_STATE_READY);
    EXPECT_EQ(drive.command.request, COMMAND_OFF);
    EXPECT_EQ(std::memcmp(&drive.control_parameters, &parameters, sizeof parameters), 0);
    EXPECT_EQ(std::memcmp(drive.parameters.values, table.values, sizeof table.values), 0);
    EXPECT_EQ(drive.comms.commands.counters.accepted, 0);
    // Each identifier of the drive, whatever its length, and none of the remote or extended frames of it.
    for (const uint32_t identifier : own) {
        ASSERT_FALSE(contains(for_drive, identifier));
        for (uint8_t length = 0; length < 16; length++) {
            receive({identifier, false, false, length, {}});
            foreign++;
        }
    }
    periods(10);
    EXPECT_EQ(drive.comms.bus.foreign_count, foreign);
    EXPECT_EQ(drive.control.state_machine.record.fault, FAULT_IDENTIFIER_CONFLICT);
}

} // namespace
