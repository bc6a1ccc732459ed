// A load that moves: sine, ramp and profile over the angle, instant by instant.
#include "support/rig_bench.h"

extern "C" {
#include "rig/load.h"
}

#include <cmath>
#include <map>
#include <numbers>

namespace {

constexpr uint64_t US = 1000, MS = 1000 * US;
enum : uint8_t { LOAD_TORQUE = 1, TRUTH_PERIOD = 6, RAMP = 18, AMPLITUDE = 19, FREQUENCY = 20, PROFILE = 21 };
const std::map<uint8_t, double> SCALES = {{LOAD_TORQUE, 0.0001}, {TRUTH_PERIOD, 1.0}, {RAMP, 0.01},
                                          {AMPLITUDE, 0.0001},   {FREQUENCY, 0.001},  {PROFILE, 0.0001}};

class Load : public testing::Test {
  protected:
    void SetUp() override { client = bench.connect(); }

    void set(uint8_t variable, double value, uint64_t at_us = 0) {
        const long raw = std::lround(value / SCALES.at(variable));
        client->set(variable, static_cast<int32_t>(raw), static_cast<uint32_t>(at_us));
        bench.serve();
        const auto records = client->receive();
        ASSERT_EQ(records.back().identifier(), RIG_SET_REPLY_FRAME_ID);
        ASSERT_EQ(records.back().frame.data[1], 0) << "done";
    }

    void set_profile_value(unsigned values, unsigned index, double value) {
        const auto raw = static_cast<uint32_t>(std::lround(value * 1e6));
        std::vector<uint8_t> data = {static_cast<uint8_t>(values), static_cast<uint8_t>(values >> 8),
                                     static_cast<uint8_t>(index), static_cast<uint8_t>(index >> 8)};
        for (int i = 0; i < 4; ++i) {
            data.push_back(static_cast<uint8_t>(raw >> (8 * i)));
        }
        ASSERT_TRUE(client->send(RIG_LOAD_PROFILE_FRAME_ID | CAN_EFF_FLAG, data));
        bench.serve();
    }
    void set_profile(const std::vector<double> &values) {
        for (unsigned index = 0; index < values.size(); ++index) {
            set_profile_value(static_cast<unsigned>(values.size()), index, values[index]);
        }
    }

    // Value of a profile half a step after the present angle.
    double profile_ahead(const std::vector<double> &values) const {
        const plant_t &plant = bench.rig->plant;
        const double turns = (plant.rotor_angle_rad + plant.speed_rad_s * 10e-6) / (2.0 * std::numbers::pi);
        const double position = (turns - std::floor(turns)) * static_cast<double>(values.size());
        const auto index = static_cast<size_t>(position);
        const double fraction = position - static_cast<double>(index);
        return (1.0 - fraction) * values[index % values.size()] + fraction * values[(index + 1) % values.size()];
    }

    // The load at a time that is not in the past.
    double load_at(uint64_t time_ns) {
        bench.run_to(*client, time_ns);
        return bench.rig->plant.load_torque_Nm;
    }

    bool event_is_due() const { return bench.rig->scheduler.due_ns[EVENT_LOAD] != SCHEDULER_NEVER; }

    RigBench bench;
    std::unique_ptr<BusClient> client;
};

double sine(double amplitude_Nm, double frequency_Hz, double time_s) {
    return amplitude_Nm * std::sin(2.0 * std::numbers::pi * frequency_Hz * time_s);
}

TEST_F(Load, SineIsAddedFromTheTimeAtWhichItsAmplitudeIsSet) {
    set(LOAD_TORQUE, 8);
    set(FREQUENCY, 20);
    set(AMPLITUDE, 4, 3010);
    EXPECT_EQ(load_at(3010 * US), 8.0);
    for (uint64_t step : {1u, 2u, 625u, 1250u, 1875u, 2500u, 2813u, 5000u}) {
        SCOPED_TRACE(step);
        const uint64_t time_ns = 3010 * US + step * LOAD_STEP_NS;
        EXPECT_NEAR(load_at(time_ns), 8.0 + sine(4.0, 20.0, static_cast<double>(step) * 20e-6), 1e-12);
    }
}

TEST_F(Load, LoadIsConstantBetweenItsSteps) {
    set(TRUTH_PERIOD, 1);
    set(FREQUENCY, 1000);
    set(AMPLITUDE, 200);
    const double stepped_Nm = load_at(20 * US);
    EXPECT_NEAR(stepped_Nm, sine(200.0, 1000.0, 20e-6), 1e-10);
    EXPECT_EQ(load_at(40 * US - 1), stepped_Nm);
    EXPECT_NEAR(load_at(40 * US), sine(200.0, 1000.0, 40e-6), 1e-10);
}

TEST_F(Load, FrequencyIsOneHertzUntilItIsSet) {
    set(AMPLITUDE, 6);
    EXPECT_NEAR(load_at(250 * MS), 6.0, 1e-12) << "GenSigStartValue in rig.dbc";
}

TEST_F(Load, NewAmplitudeKeepsThePhaseAndANewFrequencyContinuesIt) {
    set(FREQUENCY, 10);
    set(AMPLITUDE, 1);
    set(AMPLITUDE, 3, 10 * 1000);
    set(FREQUENCY, 50, 20 * 1000);
    EXPECT_NEAR(load_at(10 * MS), sine(3.0, 10.0, 0.010), 1e-12);
    EXPECT_NEAR(load_at(20 * MS), sine(3.0, 10.0, 0.020), 1e-12);
    EXPECT_NEAR(load_at(24 * MS), sine(3.0, 1.0, 0.2 + 50 * 0.004), 1e-12);
}

TEST_F(Load, AmplitudeZeroStopsTheEventAndTheNextSineBeginsAtPhaseZero) {
    set(LOAD_TORQUE, 2);
    set(FREQUENCY, 100);
    EXPECT_FALSE(event_is_due());
    set(AMPLITUDE, 5);
    EXPECT_TRUE(event_is_due());
    EXPECT_NEAR(load_at(2500 * US), 7.0, 1e-12);
    set(AMPLITUDE, 0);
    EXPECT_FALSE(event_is_due());
    EXPECT_EQ(load_at(2500 * US), 2.0);
    EXPECT_EQ(load_at(7 * MS), 2.0);
    set(AMPLITUDE, 5);
    EXPECT_EQ(load_at(7 * MS), 2.0);
    EXPECT_NEAR(load_at(7 * MS + 2500 * US), 7.0, 1e-12);
}

TEST_F(Load, RampReachesItsEndAndStays) {
    set(RAMP, 800);
    set(LOAD_TORQUE, 8, 1000); // within 10 ms
    EXPECT_EQ(load_at(1 * MS), 0.0);
    EXPECT_NEAR(load_at(3500 * US), 2.0, 1e-12);
    EXPECT_NEAR(load_at(11 * MS - 20 * US), 7.984, 1e-12);
    EXPECT_EQ(load_at(11 * MS + 20 * US), 8.0);
    EXPECT_FALSE(event_is_due());
    EXPECT_EQ(load_at(20 * MS), 8.0);
}

TEST_F(Load, RampTurnsFromWhereItIs) {
    set(RAMP, 1000);
    set(LOAD_TORQUE, 8);
    set(LOAD_TORQUE, -3, 4000);
    EXPECT_NEAR(load_at(4 * MS), 4.0, 1e-12);
    EXPECT_NEAR(load_at(6 * MS), 2.0, 1e-12);
    set(RAMP, 5000);
    EXPECT_NEAR(load_at(6200 * US), 1.0, 1e-12);
    set(RAMP, 0);
    EXPECT_EQ(bench.rig->plant.load_torque_Nm, -3.0) << "without a rate the rest is a step";
    EXPECT_FALSE(event_is_due());
}

TEST_F(Load, SineAndRampAdd) {
    set(RAMP, 100);
    set(FREQUENCY, 25);
    set(AMPLITUDE, 2);
    set(LOAD_TORQUE, 1);
    EXPECT_NEAR(load_at(8 * MS), 0.8 + sine(2.0, 25.0, 0.008), 1e-12);
    EXPECT_NEAR(load_at(10 * MS + 20 * US), 1.0 + sine(2.0, 25.0, 0.01002), 1e-12);
    EXPECT_TRUE(event_is_due());
    set(AMPLITUDE, 0);
    EXPECT_FALSE(event_is_due());
}

TEST_F(Load, ProfileFollowsTheTrueAngleInBothDirectionsAndAddsToTheRest) {
    const std::vector<double> values = {0.5, -1.0, 2.0, 0.0, 1.5, 1.0, 0.25};
    set_profile(values);
    for (const double sign : {-1.0, 1.0}) {
        set(LOAD_TORQUE, sign * 60);
        set(PROFILE, 3);
        double before_rad = bench.rig->plant.rotor_angle_rad;
        const uint64_t start_ns = bench.rig->board.time_ns;
        double least = 1e9, most = -1e9;
        for (uint64_t step = 1; step <= 10000; ++step) {
            const double load_Nm = load_at(start_ns + step * LOAD_STEP_NS);
            ASSERT_NEAR(load_Nm, sign * 60 + 3 * profile_ahead(values), 1e-9) << step;
            least = std::min(least, load_Nm);
            most = std::max(most, load_Nm);
        }
        EXPECT_GT(std::fabs(bench.rig->plant.rotor_angle_rad - before_rad), 4 * std::numbers::pi) << "turns";
        EXPECT_LT(least, sign * 60 - 2.8);
        EXPECT_GT(most, sign * 60 + 5.8);
    }
    set(PROFILE, 0);
    EXPECT_EQ(load_at(bench.rig->board.time_ns + LOAD_STEP_NS), 60.0);
    EXPECT_FALSE(event_is_due());
}

TEST_F(Load, ProfileValuesOutOfRangeAreIgnored) {
    set_profile({2.0});
    set(PROFILE, 1.5);
    EXPECT_EQ(load_at(LOAD_STEP_NS), 3.0) << "a single value is constant";
    set_profile_value(257, 0, 7.0);
    set_profile_value(0, 0, 7.0);
    set_profile_value(1, 1, 7.0);
    EXPECT_EQ(load_at(2 * LOAD_STEP_NS), 3.0);
    set_profile_value(1, 0, -4.0);
    EXPECT_EQ(load_at(3 * LOAD_STEP_NS), -6.0);
}

TEST_F(Load, WithoutSineAndRampTheLoadStepsAndThePlantStopsForNothingElse) {
    set(TRUTH_PERIOD, 0);
    set(LOAD_TORQUE, 8, 4321);
    EXPECT_EQ(load_at(4321 * US - 1), 0.0);
    EXPECT_EQ(load_at(4321 * US), 8.0);
    EXPECT_FALSE(event_is_due());
    load_at(4349 * US);
    EXPECT_EQ(bench.rig->plant.time_ns, 4325000u) << "a control period, no step of the load";
}

TEST_F(Load, TruthShowsTheLoadOfTheInstant) {
    set(LOAD_TORQUE, 8);
    set(FREQUENCY, 50);
    set(AMPLITUDE, 4);
    unsigned frames = 0;
    for (const auto &record : bench.run_to(*client, 20 * MS)) {
        if (record.identifier() == RIG_TRUTH_BENCH_FRAME_ID) {
            rig_truth_bench_t state{};
            rig_truth_bench_unpack(&state, record.frame.data, 8);
            const double expected_Nm = 8.0 + sine(4.0, 50.0, static_cast<double>(record.time_ns) * 1e-9);
            if (state.part == 0) {
                EXPECT_FLOAT_EQ(state.load_torque_nm, static_cast<float>(expected_Nm));
                ++frames;
            }
        }
    }
    EXPECT_EQ(frames, 20u);
}

TEST_F(Load, SameForAnyDivisionOfTime) {
    RigBench other;
    auto other_client = other.connect();
    for (const auto &to : {client.get(), other_client.get()}) {
        to->set(FREQUENCY, 33000);
        to->set(AMPLITUDE, 40000, 777);
        to->set(RAMP, 50000);
        to->set(LOAD_TORQUE, 50000, 1234);
    }
    bench.run_to(*client, 20 * MS);
    for (uint64_t i = 1; i <= 137; ++i) { // 20 ms / 137 is not a multiple of any period of the rig
        other.run_to(*other_client, 20 * MS * i / 137);
    }
    EXPECT_EQ(bench.rig->plant.load_torque_Nm, other.rig->plant.load_torque_Nm);
    EXPECT_EQ(bench.rig->plant.speed_rad_s, other.rig->plant.speed_rad_s);
}

} // namespace
