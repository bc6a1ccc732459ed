// The dynamometer of held_speed_rpm: its acceleration, the held speed, what it takes, and the free shaft.
#include "support/rig_bench.h"

extern "C" {
#include "rig/dynamometer.h"
}

#include <cmath>
#include <numbers>

namespace {

constexpr uint64_t MS = 1000000;
enum : uint8_t { LOAD_TORQUE = 1, HELD_SPEED = 22 };
constexpr int32_t FREE = -8388608;
constexpr double RAD_S_PER_RPM = std::numbers::pi / 30.0;

class Dynamometer : public testing::Test {
  protected:
    void SetUp() override { client = bench.connect(); }

    void set(uint8_t variable, int32_t raw, uint32_t at_us = 0) {
        client->set(variable, raw, at_us);
        bench.serve();
        const auto records = client->receive();
        ASSERT_EQ(records.back().identifier(), RIG_SET_REPLY_FRAME_ID);
        ASSERT_EQ(records.back().frame.data[1], 0) << "done";
    }

    void hold(double speed_rpm, uint32_t at_us = 0) {
        set(HELD_SPEED, static_cast<int32_t>(std::lround(speed_rpm * 100.0)), at_us);
    }

    double speed_rpm_at(uint64_t time_ns) {
        bench.run_to(*client, time_ns);
        plant_advance(&bench.rig->plant, time_ns);
        return bench.rig->plant.speed_rad_s / RAD_S_PER_RPM;
    }

    bool event_is_due() const { return bench.rig->scheduler.due_ns[EVENT_DYNAMOMETER] != SCHEDULER_NEVER; }

    RigBench bench;
    std::unique_ptr<BusClient> client;
};

TEST_F(Dynamometer, AcceleratesTheShaftUniformlyToTheHeldSpeed) {
    hold(600.0);
    EXPECT_NEAR(speed_rpm_at(30 * MS), 300.0, 1e-4);
    EXPECT_NEAR(speed_rpm_at(59 * MS), 590.0, 1e-4);
    EXPECT_TRUE(event_is_due());
    EXPECT_EQ(speed_rpm_at(61 * MS), 600.0);
    EXPECT_FALSE(event_is_due());
    EXPECT_EQ(speed_rpm_at(200 * MS), 600.0);
    hold(-200.0);
    EXPECT_NEAR(speed_rpm_at(240 * MS), 200.0, 1e-4);
    EXPECT_EQ(speed_rpm_at(300 * MS), -200.0);
}

TEST_F(Dynamometer, ANewSpeedOnTheWayIsReachedFromThePresentOne) {
    hold(600.0);
    hold(100.0, 30000);
    EXPECT_NEAR(speed_rpm_at(30 * MS), 300.0, 1e-4);
    EXPECT_NEAR(speed_rpm_at(40 * MS), 200.0, 1e-4);
    EXPECT_EQ(speed_rpm_at(60 * MS), 100.0);
}

TEST_F(Dynamometer, NeitherLoadNorTorqueMovesAHeldShaftAndTheTransducerShowsWhatIsTaken) {
    hold(300.0);
    set(LOAD_TORQUE, 80000);
    EXPECT_EQ(speed_rpm_at(100 * MS), 300.0);
    const plant_t &plant = bench.rig->plant;
    const double drag_Nm = plant.friction_Nm_s * 300.0 * RAD_S_PER_RPM;
    EXPECT_NE(plant_torque_Nm(&plant), 0.0) << "the drive of the test moves its switches";
    EXPECT_NEAR(plant_shaft_torque_Nm(&plant), plant_torque_Nm(&plant) - drag_Nm, 1e-12);
}

TEST_F(Dynamometer, AFreedShaftContinuesWithItsSpeedUnderItsLoad) {
    hold(300.0);
    set(LOAD_TORQUE, 500000);
    set(HELD_SPEED, FREE, 100000);
    EXPECT_EQ(speed_rpm_at(100 * MS), 300.0);
    EXPECT_NEAR(speed_rpm_at(101 * MS), 300.0, 80.0) << "no jump";
    EXPECT_LT(speed_rpm_at(150 * MS), -300.0) << "50 N m, more than the machine has";
    EXPECT_EQ(plant_shaft_torque_Nm(&bench.rig->plant), 50.0);
    EXPECT_FALSE(event_is_due());
}

TEST_F(Dynamometer, SameForAnyDivisionOfTime) {
    RigBench other;
    auto other_client = other.connect();
    for (const auto &to : {client.get(), other_client.get()}) {
        to->set(HELD_SPEED, 33333, 777);
        to->set(LOAD_TORQUE, 50000, 1234);
        to->set(HELD_SPEED, FREE, 37123);
    }
    bench.run_to(*client, 50 * MS);
    for (uint64_t i = 1; i <= 137; ++i) {
        other.run_to(*other_client, 50 * MS * i / 137);
    }
    EXPECT_EQ(bench.rig->plant.speed_rad_s, other.rig->plant.speed_rad_s);
    EXPECT_EQ(bench.rig->plant.energy_load_J, other.rig->plant.energy_load_J);
}

} // namespace
