// RIG_SET: its effect, its time and its reply; the truth frames; the interrupt that takes time.
#include "support/rig_bench.h"

extern "C" {
#include "plant/pwm_timer.h"
}

namespace {

constexpr uint64_t MS = 1000000;

class BenchVariables : public testing::Test {
  protected:
    void SetUp() override { client = bench.connect(); }

    // Sends RIG_SET and returns the status of the reply.
    int set(uint8_t variable, int32_t raw, uint32_t at_us = 0) {
        client->set(variable, raw, at_us);
        bench.serve();
        auto records = client->receive();
        if (records.size() != 2) {
            return -1;
        }
        const auto &reply = records[1];
        EXPECT_EQ(reply.identifier(), RIG_SET_REPLY_FRAME_ID);
        EXPECT_EQ(reply.time_ns, bench.rig->board.time_ns);
        EXPECT_EQ(reply.frame.data[0], variable);
        uint32_t answered_us;
        std::memcpy(&answered_us, reply.frame.data + 4, 4);
        EXPECT_EQ(answered_us, at_us);
        return reply.frame.data[1];
    }

    RigBench bench;
    std::unique_ptr<BusClient> client;
};

enum { DONE, NO_SUCH_VARIABLE, OUT_OF_RANGE, IN_THE_PAST, QUEUE_FULL };

TEST_F(BenchVariables, RangesAreThoseOfTheDatabase) {
    struct {
        uint8_t variable;
        int32_t low, high;
    } ranges[] = {{1, -2000000, 2000000},
                  {2, 0, 2000000},
                  {3, 0, 2},
                  {4, 0, 1000000},
                  {5, 0, 100000},
                  {6, 0, 1000000},
                  {7, 0, 8000000},
                  {8, -1000000, 1000000},
                  {9, 100, 8000000},
                  {10, 0, 800},
                  {11, 0, 50000},
                  {12, 2000, 50000},
                  {13, 2000, 50000},
                  {14, 2000, 50000},
                  {15, 0, 50000},
                  {16, -50000, 50000},
                  {17, 0, 2000},
                  {18, 0, 8000000},
                  {19, 0, 2000000},
                  {20, 10, 1000000},
                  {21, -2000000, 2000000},
                  {22, -8388608, 8000000},
                  {30, -1000000, 1000000},
                  {31, 0, 8000000},
                  {32, 0, 1000000}};
    for (const auto &range : ranges) {
        SCOPED_TRACE(int(range.variable));
        EXPECT_EQ(set(range.variable, range.low), DONE);
        EXPECT_EQ(set(range.variable, range.high), DONE);
        EXPECT_EQ(set(range.variable, range.low - 1), OUT_OF_RANGE);
        EXPECT_EQ(set(range.variable, range.high + 1), OUT_OF_RANGE);
    }
    for (unsigned variable : {0u, 24u, 29u, 33u, 128u, 255u}) {
        EXPECT_EQ(set(static_cast<uint8_t>(variable), 1), NO_SUCH_VARIABLE);
    }
}

TEST_F(BenchVariables, ActImmediatelyOnTheirTarget) {
    EXPECT_EQ(set(1, -80000), DONE);
    EXPECT_DOUBLE_EQ(bench.rig->plant.load_torque_Nm, -8.0);
    EXPECT_EQ(set(2, 123456), DONE);
    EXPECT_DOUBLE_EQ(bench.rig->plant.bus_voltage_V, 123.456);
    EXPECT_EQ(set(3, 2), DONE);
    EXPECT_EQ(bench.rig->sensors.encoder_fault, SENSORS_ENCODER_JUMP);
    EXPECT_EQ(set(7, 2000), DONE);
    EXPECT_DOUBLE_EQ(bench.rig->sensors.errors.current_noise_A, 0.02);
    EXPECT_EQ(set(5, 12000), DONE);
    EXPECT_DOUBLE_EQ(bench.rig->sensors.errors.current_gain, 1.2);
    EXPECT_EQ(set(8, -5000), DONE);
    EXPECT_DOUBLE_EQ(bench.rig->sensors.errors.current_offset_A, -0.5);
    EXPECT_EQ(set(9, 40000), DONE);
    EXPECT_DOUBLE_EQ(bench.rig->sensors.errors.current_limit_A, 40.0);
    EXPECT_EQ(set(10, 312), DONE);
    EXPECT_DOUBLE_EQ(bench.rig->sensors.errors.current_delay_ns, 3120.0);
    EXPECT_EQ(set(11, 5000), DONE);
    EXPECT_DOUBLE_EQ(bench.rig->sensors.errors.encoder_eccentricity_deg, 0.5);
    EXPECT_EQ(set(12, 11000), DONE);
    EXPECT_EQ(set(13, 12000), DONE);
    EXPECT_EQ(set(14, 30000), DONE);
    EXPECT_EQ(set(15, 0), DONE);
    const plant_gains_t &gains = bench.rig->plant.gains;
    EXPECT_DOUBLE_EQ(gains.flux_linkage, 1.1) << "a gain leaves the others unchanged";
    EXPECT_DOUBLE_EQ(gains.resistance, 1.2);
    EXPECT_DOUBLE_EQ(gains.inertia, 3.0);
    EXPECT_DOUBLE_EQ(gains.friction, 0.0);
    EXPECT_EQ(set(16, -2500), DONE);
    EXPECT_DOUBLE_EQ(bench.rig->sensors.encoder_offset_deg, -0.25);
    EXPECT_EQ(set(17, 200), DONE);
    EXPECT_DOUBLE_EQ(bench.rig->plant.minimum_pulse_ns, 200.0);
    EXPECT_EQ(set(1, 2000001), OUT_OF_RANGE);
    EXPECT_DOUBLE_EQ(bench.rig->plant.load_torque_Nm, -8.0) << "a rejected value changes nothing";
}

TEST_F(BenchVariables, GainOfTheMachineActsFromItsTimeOn) {
    // Twice the inductance: half the slope of the current, which rises in each period's pulse.
    RigBench same;
    auto same_client = same.connect();
    EXPECT_EQ(set(12, 20000, 75), DONE);
    bench.run_to(*client, 75 * 1000);
    same.run_to(*same_client, 75 * 1000);
    const double before_A = bench.rig->plant.current_A[1];
    EXPECT_EQ(before_A, same.rig->plant.current_A[1]);
    bench.run_to(*client, 100 * 1000);
    same.run_to(*same_client, 100 * 1000);
    const double rise_A = same.rig->plant.current_A[1] - before_A;
    EXPECT_GT(rise_A, 0.5);
    EXPECT_NEAR(bench.rig->plant.current_A[1] - before_A, 0.5 * rise_A, 0.02 * rise_A);
}

TEST_F(BenchVariables, ActExactlyAtTheirTime) {
    EXPECT_EQ(set(6, 0), DONE); // no other event may split the plant's steps
    EXPECT_EQ(set(1, 80000, 4321), DONE);
    bench.run_to(*client, 4320999);
    EXPECT_EQ(bench.rig->plant.load_torque_Nm, 0.0);
    bench.run_to(*client, 4321000);
    EXPECT_EQ(bench.rig->plant.load_torque_Nm, 8.0);
    EXPECT_EQ(bench.rig->plant.time_ns, 4321000u);
}

TEST_F(BenchVariables, ActInTheOrderOfTheirTimesThenOfArrival) {
    EXPECT_EQ(set(1, 30000, 3000), DONE);
    EXPECT_EQ(set(1, 20000, 2000), DONE);
    EXPECT_EQ(set(1, 40000, 3000), DONE);
    bench.run_to(*client, 2 * MS);
    EXPECT_EQ(bench.rig->plant.load_torque_Nm, 2.0);
    bench.run_to(*client, 3 * MS);
    EXPECT_EQ(bench.rig->plant.load_torque_Nm, 4.0);
}

TEST_F(BenchVariables, PastIsRejectedPresentActsAndTheQueueIsLimited) {
    bench.run_to(*client, 2 * MS);
    EXPECT_EQ(set(1, 10000, 1999), IN_THE_PAST);
    EXPECT_EQ(bench.rig->plant.load_torque_Nm, 0.0);
    EXPECT_EQ(set(1, 10000, 2000), DONE) << "this very instant";
    EXPECT_EQ(bench.rig->plant.load_torque_Nm, 1.0);
    for (unsigned i = 0; i < STIMULUS_QUEUE; ++i) {
        ASSERT_EQ(set(1, static_cast<int32_t>(i), 3000 + i), DONE);
    }
    EXPECT_EQ(set(1, 0, 5000), QUEUE_FULL);
    EXPECT_EQ(set(1, 0), DONE) << "an immediate change needs no queue entry";
}

TEST_F(BenchVariables, WrongLengthRemoteAndForeignRigFramesAreOnlyRelayed) {
    auto other = bench.connect();
    client->send(RIG_SET_FRAME_ID | CAN_EFF_FLAG, {1, 0, 0, 1});
    client->send(RIG_RUN_UNTIL_FRAME_ID | CAN_EFF_FLAG, {0, 0, 0, 1, 0, 0, 0, 0});
    client->send(RIG_RUN_UNTIL_FRAME_ID | CAN_EFF_FLAG | CAN_RTR_FLAG, {0, 0, 0, 1, 0, 0, 0});
    client->send(RIG_CLOCK_FRAME_ID | CAN_EFF_FLAG, {0, 0, 0, 1, 0, 0, 0});
    client->send(0x1F0000FFu | CAN_EFF_FLAG, {1});
    bench.serve();
    EXPECT_EQ(client->receive().size(), 5u);
    EXPECT_EQ(other->receive().size(), 5u);
    EXPECT_EQ(bench.rig->board.time_ns, 0u);
    bench.run_to(*client, 5 * MS);
    EXPECT_TRUE(bench.firmware.received.empty());
}

TEST_F(BenchVariables, TruthComesOnMultiplesOfItsPeriod) {
    auto truth_times = [this](uint64_t until_ns) {
        std::vector<uint64_t> times;
        for (const auto &record : bench.run_to(*client, until_ns)) {
            if (record.identifier() == RIG_TRUTH_MOTION_FRAME_ID) {
                times.push_back(record.time_ns);
            }
        }
        return times;
    };
    EXPECT_EQ(truth_times(2500000), (std::vector<uint64_t>{1 * MS, 2 * MS}));
    EXPECT_EQ(set(6, 300), DONE);
    EXPECT_EQ(truth_times(3300000), (std::vector<uint64_t>{2700000, 3000000, 3300000}));
    EXPECT_EQ(set(6, 0), DONE);
    EXPECT_TRUE(truth_times(10 * MS).empty());
}

TEST_F(BenchVariables, TruthIsTheStateOfThePlant) {
    EXPECT_EQ(set(1, -500000), DONE); // drives the shaft
    auto records = bench.run_to(*client, 4 * MS);
    rig_truth_motion_t motion{};
    rig_truth_currents_t currents{};
    rig_truth_bench_t state{};
    unsigned parts = 0;
    for (const auto &record : records) {
        if (record.time_ns != 4 * MS) {
            continue;
        }
        if (record.identifier() == RIG_TRUTH_MOTION_FRAME_ID) {
            rig_truth_motion_unpack(&motion, record.frame.data, 8);
        } else if (record.identifier() == RIG_TRUTH_CURRENTS_FRAME_ID) {
            rig_truth_currents_unpack(&currents, record.frame.data, 8);
            parts |= 1u << currents.part;
        } else if (record.identifier() == RIG_TRUTH_BENCH_FRAME_ID) {
            rig_truth_bench_unpack(&state, record.frame.data, 8);
            parts |= 4u << state.part;
        }
    }
    EXPECT_EQ(parts, 0xFu);
    const plant_t &plant = bench.rig->plant;
    ASSERT_EQ(plant.time_ns, 4 * MS);
    ASSERT_GT(plant.current_A[1], 1.0);
    EXPECT_FLOAT_EQ(motion.speed_rpm, static_cast<float>(plant.speed_rad_s * 30 / 3.14159265358979));
    EXPECT_FLOAT_EQ(motion.torque_nm, static_cast<float>(plant_torque_Nm(&plant)));
    EXPECT_NEAR(currents.current_b_a / 65536.0, plant.current_A[1], 0.5 / 65536 + 1e-9);
    EXPECT_EQ(currents.current_d_a, 0);
    EXPECT_NEAR(rig_truth_bench_rotor_angle_deg_decode(state.rotor_angle_deg),
                plant.rotor_angle_rad * 180 / 3.14159265358979, 1.1e-5);
    EXPECT_EQ(state.load_torque_nm, -50.0f);
    EXPECT_EQ(state.bus_voltage_v, 240.0f);
}

// ADC counts of phase 1's current. The stand-in firmware's pulse is from 4 to 21 us of each period: a delay of more
// than 4 us shows.
uint16_t counts_of(double current_A) {
    return static_cast<uint16_t>(current_A * 51.2 + 0.5);
}

TEST_F(BenchVariables, DelayedSampleShowsTheCurrentOfThatInstant) {
    EXPECT_EQ(set(6, 1), DONE); // the truth each microsecond: the plant stops there
    std::vector<double> current_A;
    for (uint64_t time_us = 1; time_us <= 200; ++time_us) {
        bench.run_to(*client, time_us * 1000);
        current_A.push_back(bench.rig->plant.current_A[1]);
    }
    EXPECT_EQ(bench.rig->board.adc.phase_current_counts[1], counts_of(current_A[199])) << "no delay";
    for (auto [centi_us, period_end_us] : {std::pair{600, 225u}, {800, 250u}, {0, 275u}}) {
        EXPECT_EQ(set(10, centi_us), DONE);
        for (uint64_t time_us = current_A.size() + 1; time_us <= period_end_us; ++time_us) {
            bench.run_to(*client, time_us * 1000);
            current_A.push_back(bench.rig->plant.current_A[1]);
        }
        const uint64_t sampled_us = period_end_us - static_cast<unsigned>(centi_us) / 100;
        EXPECT_EQ(bench.rig->board.adc.phase_current_counts[1], counts_of(current_A[sampled_us - 1])) << centi_us;
        EXPECT_EQ(counts_of(current_A[sampled_us - 1]) < counts_of(current_A.back()), centi_us > 0);
        EXPECT_EQ(bench.rig->board.adc.bus_voltage_counts, 1920);
    }
}

TEST_F(BenchVariables, DelayPassedAlreadyActsFromTheNextPeriodOn) {
    const auto shown = [this] { return bench.rig->board.adc.phase_current_counts[1]; };
    const auto present = [this] { return counts_of(bench.rig->plant.current_A[1]); };
    EXPECT_EQ(set(6, 0), DONE);
    EXPECT_EQ(set(10, 800, 193), DONE) << "7 us before a period starts";
    bench.run_to(*client, 200 * 1000);
    EXPECT_EQ(shown(), present());
    bench.run_to(*client, 217 * 1000);
    ASSERT_EQ(bench.rig->plant.time_ns, 217000u) << "advanced to the instant that is sampled";
    const uint16_t held = present();
    bench.run_to(*client, 225 * 1000);
    EXPECT_EQ(shown(), held);
    EXPECT_LT(shown(), present());
    EXPECT_EQ(set(10, 0, 248), DONE) << "what is held is let go";
    bench.run_to(*client, 250 * 1000);
    EXPECT_EQ(shown(), present());
}

TEST_F(BenchVariables, WithoutDelayThePlantStopsAtPeriodsOnly) {
    EXPECT_EQ(set(6, 0), DONE);
    EXPECT_EQ(set(10, 300), DONE);
    EXPECT_EQ(set(10, 0), DONE);
    bench.run_to(*client, 224 * 1000);
    EXPECT_EQ(bench.rig->plant.time_ns, 200000u);
}

TEST_F(BenchVariables, InterruptWithinItsPeriodDelaysTheBackgroundOnly) {
    EXPECT_EQ(set(4, 1000), DONE); // 10 us of 25
    bench.run_to(*client, MS);
    EXPECT_EQ(bench.firmware.interrupts, 40u);
    EXPECT_EQ(bench.firmware.missed, 0u);
    ASSERT_EQ(bench.firmware.background_times_ns.size(), 39u);
    EXPECT_EQ(bench.firmware.background_times_ns[0], 35000u);
}

TEST_F(BenchVariables, InterruptBeyondItsPeriodLosesInterruptsAndKeepsCompares) {
    EXPECT_EQ(set(4, 6000), DONE); // 60 us: occupied from 25 to 85, lost at 50 and 75, next at 100
    bench.run_to(*client, 99999);
    EXPECT_EQ(bench.firmware.interrupt_times_ns, (std::vector<uint64_t>{25000}));
    EXPECT_EQ(bench.firmware.background_times_ns, (std::vector<uint64_t>{85000}));
    EXPECT_EQ(bench.rig->board.missed_triggers, 2u);
    EXPECT_EQ(bench.rig->board.active.lower[1], 0) << "written in a period that has not ended for the firmware";
    bench.run_to(*client, 100000);
    EXPECT_EQ(bench.firmware.missed, 2u);
    EXPECT_EQ(bench.rig->board.active.lower[1], 2500);
    EXPECT_EQ(set(4, 0), DONE);
    bench.run_to(*client, MS);
    EXPECT_EQ(bench.firmware.missed, 4u) << "the one that was running when the variable changed";
}

TEST_F(BenchVariables, InterruptHasTheGivenTimeAndMayTakeLonger) {
    EXPECT_EQ(set(4, 1000), DONE); // 10 us of 25
    bench.run_to(*client, 30 * 1000);
    EXPECT_EQ(bench.rig->board.interrupt_took_ns, 10000u);
    bench.firmware.takes_ns = 25001; // a processor whose instructions take time: until 75.001 us
    bench.run_to(*client, 75 * 1000);
    EXPECT_EQ(bench.firmware.missed, 0u);
    EXPECT_EQ(bench.rig->board.missed_triggers, 1u);
    bench.firmware.takes_ns = 25000; // ends with its period
    bench.run_to(*client, 125 * 1000);
    EXPECT_EQ(bench.firmware.interrupt_times_ns, (std::vector<uint64_t>{25000, 50000, 100000, 125000}));
    EXPECT_EQ(bench.firmware.background_times_ns, (std::vector<uint64_t>{35000, 75001}));
    EXPECT_EQ(bench.firmware.missed, 1u);
}

TEST_F(BenchVariables, TriggersThatTheProcessorDoesNotServeAreMissed) {
    rig_busy_until(bench.rig.get(), 75000);
    bench.run_to(*client, 100 * 1000);
    EXPECT_EQ(bench.firmware.interrupt_times_ns, (std::vector<uint64_t>{75000, 100000}));
    EXPECT_EQ(bench.firmware.missed, 2u);
}

TEST_F(BenchVariables, CompareValuesActInTheNextPeriodOrImmediatelyOnABoardWithoutThatDelay) {
    // The stand-in firmware has the lower switch of phase 1 on for whole periods.
    bench.run_to(*client, 49 * 1000);
    EXPECT_EQ(bench.rig->plant.switches[1] & HALF_BRIDGE_LOWER, 0u) << "written in the period that starts at 25 us";
    bench.run_to(*client, 51 * 1000);
    EXPECT_EQ(bench.rig->plant.switches[1], HALF_BRIDGE_LOWER);
    bench.rig->board.immediate_pwm = true;
    bench.firmware.lower = 0;
    bench.run_to(*client, 76 * 1000);
    EXPECT_EQ(bench.rig->plant.switches[1] & HALF_BRIDGE_LOWER, 0u) << "written at 75 us";
    bench.firmware.lower = 2500;
    bench.run_to(*client, 101 * 1000);
    EXPECT_EQ(bench.rig->plant.switches[1], HALF_BRIDGE_LOWER);
}

TEST_F(BenchVariables, EdgesAreCapturedWhileTriggersAreMissed) {
    bench.rig->sensors.encoder_edges = true;
    EXPECT_EQ(set(1, -2000000), DONE); // 200 N m turn the shaft: 1 rad/s after 100 us
    bench.run_to(*client, 400 * 1000);
    ASSERT_EQ(bench.rig->plant.time_ns, 400000u);
    EXPECT_EQ(set(4, 6000), DONE); // occupied from 425 us to 485 us, lost at 450 and 475
    bench.run_to(*client, 425 * 1000);
    const hal_encoder_sample_t read = bench.rig->board.encoder;
    ASSERT_TRUE(read.edge_known);
    ASSERT_TRUE(read.edge_forward);
    bench.run_to(*client, 475 * 1000);
    EXPECT_EQ(bench.firmware.interrupts, 17u) << "the last one at 425 us";
    EXPECT_EQ(bench.rig->board.encoder.counts, read.counts) << "what the running interrupt reads stays";
    bench.run_to(*client, 500 * 1000);
    EXPECT_EQ(bench.firmware.interrupts, 18u);
    // 5 rad/s: a count of 48 urad each 10 us.
    EXPECT_GE(bench.rig->board.encoder.counts, read.counts + 5);
    EXPECT_TRUE(bench.rig->board.encoder.edge_known);
    EXPECT_LT(bench.rig->board.encoder.edge_age_ticks * PWM_TIMER_TICK_NS, 12000u);
}

TEST_F(BenchVariables, InterruptOfExactlyAPeriodStarvesTheBackground) {
    EXPECT_EQ(set(4, 2500), DONE);
    bench.run_to(*client, MS);
    EXPECT_EQ(bench.firmware.interrupts, 40u);
    EXPECT_EQ(bench.firmware.missed, 0u);
    EXPECT_EQ(bench.firmware.backgrounds, 0u);
}

} // namespace
