// Measured temperatures: sensors that are open or shorted, the limit of the torque, the faults. [SR-17]
#include <algorithm>
#include <array>
#include <cmath>
#include <tuple>
#include <vector>

#include <gtest/gtest.h>

extern "C" {
#include "monitors/temperature.h"
#include "storage/fault.h"
}

struct hal {
    std::array<uint16_t, HAL_ADC_TEMPERATURES> code{};
};

extern "C" uint16_t hal_adc_temperature(const hal_t *hal, unsigned sensor) {
    return hal->code[sensor];
}

namespace {

constexpr unsigned PHASES = 3;
constexpr double TORQUE_MAX_NM = 20.0;

uint16_t code_of(double temperature_C) {
    return uint16_t(std::lround((temperature_C + 100.0) / 400.0 * 65536.0));
}

class Temperature : public testing::Test {
  protected:
    void SetUp() override {
        std::vector<int32_t> values(PARAMETER_COUNT);
        values[PARAMETER_WINDING_LIMIT_C] = 150;
        values[PARAMETER_INVERTER_LIMIT_C] = 90;
        values[PARAMETER_TORQUE_MAX_NM] = int32_t(TORQUE_MAX_NM * (1 << 24));
        parameters = temperature_configure(values.data());
        hal.code.fill(code_of(25.0));
        temperature_init(&temperature, 0);
    }

    void step(unsigned count = 1) {
        for (unsigned k = 0; k < count; k++) {
            temperature_step(&parameters, &temperature, &hal, PHASES, time_us);
            time_us += TEMPERATURE_STEP_US;
        }
    }

    uint32_t faults() const { return temperature_faults(&temperature); }
    double limit_Nm() const { return temperature.torque_limit_q24 / 16777216.0; }

    hal_t hal;
    temperature_parameters_t parameters{};
    temperature_t temperature{};
    uint32_t time_us = 0;
};

TEST_F(Temperature, of_sound_cool_sensors_limits_nothing_and_is_no_fault) {
    step(10);
    EXPECT_EQ(faults(), 0u);
    EXPECT_EQ(limit_Nm(), TORQUE_MAX_NM);
    EXPECT_NEAR(temperature_C(&temperature, TEMPERATURE_WINDING), 25.0, 1.0);
}

TEST_F(Temperature, is_read_each_10_ms_and_at_once_at_the_start) {
    hal.code[HAL_ADC_WINDING] = code_of(160.0);
    EXPECT_EQ(faults(), 0u);
    step();
    EXPECT_EQ(faults(), FAULT_BIT(FAULT_WINDING_OVERLOAD));
    hal.code[HAL_ADC_WINDING] = code_of(25.0);
    temperature_step(&parameters, &temperature, &hal, PHASES, time_us - 1);
    EXPECT_EQ(faults(), FAULT_BIT(FAULT_WINDING_OVERLOAD));
    temperature_step(&parameters, &temperature, &hal, PHASES, time_us);
    EXPECT_EQ(faults(), 0u);
}

TEST_F(Temperature, torque_falls_linearly_over_the_last_20_K_of_either_part) {
    step();
    for (const auto &[sensor, limit_C] :
         {std::pair(HAL_ADC_WINDING + 2, 150.0), std::pair(unsigned(HAL_ADC_INVERTER) + 1, 90.0)}) {
        for (double below_K = 25.0; below_K > -5.0; below_K -= 0.5) {
            hal.code[sensor] = code_of(limit_C - below_K);
            step();
            EXPECT_NEAR(limit_Nm(), TORQUE_MAX_NM * std::clamp(below_K / 20.0, 0.0, 1.0), 0.02) << below_K;
        }
        hal.code[sensor] = code_of(25.0);
        step();
    }
}

TEST_F(Temperature, fault_begins_at_the_limit_and_ends_20_K_below_it) {
    const uint32_t fault = uint32_t(FAULT_BIT(FAULT_INVERTER_OVERLOAD));
    for (const auto &[at_C, failed] : {std::pair(89.8, false), std::pair(90.1, true), std::pair(70.3, true),
                                       std::pair(69.8, false), std::pair(89.8, false)}) {
        hal.code[HAL_ADC_INVERTER] = code_of(at_C);
        step();
        EXPECT_EQ(faults(), failed ? fault : 0u) << at_C;
    }
}

// [SR-18]
TEST_F(Temperature, third_invalid_reading_in_succession_is_a_failed_sensor_and_a_valid_one_ends_it) {
    step(2);
    for (const uint16_t code : {uint16_t(0), uint16_t(4095), uint16_t(61441), uint16_t(65520)}) {
        hal.code[HAL_ADC_WINDING + 1] = code;
        step(2);
        EXPECT_EQ(faults(), 0u) << code;
        step();
        EXPECT_EQ(faults(), FAULT_BIT(FAULT_TEMPERATURE_SENSOR)) << code;
        EXPECT_EQ(temperature.failed_sensors[TEMPERATURE_WINDING], 1u << 1);
        EXPECT_EQ(temperature.failed_sensors[TEMPERATURE_INVERTER], 0u);
        step(300);
        EXPECT_EQ(faults(), FAULT_BIT(FAULT_TEMPERATURE_SENSOR)) << code;
        hal.code[HAL_ADC_WINDING + 1] = code_of(25.0);
        step();
        EXPECT_EQ(faults(), 0u) << code;
    }
}

// [SR-18]
TEST_F(Temperature, codes_at_the_limits_are_valid) {
    for (const uint16_t code : {uint16_t(4096), uint16_t(61440)}) {
        hal.code[HAL_ADC_WINDING] = code;
        step(5);
        EXPECT_EQ(temperature.failed_sensors[TEMPERATURE_WINDING], 0u) << code;
    }
}

// [SR-18]
TEST_F(Temperature, a_hot_winding_stays_hot_while_its_sensor_cannot_be_read) {
    hal.code[HAL_ADC_WINDING] = code_of(140.0);
    step();
    EXPECT_NEAR(limit_Nm(), TORQUE_MAX_NM / 2.0, 0.02);
    hal.code[HAL_ADC_WINDING] = 0;
    step(2);
    EXPECT_NEAR(limit_Nm(), TORQUE_MAX_NM / 2.0, 0.02);
}

// [SR-17] [SR-18]
TEST_F(Temperature, a_part_that_heats_while_a_sensor_of_it_cannot_be_read_is_as_hot_as_the_others_tell) {
    for (const auto &[first, limit_C] :
         {std::pair(unsigned(HAL_ADC_WINDING), 150.0), std::pair(unsigned(HAL_ADC_INVERTER), 90.0)}) {
        for (unsigned unread = 0; unread < PHASES; unread++) {
            hal.code.fill(code_of(25.0));
            step();
            hal.code[first + unread] = 0;
            hal.code[first + (unread + 1) % PHASES] = code_of(limit_C - 10.0);
            step();
            EXPECT_NEAR(limit_Nm(), TORQUE_MAX_NM / 2.0, 0.02) << first << " " << unread;
        }
    }
}

// [SR-18]
TEST_F(Temperature, sensor_that_is_open_at_the_first_reading_has_failed_then_and_those_of_no_phase_do_not_count) {
    hal.code[HAL_ADC_WINDING + 3] = hal.code[HAL_ADC_INVERTER + 3] = 65520;
    step();
    EXPECT_EQ(faults(), 0u);
    temperature_init(&temperature, time_us);
    hal.code[HAL_ADC_INVERTER] = 65520;
    step();
    EXPECT_EQ(faults(), FAULT_BIT(FAULT_TEMPERATURE_SENSOR));
}

// [SR-18]
TEST_F(Temperature, the_first_step_is_due_at_the_start_whenever_it_comes_then) {
    hal.code[HAL_ADC_WINDING] = code_of(160.0);
    for (const uint32_t start_us : {0u, 5000u, UINT32_MAX - 12000}) {
        for (const uint32_t later_us :
             {0u, TEMPERATURE_STEP_US - 1, TEMPERATURE_STEP_US, 3 * TEMPERATURE_STEP_US / 2}) {
            temperature_init(&temperature, start_us);
            EXPECT_EQ(faults(), 0u);
            EXPECT_EQ(temperature.torque_limit_q24, INT32_MAX);
            temperature_step(&parameters, &temperature, &hal, PHASES, start_us + later_us);
            EXPECT_EQ(faults(), FAULT_BIT(FAULT_WINDING_OVERLOAD)) << start_us << " " << later_us;
        }
    }
}

// [SR-18]
TEST_F(Temperature, each_sensor_of_either_part_has_a_bit_of_its_own_and_a_part_its_own_fault) {
    for (unsigned phase = 0; phase < PHASES; phase++) {
        for (const auto &[first, part, fault] :
             {std::tuple(unsigned(HAL_ADC_WINDING), TEMPERATURE_WINDING, FAULT_WINDING_OVERLOAD),
              std::tuple(unsigned(HAL_ADC_INVERTER), TEMPERATURE_INVERTER, FAULT_INVERTER_OVERLOAD)}) {
            hal.code.fill(code_of(25.0));
            temperature_init(&temperature, time_us);
            hal.code[first + phase] = code_of(155.0);
            step();
            EXPECT_EQ(faults(), FAULT_BIT(fault)) << phase;
            EXPECT_NEAR(temperature_C(&temperature, part), 155.0, 1.0);
            temperature_init(&temperature, time_us);
            hal.code[first + phase] = 0;
            step();
            EXPECT_EQ(faults(), FAULT_BIT(FAULT_TEMPERATURE_SENSOR)) << phase;
            EXPECT_EQ(temperature.failed_sensors[part], 1u << phase);
            EXPECT_EQ(temperature.failed_sensors[TEMPERATURE_WINDING + TEMPERATURE_INVERTER - part], 0u);
        }
    }
}

} // namespace
