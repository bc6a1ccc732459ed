#include <gtest/gtest.h>

#include <cmath>
#include <cstring>

#include "emulator_machines.h"

extern "C" {
#include "plant/sensors.h"
}

namespace {

class Sensors : public testing::Test {
  protected:
    Sensors() : machine(machine_of(MAGNETICS_SATURATING)) {
        plant_init(&plant, &machine, 0.0);
        sensors_init(&sensors, &machine.sensors, 17, 12, 1);
    }

    uint16_t current_counts(double current_A) {
        plant.current_A[0] = current_A;
        hal_adc_sample_t sample;
        sensors_sample_adc(&sensors, &plant, &sample);
        return sample.phase_current_counts[0];
    }

    uint16_t bus_counts(double voltage_V) {
        plant.bus_voltage_V = voltage_V;
        hal_adc_sample_t sample;
        sensors_sample_adc(&sensors, &plant, &sample);
        return sample.bus_voltage_counts;
    }

    uint16_t load_torque_counts(double load_torque_Nm) {
        plant.load_torque_Nm = load_torque_Nm;
        hal_adc_sample_t sample;
        sensors_sample_adc(&sensors, &plant, &sample);
        return sample.load_torque_counts;
    }

    uint32_t encoder_counts(double turns) {
        plant.rotor_angle_rad = turns * 2.0 * M_PI;
        hal_encoder_sample_t sample;
        sensors_sample_encoder(&sensors, &plant, &sample);
        return sample.counts;
    }

    const machine_t machine;
    plant_t plant;
    sensors_t sensors;
};

TEST_F(Sensors, CurrentIsTheNearestCode) {
    EXPECT_EQ(current_counts(0.0), 0);
    EXPECT_EQ(current_counts(0.49 / 51.2), 0);
    EXPECT_EQ(current_counts(0.5 / 51.2), 1);
    EXPECT_EQ(current_counts(1.49 / 51.2), 1);
    EXPECT_EQ(current_counts(40.0), 2048);
}

TEST_F(Sensors, CurrentSaturatesAtTheLargestCode) {
    EXPECT_EQ(current_counts(4094.4 / 51.2), 4094);
    EXPECT_EQ(current_counts(4094.5 / 51.2), 4095);
    EXPECT_EQ(current_counts(80.0), 4095);
    EXPECT_EQ(current_counts(1e9), 4095);
    EXPECT_EQ(current_counts(-1.0), 0);
    EXPECT_EQ(current_counts(std::nan("")), 0);
}

TEST_F(Sensors, BusVoltageHasItsOwnScale) {
    EXPECT_EQ(bus_counts(240.0), 1920);
    EXPECT_EQ(bus_counts(240.06), 1920);
    EXPECT_EQ(bus_counts(240.07), 1921);
    EXPECT_EQ(bus_counts(600.0), 4095);
}

TEST_F(Sensors, CodesHaveTheBitsTheyWereGivenOverTheSameFullScale) {
    for (unsigned bits = 12; bits <= 16; bits++) {
        sensors_init(&sensors, &machine.sensors, 17, bits, 1);
        const auto code = [bits](double fraction) {
            return static_cast<uint16_t>(std::ldexp(fraction, int(bits)) + 0.5);
        };
        EXPECT_EQ(current_counts(33.3), code(33.3 / 80.0)) << bits;
        EXPECT_EQ(bus_counts(240.07), code(240.07 / 512.0)) << bits;
        EXPECT_EQ(current_counts(1e9), (1u << bits) - 1) << bits;
        EXPECT_EQ(load_torque_counts(8.3), code(0.5 + 8.3 / 128.0)) << bits;
    }
}

TEST_F(Sensors, LoadTorqueIsOffsetBinaryAndLimited) {
    EXPECT_EQ(load_torque_counts(0.0), 2048);
    EXPECT_EQ(load_torque_counts(8.0), 2048 + 256);
    EXPECT_EQ(load_torque_counts(-8.0), 2048 - 256);
    EXPECT_EQ(load_torque_counts(0.49 / 32.0), 2048);
    EXPECT_EQ(load_torque_counts(0.5 / 32.0), 2049);
    EXPECT_EQ(load_torque_counts(64.0), 4095);
    EXPECT_EQ(load_torque_counts(200.0), 4095);
    EXPECT_EQ(load_torque_counts(-64.0), 0);
    EXPECT_EQ(load_torque_counts(-200.0), 0);
}

TEST_F(Sensors, EachPhaseIsConvertedAndUnusedOnesReadZero) {
    plant.current_A[0] = 10.0;
    plant.current_A[1] = 20.0;
    plant.current_A[2] = 30.0;
    plant.current_A[3] = 30.0; // the machine has three
    sensors.errors.current_gain = 1.5;
    hal_adc_sample_t sample;
    std::memset(&sample, 0xFF, sizeof sample);
    sensors_sample_adc(&sensors, &plant, &sample);
    EXPECT_EQ(sample.phase_current_counts[0], 768);
    EXPECT_EQ(sample.phase_current_counts[1], 1536);
    EXPECT_EQ(sample.phase_current_counts[2], 2304);
    EXPECT_EQ(sample.phase_current_counts[3], 0);
}

TEST_F(Sensors, ErrorsAreTheMachinesUntilChanged) {
    machine_t other = machine;
    other.sensors = {1.25, -1.0, 0.5, 30.0, 3000.0, 0.5};
    sensors_init(&sensors, &other.sensors, 17, 12, 1);
    EXPECT_EQ(std::memcmp(&sensors.errors, &other.sensors, sizeof other.sensors), 0);
    EXPECT_EQ(current_counts(40.0), 1536) << "limited to 30 A: the noise stays below 6 deviations";
    EXPECT_EQ(encoder_counts(0.25), 32768u + 182u) << "0.5 deg of 131072 counts a turn: 182.04";
    sensors.errors = machine.sensors;
    EXPECT_EQ(current_counts(40.0), 2048);
    EXPECT_EQ(encoder_counts(0.25), 32768u);
}

TEST_F(Sensors, OffsetComesBehindTheGainAndShowsNothingBelowZero) {
    sensors.errors.current_gain = 0.5;
    sensors.errors.current_offset_A = 10.0;
    EXPECT_EQ(current_counts(0.0), 512);
    EXPECT_EQ(current_counts(40.0), 1536);
    sensors.errors.current_offset_A = -10.0;
    EXPECT_EQ(current_counts(40.0), 512);
    EXPECT_EQ(current_counts(20.0), 0);
    EXPECT_EQ(current_counts(0.0), 0);
}

TEST_F(Sensors, LimitComesBehindGainOffsetAndNoise) {
    sensors.errors.current_limit_A = 30.0;
    EXPECT_EQ(current_counts(29.98), 1535);
    EXPECT_EQ(current_counts(30.0), 1536);
    EXPECT_EQ(current_counts(79.0), 1536);
    sensors.errors.current_gain = 2.0;
    sensors.errors.current_offset_A = 10.0;
    EXPECT_EQ(current_counts(9.5), 1485) << "29 A";
    EXPECT_EQ(current_counts(10.5), 1536) << "31 A";
    sensors.errors.current_noise_A = 0.5;
    for (int draw = 0; draw < 1000; draw++) {
        ASSERT_EQ(current_counts(15.0), 1536) << "40 A; 20 deviations above the limit";
        ASSERT_LE(current_counts(10.0), 1536) << "30 A; half of the noise lies above the limit";
    }
}

TEST_F(Sensors, HeldCurrentsAreConvertedUntilLetGoAndTheBusIsNotHeld) {
    plant.current_A[0] = 10.0;
    plant.current_A[1] = 20.0;
    plant.bus_voltage_V = 240.0;
    sensors_hold_currents(&sensors, &plant);
    plant.current_A[0] = 30.0;
    plant.current_A[1] = 40.0;
    plant.bus_voltage_V = 250.0;
    hal_adc_sample_t sample;
    sensors_sample_adc(&sensors, &plant, &sample);
    EXPECT_EQ(sample.phase_current_counts[0], 512);
    EXPECT_EQ(sample.phase_current_counts[1], 1024);
    EXPECT_EQ(sample.bus_voltage_counts, 2000);
    sensors.currents_held = false;
    sensors_sample_adc(&sensors, &plant, &sample);
    EXPECT_EQ(sample.phase_current_counts[0], 1536);
    EXPECT_EQ(sample.phase_current_counts[1], 2048);
}

TEST_F(Sensors, NoiseHasItsDeviationAndItsSeed) {
    sensors.errors.current_noise_A = 0.5;
    sensors_t same = sensors, other;
    sensors_init(&other, &machine.sensors, 17, 12, 2);
    other.errors.current_noise_A = 0.5;
    plant.current_A[0] = 40.0;
    double sum = 0.0, squares = 0.0;
    unsigned differ = 0;
    const int draws = 20000;
    for (int draw = 0; draw < draws; draw++) {
        hal_adc_sample_t sample, same_sample, other_sample;
        sensors_sample_adc(&sensors, &plant, &sample);
        sensors_sample_adc(&same, &plant, &same_sample);
        sensors_sample_adc(&other, &plant, &other_sample);
        ASSERT_EQ(std::memcmp(&sample, &same_sample, sizeof sample), 0);
        differ += sample.phase_current_counts[0] != other_sample.phase_current_counts[0];
        const double error_A = sample.phase_current_counts[0] / 51.2 - 40.0;
        sum += error_A;
        squares += error_A * error_A;
    }
    EXPECT_NEAR(sum / draws, 0.0, 0.015);
    EXPECT_NEAR(std::sqrt(squares / draws), 0.5, 0.015);
    EXPECT_GT(differ, 15000u);
}

TEST_F(Sensors, EncoderFloorsAndWraps) {
    const double count = 1.0 / 131072.0;
    EXPECT_EQ(encoder_counts(0.0), 0u);
    EXPECT_EQ(encoder_counts(0.999 * count), 0u);
    EXPECT_EQ(encoder_counts(1.001 * count), 1u);
    EXPECT_EQ(encoder_counts(0.25), 32768u);
    EXPECT_EQ(encoder_counts(1.0 - 0.5 * count), 131071u);
    EXPECT_EQ(encoder_counts(1.0 + 0.5 * count), 0u);
    EXPECT_EQ(encoder_counts(1234.25 + 0.5 * count), 32768u);
}

TEST_F(Sensors, EncoderCountsDownThroughZero) {
    const double count = 1.0 / 131072.0;
    EXPECT_EQ(encoder_counts(-0.5 * count), 131071u);
    EXPECT_EQ(encoder_counts(-1.5 * count), 131070u);
    EXPECT_EQ(encoder_counts(-0.75 + 0.5 * count), 32768u);
    EXPECT_EQ(encoder_counts(-1e-30), 0u);
}

TEST_F(Sensors, EncoderHasTheBitsItWasGiven) {
    for (const unsigned bits : {8u, 24u, 32u}) {
        sensors_init(&sensors, &machine.sensors, bits, 12, 0);
        EXPECT_EQ(encoder_counts(0.5), UINT32_C(1) << (bits - 1));
        EXPECT_EQ(encoder_counts(-1e-12), UINT32_MAX >> (32 - bits));
    }
    sensors_init(&sensors, &machine.sensors, 0, 12, 0);
    EXPECT_EQ(encoder_counts(0.75), UINT32_C(0xC0000000));
}

TEST_F(Sensors, EccentricityGoesOnceRoundWithTheRotor) {
    sensors_init(&sensors, &machine.sensors, 32, 12, 1);
    sensors.errors.encoder_eccentricity_deg = 0.5;
    const double counts_per_degree = std::exp2(32) / 360.0;
    for (int turn : {-2, 0, 1000}) {
        for (int angle_deg = 0; angle_deg < 360; angle_deg += 5) {
            const double expected = (angle_deg + 0.5 * std::sin(angle_deg * M_PI / 180.0)) * counts_per_degree;
            const auto error =
                static_cast<int32_t>(encoder_counts(turn + angle_deg / 360.0) - static_cast<uint32_t>(expected));
            EXPECT_LE(std::abs(error), 4) << "turn " << turn << ", " << angle_deg << " deg";
        }
    }
}

TEST_F(Sensors, FrozenEncoderKeepsItsCountUntilHealthy) {
    EXPECT_EQ(encoder_counts(0.25), 32768u);
    sensors.encoder_fault = SENSORS_ENCODER_FROZEN;
    EXPECT_EQ(encoder_counts(0.5), 32768u);
    sensors.encoder_fault = SENSORS_ENCODER_HEALTHY;
    EXPECT_EQ(encoder_counts(0.5), 65536u);
}

TEST_F(Sensors, JumpedEncoderIsHalfATurnOff) {
    sensors.encoder_fault = SENSORS_ENCODER_JUMP;
    EXPECT_EQ(encoder_counts(0.25), 98304u);
    EXPECT_EQ(encoder_counts(0.75), 32768u);
    sensors_init(&sensors, &machine.sensors, 0, 12, 0);
    sensors.encoder_fault = SENSORS_ENCODER_JUMP;
    EXPECT_EQ(encoder_counts(0.75), UINT32_C(0x40000000));
}

} // namespace
