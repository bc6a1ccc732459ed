#include <gtest/gtest.h>

#include <cmath>
#include <cstring>

#include "support/emulator_machines.h"

extern "C" {
#include "plant/pwm_timer.h"
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

TEST_F(Sensors, CurrentIsRoundedToTheNearestCount) {
    EXPECT_EQ(current_counts(0.0), 0);
    EXPECT_EQ(current_counts(0.49 / 51.2), 0);
    EXPECT_EQ(current_counts(0.5 / 51.2), 1);
    EXPECT_EQ(current_counts(1.49 / 51.2), 1);
    EXPECT_EQ(current_counts(40.0), 2048);
}

TEST_F(Sensors, CurrentSaturatesAtTheLargestCount) {
    EXPECT_EQ(current_counts(4094.4 / 51.2), 4094);
    EXPECT_EQ(current_counts(4094.5 / 51.2), 4095);
    EXPECT_EQ(current_counts(80.0), 4095);
    EXPECT_EQ(current_counts(1e9), 4095);
    EXPECT_EQ(current_counts(-1.0), 0);
    EXPECT_EQ(current_counts(std::nan("")), 0);
}

TEST_F(Sensors, DcLinkVoltageHasItsOwnScale) {
    EXPECT_EQ(bus_counts(240.0), 1920);
    EXPECT_EQ(bus_counts(240.06), 1920);
    EXPECT_EQ(bus_counts(240.07), 1921);
    EXPECT_EQ(bus_counts(600.0), 4095);
}

TEST_F(Sensors, CountsHaveTheConfiguredResolutionOverTheSameFullScale) {
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

TEST_F(Sensors, LoadTorqueIsOffsetBinaryAndSaturates) {
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
    plant.current_A[3] = 30.0; // the machine has three phases
    sensors.errors.current_gain = 1.5;
    hal_adc_sample_t sample;
    std::memset(&sample, 0xFF, sizeof sample);
    sensors_sample_adc(&sensors, &plant, &sample);
    EXPECT_EQ(sample.phase_current_counts[0], 768);
    EXPECT_EQ(sample.phase_current_counts[1], 1536);
    EXPECT_EQ(sample.phase_current_counts[2], 2304);
    EXPECT_EQ(sample.phase_current_counts[3], 0);
}

TEST_F(Sensors, ErrorsAreThoseOfTheMachineUntilChanged) {
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

TEST_F(Sensors, OffsetIsAddedAfterTheGainAndReadsZeroBelowZero) {
    sensors.errors.current_gain = 0.5;
    sensors.errors.current_offset_A = 10.0;
    EXPECT_EQ(current_counts(0.0), 512);
    EXPECT_EQ(current_counts(40.0), 1536);
    sensors.errors.current_offset_A = -10.0;
    EXPECT_EQ(current_counts(40.0), 512);
    EXPECT_EQ(current_counts(20.0), 0);
    EXPECT_EQ(current_counts(0.0), 0);
}

TEST_F(Sensors, LimitIsAppliedAfterGainOffsetAndNoise) {
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

TEST_F(Sensors, HeldCurrentsAreConvertedWhileHeldAndTheDcLinkVoltageIsNot) {
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

TEST_F(Sensors, NoiseHasTheDeviationAndTheSeedGiven) {
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

TEST_F(Sensors, EncoderHasTheConfiguredResolution) {
    for (const unsigned bits : {8u, 24u, 32u}) {
        sensors_init(&sensors, &machine.sensors, bits, 12, 0);
        EXPECT_EQ(encoder_counts(0.5), UINT32_C(1) << (bits - 1));
        EXPECT_EQ(encoder_counts(-1e-12), UINT32_MAX >> (32 - bits));
    }
    sensors_init(&sensors, &machine.sensors, 0, 12, 0);
    EXPECT_EQ(encoder_counts(0.75), UINT32_C(0xC0000000));
}

TEST_F(Sensors, EccentricityErrorHasOnePeriodPerRevolution) {
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

TEST_F(Sensors, OffsetIsAddedToTheReading) {
    sensors.encoder_offset_deg = 0.5;
    EXPECT_EQ(encoder_counts(0.25), 32768u + 182u) << "0.5 deg of 131072 counts a turn: 182.04";
    sensors.encoder_offset_deg = -0.5;
    EXPECT_EQ(encoder_counts(0.25), 32768u - 183u);
    EXPECT_EQ(encoder_counts(0.0), 131072u - 183u);
}

TEST_F(Sensors, FrozenEncoderKeepsItsCountUntilHealthy) {
    EXPECT_EQ(encoder_counts(0.25), 32768u);
    sensors.encoder_fault = SENSORS_ENCODER_FROZEN;
    EXPECT_EQ(encoder_counts(0.5), 32768u);
    sensors.encoder_fault = SENSORS_ENCODER_HEALTHY;
    EXPECT_EQ(encoder_counts(0.5), 65536u);
}

TEST_F(Sensors, JumpOffsetsTheEncoderByHalfARevolution) {
    sensors.encoder_fault = SENSORS_ENCODER_JUMP;
    EXPECT_EQ(encoder_counts(0.25), 98304u);
    EXPECT_EQ(encoder_counts(0.75), 32768u);
    sensors_init(&sensors, &machine.sensors, 0, 12, 0);
    sensors.encoder_fault = SENSORS_ENCODER_JUMP;
    EXPECT_EQ(encoder_counts(0.75), UINT32_C(0x40000000));
}

// --- Edges of the encoder ---

constexpr uint64_t PERIOD_NS = 25000;
constexpr uint16_t TICKS = 2500;

// A machine whose encoder is latched in each period, and the reference for its edges: a copy of the plant, advanced in
// steps of nanoseconds.
class Edges : public testing::Test {
  protected:
    Edges() : machine(machine_of(MAGNETICS_SATURATING)) { start(17, 0.1, 0.0); }

    void start(unsigned bits, double angle_rad, double speed_rad_s) {
        plant_init(&plant, &machine, angle_rad);
        plant.speed_rad_s = speed_rad_s;
        sensors_init(&sensors, &machine.sensors, bits, 12, 1);
        sensors.encoder_edges = true;
        counts_per_turn = std::ldexp(1.0, int(bits));
        worst_rad = 0.0;
        edges = 0;
        latch();
    }

    void latch() { sensors_sample_encoder(&sensors, &plant, &sample); }

    double read_rad(const plant_t &at) const {
        return at.rotor_angle_rad +
               sensors.errors.encoder_eccentricity_deg * M_PI / 180.0 * std::sin(at.rotor_angle_rad) +
               sensors.encoder_offset_deg * M_PI / 180.0;
    }

    // One period with phases switched on for the given ticks. A new edge is compared with the position of the plant
    // then.
    void period(std::vector<uint16_t> ticks = {}, uint64_t length_ns = PERIOD_NS) {
        hal_pwm_compare_t compare{};
        for (size_t phase = 0; phase < ticks.size(); phase++) {
            compare.upper[phase] = ticks[phase];
            compare.lower[phase] = TICKS;
        }
        plant_set_switches(&plant, &compare, TICKS);
        plant_t at_edge = plant;
        const uint64_t before_ns = plant.time_ns;
        plant_advance(&plant, before_ns + length_ns);
        latch();
        if (!sample.edge_known || sensors.edge.time_ns <= double(before_ns)) {
            return;
        }
        edges++;
        const double edge_ns = sensors.edge.time_ns, whole_ns = std::floor(edge_ns);
        plant_advance(&at_edge, uint64_t(whole_ns));
        const double angle_rad = read_rad(at_edge) + at_edge.speed_rad_s * (edge_ns - whole_ns) * 1e-9;
        const double boundary = sample.counts + (sample.edge_forward ? 0.0 : 1.0);
        const double away_rad = std::remainder(angle_rad - boundary / counts_per_turn * 2.0 * M_PI, 2.0 * M_PI);
        worst_rad = std::max(worst_rad, std::fabs(away_rad));
        ASSERT_NEAR(sample.edge_age_ticks, (double(plant.time_ns) - edge_ns) / PWM_TIMER_TICK_NS, 0.5 + 1e-6);
        ASSERT_EQ(sample.edge_forward, at_edge.speed_rad_s > 0.0);
    }

    machine_t machine;
    plant_t plant;
    sensors_t sensors;
    hal_encoder_sample_t sample;
    double counts_per_turn = 0.0, worst_rad = 0.0;
    unsigned edges = 0;
};

TEST_F(Edges, AreUnknownBeforeTheFirstOneAndWithoutCapture) {
    for (unsigned k = 0; k < 10; k++) {
        period();
        EXPECT_FALSE(sample.edge_known);
        EXPECT_EQ(sample.edge_age_ticks, 0u);
    }
    start(17, 0.1, 10.0);
    period();
    EXPECT_TRUE(sample.edge_known);
    sensors_init(&sensors, &machine.sensors, 17, 12, 1);
    EXPECT_FALSE(sensors.encoder_edges);
    for (unsigned k = 0; k < 10; k++) {
        period();
        EXPECT_FALSE(sample.edge_known);
    }
}

TEST_F(Edges, AreWithinAHundredthOfAMicroradianUnderSwitchingAndLoadSteps) {
    machine.inertia_kg_m2 = 0.01; // half of the machine file
    for (double controlled_rad_s : {314.0, -314.0, 3.0, -3.0}) {
        const double direction = std::copysign(1.0, controlled_rad_s);
        start(17, 0.1, controlled_rad_s);
        for (unsigned k = 0; k < 4000; k++) {
            // Load steps on a dynamometer that controls the speed.
            plant.load_torque_Nm = (k / 7 % 2 == 0 ? -8.0 : 8.0) + 10.0 * (plant.speed_rad_s - controlled_rad_s);
            // Each phase is switched for a part of its pitch, with its permitted duty.
            std::vector<uint16_t> ticks;
            for (unsigned phase = 0; phase < 3; phase++) {
                // Torque is positive from half a pitch to a whole one.
                const double pitches = direction * plant_phase_angle_rad(&plant, phase) / (M_PI / 2.0);
                const double part = pitches - std::floor(pitches);
                const bool on = part > 0.45 && part < 0.8;
                ticks.push_back(on && plant.current_A[phase] < 60.0 ? uint16_t(977 + 131 * (k % 11)) : 0);
            }
            period(ticks);
        }
        EXPECT_NEAR(plant.speed_rad_s, controlled_rad_s, 10.0);
        EXPECT_GT(edges, 3000u);
        EXPECT_LT(worst_rad, 0.01e-6);
        EXPECT_GT(worst_rad, 1e-13) << "at least one edge was compared";
    }
}

TEST_F(Edges, AreEquallyAccurateWithOneEdgeInSeveralPeriods) {
    machine.friction_Nm_s = 0.0;
    start(17, 0.1, 0.02); // 0.19 r/min: a count in 96 periods
    unsigned aged = 0;
    for (unsigned k = 0; k < 8000; k++) {
        const uint32_t before_ticks = sample.edge_age_ticks;
        const bool known = sample.edge_known;
        const unsigned seen = edges;
        period();
        if (known && edges == seen) {
            aged++;
            ASSERT_EQ(sample.edge_age_ticks, before_ticks + PERIOD_NS / PWM_TIMER_TICK_NS);
        }
    }
    EXPECT_NEAR(edges, 8000 * 25e-6 * 0.02 / (2.0 * M_PI) * counts_per_turn, 1.0);
    EXPECT_GT(aged, 7000u);
    EXPECT_LT(worst_rad, 0.1e-6);
}

TEST_F(Edges, AreThoseOfTheReadingWithItsErrors) {
    start(17, 0.1, 100.0);
    sensors.errors.encoder_eccentricity_deg = 2.0;
    sensors.encoder_offset_deg = -1.5;
    for (unsigned k = 0; k < 4000; k++) {
        period();
    }
    EXPECT_GT(edges, 3990u);
    EXPECT_LT(worst_rad, 0.1e-6);
}

TEST_F(Edges, FollowReversalsOfTheRotor) {
    // The load makes the shaft oscillate over a few counts, finally over none.
    machine.friction_Nm_s = 0.0;
    const double count_rad = 2.0 * M_PI / 131072.0;
    unsigned forward = 0, backward = 0;
    for (double amplitude_counts : {3.2, 0.6, 0.05}) {
        // Oscillation about a boundary, starting at a reversal; its period is 160 control periods.
        const double oscillation_rad_s = 2.0 * M_PI / (160 * 25e-6);
        start(17, (1000.0 - amplitude_counts) * count_rad, 0.0);
        for (unsigned k = 0; k < 1600; k++) {
            plant.load_torque_Nm = machine.inertia_kg_m2 * oscillation_rad_s * oscillation_rad_s *
                                   (plant.rotor_angle_rad - 1000.0 * count_rad);
            const unsigned seen = edges;
            period();
            if (edges > seen) {
                (sample.edge_forward ? forward : backward)++;
            }
        }
        EXPECT_LT(worst_rad, 0.1e-6);
        EXPECT_GE(edges, 19u) << amplitude_counts;
    }
    EXPECT_GT(forward, 40u);
    EXPECT_GT(backward, 40u);
}

TEST_F(Edges, AreDetectedWhenTheRotorReversesWithinAPeriod) {
    // 0.3 counts before a boundary, over it and back within one long period.
    const double count_rad = 2.0 * M_PI / 131072.0;
    machine.friction_Nm_s = 0.0;
    start(17, 999.9 * count_rad, 0.0);
    plant.speed_rad_s = 1.0;
    plant.load_torque_Nm = machine.inertia_kg_m2 * 2.0 / 50e-6; // returns after 50 us, at most 0.52 counts farther
    latch();
    EXPECT_EQ(sample.counts, 999u);
    period({}, 50000);
    EXPECT_EQ(sample.counts, 999u);
    EXPECT_TRUE(sample.edge_known);
    EXPECT_FALSE(sample.edge_forward) << "the last edge is in reverse direction";
    EXPECT_EQ(edges, 1u);
    EXPECT_LT(worst_rad, 0.1e-6);
}

TEST_F(Edges, AgeSaturates) {
    start(17, 0.1, 10.0);
    period();
    ASSERT_TRUE(sample.edge_known);
    plant.speed_rad_s = 0.0;
    plant.time_ns += UINT64_C(0x7FFFFFFE) * PWM_TIMER_TICK_NS - sample.edge_age_ticks * PWM_TIMER_TICK_NS;
    latch();
    EXPECT_NEAR(sample.edge_age_ticks, 0x7FFFFFFE, 1);
    plant.time_ns += UINT64_C(100000000000);
    latch();
    EXPECT_EQ(sample.edge_age_ticks, 0x7FFFFFFFu);
    EXPECT_TRUE(sample.edge_known);
}

TEST_F(Edges, AreAbsentWhileTheEncoderIsFrozenAndNotReportedLater) {
    start(17, 0.1, 100.0);
    period();
    const uint32_t counts = sample.counts, age_ticks = sample.edge_age_ticks;
    sensors.encoder_fault = SENSORS_ENCODER_FROZEN;
    for (unsigned k = 1; k <= 10; k++) {
        period();
        EXPECT_EQ(sample.counts, counts);
        EXPECT_TRUE(sample.edge_known);
        EXPECT_EQ(sample.edge_age_ticks, age_ticks + k * PERIOD_NS / PWM_TIMER_TICK_NS);
    }
    sensors.encoder_fault = SENSORS_ENCODER_HEALTHY;
    plant_advance(&plant, plant.time_ns + PERIOD_NS);
    latch();
    EXPECT_FALSE(sample.edge_known);
    period();
    EXPECT_TRUE(sample.edge_known);
    EXPECT_LT(worst_rad, 0.1e-6);
}

TEST_F(Edges, AreNotCausedByAChangeOfTheReading) {
    start(17, 0.1, 10.0);
    period();
    ASSERT_TRUE(sample.edge_known);
    plant.speed_rad_s = 0.0;
    latch();
    ASSERT_TRUE(sample.edge_known);
    sensors.encoder_offset_deg = 0.1;
    latch();
    EXPECT_FALSE(sample.edge_known);
    plant.speed_rad_s = 10.0;
    period();
    EXPECT_TRUE(sample.edge_known);
    const uint32_t counts = sample.counts, age_ticks = sample.edge_age_ticks;
    sensors.encoder_fault = SENSORS_ENCODER_JUMP;
    latch();
    EXPECT_EQ(sample.counts, counts + 65536u);
    EXPECT_TRUE(sample.edge_known) << "the boundaries jump as well";
    EXPECT_EQ(sample.edge_age_ticks, age_ticks);
}

TEST_F(Edges, AreAtTheLatchForAnIdealEncoder) {
    start(32, 0.1, 10.0);
    period();
    EXPECT_TRUE(sample.edge_known);
    EXPECT_LE(sample.edge_age_ticks, 1u);
}

} // namespace
