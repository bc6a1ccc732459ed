// Non-ideal converter: voltage drops of the devices, suppressed short pulses, a DC link charged by regeneration.

#include <gtest/gtest.h>

#include <cmath>

#include "support/emulator_machines.h"

extern "C" {
#include "plant/plant.h"
#include "plant/pwm_timer.h"
}

namespace {

constexpr uint16_t TICKS = 2500; // 40 kHz
constexpr uint64_t PERIOD_NS = 2 * TICKS * PWM_TIMER_TICK_NS;
constexpr double ALIGNED_H = 23.6e-3;

void set_switches(plant_t &plant, uint16_t upper, uint16_t lower, unsigned phase = 0) {
    hal_pwm_compare_t compare = {};
    compare.upper[phase] = upper;
    compare.lower[phase] = lower;
    plant_set_switches(&plant, &compare, TICKS);
}

// --- Devices. An aligned linear phase with a locked rotor is an inductance: its current slope gives the voltage. ---

class Devices : public testing::Test {
  protected:
    Devices() : machine(machine_of(MAGNETICS_LINEAR_COSINE)) {
        machine.resistance_ohm = 0.0;
        machine.inertia_kg_m2 = 1e9;
        machine.converter = {1.5, 0.02, 0.9, 0.01, 0.0};
        plant_init(&plant, &machine, 0.0);
        plant.current_A[0] = 50.0;
    }

    double voltage_V(uint16_t upper, uint16_t lower) {
        set_switches(plant, upper, lower);
        const double before_A = plant.current_A[0];
        plant_advance(&plant, plant.time_ns + 100);
        return (plant.current_A[0] - before_A) * ALIGNED_H / 100e-9;
    }

    machine_t machine;
    plant_t plant;
};

TEST_F(Devices, BothSwitchesReduceTheSupplyVoltage) {
    EXPECT_NEAR(voltage_V(TICKS, TICKS), 240.0 - 2.0 * (1.5 + 0.02 * 50.0), 1e-2);
}

TEST_F(Devices, FreewheelingCurrentFlowsThroughASwitchAndADiode) {
    EXPECT_NEAR(voltage_V(TICKS, 0), -(1.5 + 0.02 * 50.0) - (0.9 + 0.01 * 50.0), 1e-3);
    EXPECT_NEAR(voltage_V(0, TICKS), -(1.5 + 0.02 * 50.0) - (0.9 + 0.01 * 50.0), 1e-3);
}

TEST_F(Devices, BothDiodesAddToTheSupplyVoltage) {
    EXPECT_NEAR(voltage_V(0, 0), -240.0 - 2.0 * (0.9 + 0.01 * 50.0), 1e-2);
}

TEST_F(Devices, FreewheelingEndsAtZeroAndItsEnergyIsDissipatedInTheDevices) {
    plant.current_A[0] = 2.0;
    const double field_J = plant_field_energy_J(&plant);
    set_switches(plant, TICKS, 0);
    plant_advance(&plant, 100000000);
    EXPECT_EQ(plant.current_A[0], 0.0);
    EXPECT_NEAR(plant.energy_converter_J, field_J, 1e-7 * field_J);
    EXPECT_EQ(plant.energy_drawn_J, 0.0);
    EXPECT_EQ(plant.energy_returned_J, 0.0);
    EXPECT_EQ(plant.energy_copper_J, 0.0);
}

TEST_F(Devices, DrivenCurrentFollowsTheRlStepResponse) {
    // i' = (V - 2 Vt - 2 r i) / L from zero: exponential step response.
    plant.current_A[0] = 0.0;
    set_switches(plant, TICKS, TICKS);
    plant_advance(&plant, 5000000);
    const double resistance_ohm = 2 * 0.02, drive_V = 240.0 - 2 * 1.5;
    EXPECT_NEAR(plant.current_A[0], drive_V / resistance_ohm * -std::expm1(-5e-3 * resistance_ohm / ALIGNED_H), 1e-9);
}

// --- Pulses ---

struct Pattern : half_bridge_pattern_t {
    Pattern(uint16_t upper, uint16_t lower, double minimum_ns) {
        half_bridge_pattern(this, upper, lower, TICKS, half_bridge_shortest_ticks(minimum_ns));
    }
};

TEST(MinimumPulse, ShorterPulseOfTheUpperSwitchIsSuppressed) {
    EXPECT_EQ(Pattern(19, 0, 200.0).count, 0u); // 190 ns
    EXPECT_EQ(Pattern(19, 0, 200.0).first & HALF_BRIDGE_UPPER, 0u);
    const Pattern shortest(20, 0, 200.0); // 200 ns
    ASSERT_EQ(shortest.count, 2u);
    EXPECT_EQ(shortest.delay_ns[1] - shortest.delay_ns[0], 200u);
}

TEST(MinimumPulse, ShorterGapOfTheUpperSwitchIsSuppressed) {
    EXPECT_EQ(Pattern(TICKS - 19, 0, 200.0).count, 0u);
    EXPECT_EQ(Pattern(TICKS - 19, 0, 200.0).first & HALF_BRIDGE_UPPER, HALF_BRIDGE_UPPER);
    EXPECT_EQ(Pattern(TICKS - 20, 0, 200.0).count, 2u);
}

TEST(MinimumPulse, LowerSwitchFollowsTheSameRuleWithinThePeriod) {
    EXPECT_EQ(Pattern(0, 19, 200.0).count, 0u);
    EXPECT_EQ(Pattern(0, 19, 200.0).first & HALF_BRIDGE_LOWER, 0u);
    EXPECT_EQ(Pattern(0, 20, 200.0).count, 2u);
    EXPECT_EQ(Pattern(0, TICKS - 19, 200.0).count, 0u);
    EXPECT_EQ(Pattern(0, TICKS - 19, 200.0).first & HALF_BRIDGE_LOWER, HALF_BRIDGE_LOWER);
}

TEST(MinimumPulse, ZeroKeepsTheShortestPulseOfTheTimer) {
    EXPECT_EQ(Pattern(1, 0, 0.0).count, 2u);
    EXPECT_EQ(Pattern(TICKS - 1, 0, 0.0).count, 2u);
    EXPECT_EQ(Pattern(0, 0, 0.0).count, 0u);
    EXPECT_EQ(Pattern(TICKS, TICKS, 0.0).count, 0u);
}

// --- Link ---

class Link : public testing::Test {
  protected:
    Link() : machine(machine_of(MAGNETICS_LINEAR_COSINE)) {
        machine.inertia_kg_m2 = 1e9;
        machine.resistance_ohm = 0.05;
        machine.dc_link = {1e-3, 0.5, 0.0, 0.0, 0.0};
    }

    void start(double current_A) {
        plant_init(&plant, &machine, 0.0);
        plant.current_A[0] = current_A;
        field_J = plant_field_energy_J(&plant);
        link_J = plant_link_energy_J(&plant);
    }

    // Residuals of both energy balances, J.
    double residual_J() const {
        const double net_J = plant.energy_drawn_J - plant.energy_returned_J;
        const double machine_J =
            net_J - plant.energy_copper_J - plant.energy_converter_J - (plant_field_energy_J(&plant) - field_J);
        const double supply_J = plant.energy_supplied_J - plant.energy_source_J - plant.energy_chopper_J - net_J -
                                (plant_link_energy_J(&plant) - link_J);
        return std::fabs(machine_J) + std::fabs(supply_J);
    }

    machine_t machine;
    plant_t plant;
    double field_J, link_J;
};

TEST_F(Link, ReturnedCurrentChargesItWithTheFieldEnergy) {
    machine.resistance_ohm = 1e-9;
    start(20.0);
    set_switches(plant, 0, 0);
    plant_advance(&plant, 20000000);
    EXPECT_EQ(plant.current_A[0], 0.0);
    EXPECT_NEAR(0.5e-3 * (plant.bus_voltage_V * plant.bus_voltage_V - 240.0 * 240.0), field_J, 1e-7 * field_J);
    EXPECT_GT(plant.bus_voltage_V, 258.0);
    EXPECT_EQ(plant.energy_supplied_J, 0.0);
    const double pumped_V = plant.bus_voltage_V;
    plant_advance(&plant, 1000000000);
    EXPECT_EQ(plant.bus_voltage_V, pumped_V) << "the supply is unidirectional";
}

TEST_F(Link, DrawnCurrentDischargesItAndTheSupplyRecharges) {
    start(0.0);
    set_switches(plant, TICKS, TICKS);
    plant_advance(&plant, 3000000);
    EXPECT_LT(plant.bus_voltage_V, 240.0 - 0.5 * 0.8 * plant.current_A[0]);
    EXPECT_GT(plant.bus_voltage_V, 240.0 - 0.5 * plant.current_A[0]);
    EXPECT_LT(residual_J(), 1e-8 * plant.energy_drawn_J);
    // While the phase freewheels, the link recovers to the supply voltage through the source resistance.
    const double sag_V = 240.0 - plant.bus_voltage_V;
    set_switches(plant, TICKS, 0);
    plant_advance(&plant, 3000000 + 500000);
    EXPECT_NEAR(240.0 - plant.bus_voltage_V, sag_V * std::exp(-0.5e-3 / (0.5 * 1e-3)), 1e-6 * sag_V);
}

TEST_F(Link, ChopperKeepsItBetweenItsThresholds) {
    machine.dc_link = {0.2e-3, 0.5, 20.0, 280.0, 270.0};
    start(60.0);
    set_switches(plant, 0, 0);
    double highest_V = 0.0;
    bool was_on = false;
    for (unsigned us = 1; us <= 20000; us++) {
        plant_advance(&plant, us * 1000u);
        highest_V = std::fmax(highest_V, plant.bus_voltage_V);
        was_on = was_on || plant.chopper_on;
    }
    // 60 A into a chopper that draws 14 A at 280 V: the voltage rises above, and falls to 270 V when the current has
    // ended.
    EXPECT_TRUE(was_on);
    EXPECT_FALSE(plant.chopper_on);
    EXPECT_GT(highest_V, 281.0);
    EXPECT_LT(highest_V, 600.0);
    EXPECT_DOUBLE_EQ(plant.bus_voltage_V, 270.0);
    EXPECT_GT(plant.energy_chopper_J, 0.5 * field_J);
    EXPECT_LT(residual_J(), 1e-8 * field_J);
}

TEST_F(Link, ChopperThatDrawsMoreThanIsReturnedSwitchesOnAndOff) {
    machine.dc_link = {0.2e-3, 0.5, 5.0, 280.0, 270.0};
    start(40.0);
    set_switches(plant, 0, 0);
    unsigned changes = 0;
    double highest_V = 0.0;
    for (unsigned us = 1; us <= 3000; us++) {
        const bool before = plant.chopper_on;
        plant_advance(&plant, us * 1000u);
        changes += before != plant.chopper_on;
        highest_V = std::fmax(highest_V, plant.bus_voltage_V);
    }
    EXPECT_GE(changes, 6u);
    EXPECT_LE(highest_V, 280.0 + 1e-6) << "switches at its threshold at any step length";
    EXPECT_LT(residual_J(), 1e-8 * field_J);
}

TEST_F(Link, SupplyVoltageMayChangeDuringOperation) {
    start(0.0);
    plant_set_supply_voltage(&plant, 200.0);
    plant_advance(&plant, 1000000);
    EXPECT_EQ(plant.bus_voltage_V, 240.0) << "nothing discharges the capacitor";
    plant_set_supply_voltage(&plant, 260.0);
    plant_advance(&plant, 11000000);
    EXPECT_NEAR(plant.bus_voltage_V, 260.0, 1e-6);
    EXPECT_LT(residual_J(), 5e-8 * plant.energy_supplied_J);
}

TEST_F(Link, WithoutACapacitorItIsAtTheSupplyVoltage) {
    machine.dc_link = {};
    start(20.0);
    set_switches(plant, 0, 0);
    plant_advance(&plant, 1000000);
    EXPECT_EQ(plant.bus_voltage_V, 240.0);
    plant_set_supply_voltage(&plant, 100.0);
    EXPECT_EQ(plant.bus_voltage_V, 100.0);
    EXPECT_GT(plant.energy_returned_J, 0.0);
    EXPECT_EQ(plant_link_energy_J(&plant), 0.0);
}

} // namespace
