// Comparators of the gate drivers (plant_set_trip).
#include <gtest/gtest.h>

#include <cmath>
#include <cstring>

#include "support/emulator_machines.h"

extern "C" {
#include "plant/plant.h"
#include "plant/pwm_timer.h"
}

namespace {

constexpr uint16_t TICKS = 2500; // 40 kHz
constexpr uint64_t PERIOD_NS = 2 * TICKS * PWM_TIMER_TICK_NS;
constexpr double ALIGNED_H = 23.6e-3, SUPPLY_V = 240.0;

// An aligned phase without resistance: its current rises by V / L, exactly.
class Trip : public testing::Test {
  protected:
    Trip() : machine(machine_of(MAGNETICS_LINEAR_COSINE)) {
        machine.resistance_ohm = 0.0;
        plant_init(&plant, &machine, 0.0);
    }

    void on(uint16_t upper, uint16_t lower) {
        hal_pwm_compare_t compare = {};
        compare.upper[0] = upper;
        compare.lower[0] = lower;
        plant_set_switches(&plant, &compare, TICKS);
    }

    machine_t machine;
    plant_t plant;
};

TEST_F(Trip, switches_open_a_microsecond_after_the_current_exceeds_the_threshold) {
    for (const double start_A : {0.0, 3.0, 49.9, 49.999999}) {
        const double trip_A = 50.0;
        plant_init(&plant, &machine, 0.0);
        plant_set_trip(&plant, trip_A);
        plant.current_A[0] = start_A;
        on(TICKS, TICKS);
        const double exceeded_ns = (trip_A - start_A) * ALIGNED_H / SUPPLY_V * 1e9;
        const auto open_ns = static_cast<uint64_t>(std::ceil(exceeded_ns)) + PLANT_TRIP_RESPONSE_NS;
        plant_advance(&plant, open_ns - 1);
        EXPECT_FALSE(plant.tripped);
        plant_advance(&plant, open_ns + 2);
        EXPECT_TRUE(plant.tripped);
        const double peak_A = trip_A + SUPPLY_V / ALIGNED_H * PLANT_TRIP_RESPONSE_NS * 1e-9;
        EXPECT_NEAR(plant.current_A[0], peak_A, 1e-3);
        plant_advance(&plant, open_ns + 100000);
        EXPECT_NEAR(plant.current_A[0], peak_A - SUPPLY_V / ALIGNED_H * 100e-6, 1e-3) << "the diodes conduct";
    }
}

TEST_F(Trip, freewheeling_current_above_the_threshold_trips_and_a_current_in_the_diodes_does_not) {
    plant_set_trip(&plant, 50.0);
    plant.current_A[0] = 60.0;
    on(0, 0);
    plant_advance(&plant, 10000);
    EXPECT_FALSE(plant.tripped);
    on(TICKS, 0);
    plant_advance(&plant, 10000 + PLANT_TRIP_RESPONSE_NS + 2);
    EXPECT_TRUE(plant.tripped);
}

TEST_F(Trip, after_it_is_cleared_the_next_excess_trips_again) {
    plant_set_trip(&plant, 50.0);
    for (int k = 0; k < 3; k++) {
        plant.current_A[0] = 49.0;
        on(TICKS, TICKS);
        plant_advance(&plant, plant.time_ns + 200000);
        EXPECT_TRUE(plant.tripped);
        plant_clear_trip(&plant);
        EXPECT_FALSE(plant.tripped);
    }
}

TEST_F(Trip, a_threshold_that_no_current_reaches_changes_no_bit) {
    plant_t without;
    plant_init(&without, &machine, 0.0);
    plant_set_trip(&plant, 60.0);
    hal_pwm_compare_t compare = {};
    for (unsigned k = 0; k < 200; k++) {
        compare.upper[k / 50 % 3] = compare.lower[k / 50 % 3] = static_cast<uint16_t>(k * 12);
        for (plant_t *each : {&plant, &without}) {
            plant_set_switches(each, &compare, TICKS);
            plant_advance(each, (k + 1) * PERIOD_NS);
        }
    }
    EXPECT_FALSE(plant.tripped);
    EXPECT_NE(plant.rotor_angle_rad, 0.0) << "the rotor has moved";
    EXPECT_EQ(std::memcmp(plant.current_A, without.current_A, sizeof plant.current_A), 0);
    EXPECT_EQ(plant.rotor_angle_rad, without.rotor_angle_rad);
    EXPECT_EQ(plant.speed_rad_s, without.speed_rad_s);
}

TEST_F(Trip, the_first_of_two_phases_that_exceeds_it_opens_all) {
    plant_set_trip(&plant, 50.0);
    plant.current_A[0] = 49.9;
    plant.current_A[1] = 20.0;
    hal_pwm_compare_t compare = {};
    compare.upper[0] = compare.lower[0] = compare.upper[1] = compare.lower[1] = TICKS;
    plant_set_switches(&plant, &compare, TICKS);
    plant_advance(&plant, PERIOD_NS);
    EXPECT_TRUE(plant.tripped);
    EXPECT_EQ(plant.switches[0] | plant.switches[1] | plant.switches[2], 0);
}

} // namespace
