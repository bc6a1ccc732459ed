#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <vector>

#include "support/emulator_machines.h"

extern "C" {
#include "plant/plant.h"
#include "plant/pwm_timer.h"
}

namespace {

constexpr double RAD_PER_DEG = M_PI / 180.0;
constexpr uint16_t TICKS = 2500; // 40 kHz
constexpr uint64_t PERIOD_NS = 2 * TICKS * PWM_TIMER_TICK_NS;

hal_pwm_compare_t compare_of(std::vector<uint16_t> upper, std::vector<uint16_t> lower) {
    hal_pwm_compare_t compare = {};
    std::copy(upper.begin(), upper.end(), compare.upper);
    std::copy(lower.begin(), lower.end(), compare.lower);
    return compare;
}

// --- Converter: an aligned linear machine without resistance is an inductance; its current slope gives the voltage ---

class Converter : public testing::Test {
  protected:
    Converter() : machine(machine_of(MAGNETICS_LINEAR_COSINE)) {
        machine.resistance_ohm = 0.0;
        plant_init(&plant, &machine, 0.0);
        plant.current_A[0] = 50.0;
    }

    // Changes of the phase voltage, resolved to 1 ns: (first ns, voltage / supply voltage).
    std::vector<std::pair<uint64_t, int>> levels(uint16_t upper, uint16_t lower, uint64_t length_ns = PERIOD_NS) {
        std::vector<std::pair<uint64_t, int>> found;
        const hal_pwm_compare_t compare = compare_of({upper}, {lower});
        plant_set_switches(&plant, &compare, TICKS);
        const uint64_t start_ns = plant.time_ns;
        for (uint64_t ns = 0; ns < length_ns; ns++) {
            const double before_A = plant.current_A[0];
            plant_advance(&plant, start_ns + ns + 1);
            const double volts = (plant.current_A[0] - before_A) * 23.6e-3 / 1e-9;
            const int level = static_cast<int>(std::lround(volts / 240.0));
            EXPECT_NEAR(volts, 240.0 * level, 1e-2 * 240.0); // an edge within a tick would fail here
            if (found.empty() || found.back().second != level) {
                found.emplace_back(ns, level);
            }
        }
        return found;
    }

    using Levels = std::vector<std::pair<uint64_t, int>>;
    machine_t machine;
    plant_t plant;
};

TEST_F(Converter, UpperPulseIsCentredInThePeriod) {
    // 2 * 700 ticks of 5 ns about 12500 ns
    EXPECT_EQ(levels(700, TICKS), (Levels{{0, 0}, {9000, 1}, {16000, 0}}));
}

TEST_F(Converter, LowerPulseIsSplitOverBothEndsOfThePeriod) {
    EXPECT_EQ(levels(TICKS, 700), (Levels{{0, 1}, {3500, 0}, {21500, 1}}));
}

TEST_F(Converter, ZeroIsOffAndTicksOrMoreIsOnForTheWholePeriod) {
    EXPECT_EQ(levels(0, 0), (Levels{{0, -1}}));
    EXPECT_EQ(levels(TICKS, 0), (Levels{{0, 0}}));
    EXPECT_EQ(levels(0, UINT16_MAX), (Levels{{0, 0}}));
    EXPECT_EQ(levels(TICKS, TICKS), (Levels{{0, 1}}));
    EXPECT_EQ(levels(UINT16_MAX, TICKS + 1), (Levels{{0, 1}}));
}

TEST_F(Converter, TwoPartialDutiesInterleave) {
    // Upper on 7000..18000, lower on 0..8000 and 17000..25000: both on twice for 1000 ns.
    EXPECT_EQ(levels(1100, 1600), (Levels{{0, 0}, {7000, 1}, {8000, 0}, {17000, 1}, {18000, 0}}));
    // Without overlap: both off in between.
    EXPECT_EQ(levels(500, 1000), (Levels{{0, 0}, {5000, -1}, {10000, 0}, {15000, -1}, {20000, 0}}));
}

TEST_F(Converter, EdgesThatCoincideActTogether) {
    // The lower opens when the upper closes.
    EXPECT_EQ(levels(1000, 1500), (Levels{{0, 0}}));
}

TEST_F(Converter, SmallestAndLargestPulsesAreTwoTicksWide) {
    EXPECT_EQ(levels(1, TICKS), (Levels{{0, 0}, {12495, 1}, {12505, 0}}));
    EXPECT_EQ(levels(TICKS, 1), (Levels{{0, 1}, {5, 0}, {24995, 1}}));
    EXPECT_EQ(levels(TICKS - 1, TICKS), (Levels{{0, 0}, {5, 1}, {24995, 0}}));
}

TEST_F(Converter, KeepsTheStateAtTheEndOfThePeriod) {
    EXPECT_EQ(levels(TICKS, 700, 2 * PERIOD_NS), (Levels{{0, 1}, {3500, 0}, {21500, 1}}));
    EXPECT_EQ(levels(700, TICKS, 2 * PERIOD_NS), (Levels{{0, 0}, {9000, 1}, {16000, 0}}));
}

TEST_F(Converter, OpenAllActsImmediatelyAndDiscardsTheRestOfThePeriod) {
    const hal_pwm_compare_t compare = compare_of({TICKS}, {700});
    plant_set_switches(&plant, &compare, TICKS);
    plant_advance(&plant, 1001);
    plant_open_all(&plant);
    const double before_A = plant.current_A[0];
    plant_advance(&plant, 2 * PERIOD_NS);
    EXPECT_NEAR(before_A - plant.current_A[0], 240.0 / 23.6e-3 * (2e-9 * PERIOD_NS - 1001e-9), 1e-9);
}

TEST_F(Converter, EveryPhaseHasItsOwnSwitches) {
    machine.inertia_kg_m2 = 1e9; // locked: torque must not turn it
    plant_init(&plant, &machine, 0.0);
    const hal_pwm_compare_t compare = compare_of({TICKS, 900, TICKS}, {300, TICKS, 2000});
    plant_set_switches(&plant, &compare, TICKS);
    plant_advance(&plant, PERIOD_NS);
    const double on_ticks[3] = {600, 1800, 4000};
    for (unsigned phase = 0; phase < 3; phase++) {
        EXPECT_NEAR(plant_flux_linkage_Wb(&plant, phase), 240.0 * on_ticks[phase] * 5e-9, 1e-9) << phase;
    }
}

// --- Machine ---

TEST(Plant, StartsAtRestAtTheSupplyVoltage) {
    const machine_t machine = machine_of(MAGNETICS_SATURATING);
    plant_t plant;
    plant_init(&plant, &machine, 0.5);
    plant_advance(&plant, 1000000);
    EXPECT_EQ(plant.time_ns, 1000000u);
    EXPECT_EQ(plant.rotor_angle_rad, 0.5);
    EXPECT_EQ(plant.speed_rad_s, 0.0);
    EXPECT_EQ(plant.bus_voltage_V, 240.0);
    EXPECT_EQ(plant_torque_Nm(&plant), 0.0);
    plant_advance(&plant, 5); // the past
    EXPECT_EQ(plant.time_ns, 1000000u);
}

TEST(Plant, AlignedLinearPhaseHasTheRlStepResponse) {
    machine_t machine = machine_of(MAGNETICS_LINEAR_COSINE);
    machine.resistance_ohm = 2.0;
    plant_t plant;
    plant_init(&plant, &machine, 0.0);
    const hal_pwm_compare_t compare = compare_of({TICKS}, {TICKS});
    plant_set_switches(&plant, &compare, TICKS);
    for (unsigned ms = 1; ms <= 20; ms++) {
        plant_advance(&plant, ms * 1000000u);
        EXPECT_NEAR(plant.current_A[0], 120.0 * -std::expm1(-2.0 / 23.6e-3 * ms * 1e-3), 1e-9);
    }
    EXPECT_EQ(plant.speed_rad_s, 0.0);
}

TEST(Plant, ResistanceOfEachWindingIsThatOfCopperAtItsTemperature) {
    machine_t machine = machine_of(MAGNETICS_LINEAR_COSINE);
    machine.resistance_ohm = 2.0;
    for (const auto &[temperature_C, factor] : {std::pair{-40.0, 0.75}, {25.0, 1.0}, {155.0, 1.5}}) {
        plant_t plant;
        plant_init(&plant, &machine, 0.0);
        const double temperatures_C[HAL_PHASES_MAX] = {temperature_C, 300.0, -100.0, 25.0};
        plant_set_winding_temperatures(&plant, temperatures_C);
        const plant_gains_t gains = {1.0, 1.1, 1.0, 1.0};
        plant_set_gains(&plant, &gains); // both hold
        const hal_pwm_compare_t compare = compare_of({TICKS}, {TICKS});
        plant_set_switches(&plant, &compare, TICKS);
        plant_advance(&plant, 20000000u);
        const double ohm = 1.1 * 2.0 * factor;
        EXPECT_NEAR(plant.current_A[0], 240.0 / ohm * -std::expm1(-ohm / 23.6e-3 * 20e-3), 1e-8) << temperature_C;
        const double drawn_J = plant.energy_drawn_J - plant_field_energy_J(&plant);
        EXPECT_NEAR(plant.energy_copper_J, drawn_J, 1e-6 * drawn_J) << temperature_C;
    }
}

TEST(Plant, CoastsUnderFrictionAndLoad) {
    const machine_t machine = machine_of(MAGNETICS_SATURATING);
    plant_t plant;
    plant_init(&plant, &machine, 0.0);
    plant.speed_rad_s = 60.0;
    plant.load_torque_Nm = 3.0;
    plant_advance(&plant, 100000000);
    // J w' = -B w - T: towards -T / B
    const double rate_1_s = 0.02 / 0.02;
    EXPECT_NEAR(plant.speed_rad_s, -150.0 + 210.0 * std::exp(-rate_1_s * 0.1), 1e-10);
    EXPECT_NEAR(plant.rotor_angle_rad, -15.0 + 210.0 / rate_1_s * -std::expm1(-rate_1_s * 0.1), 1e-10);
    EXPECT_NEAR(plant.energy_load_J, 3.0 * plant.rotor_angle_rad, 1e-9);
}

TEST(Plant, FastWindingAndFastRotorStayAccurate) {
    machine_t machine = machine_of(MAGNETICS_LINEAR_COSINE);
    machine.resistance_ohm = 100.0; // 6.8 us unaligned: a step of one period would be unstable
    machine.inertia_kg_m2 = 1e-4;
    machine.friction_Nm_s = 2.0; // 50 us
    plant_t plant;
    plant_init(&plant, &machine, M_PI / 4.0);
    const hal_pwm_compare_t compare = compare_of({TICKS}, {TICKS});
    plant_set_switches(&plant, &compare, TICKS);
    for (unsigned period = 1; period <= 4; period++) {
        plant_advance(&plant, period * PERIOD_NS);
        const double time_s = 1e-9 * period * PERIOD_NS;
        EXPECT_NEAR(plant.current_A[0], 2.4 * -std::expm1(-100.0 / 0.676e-3 * time_s), 2e-7 * 2.4);
    }
    plant_init(&plant, &machine, 0.0);
    plant.speed_rad_s = 100.0;
    plant_advance(&plant, 100000);
    EXPECT_NEAR(plant.speed_rad_s, 100.0 * std::exp(-2.0), 1e-5);
}

TEST(Plant, PhaseWithoutCurrentStaysOpen) {
    const machine_t machine = machine_of(MAGNETICS_SATURATING);
    plant_t plant;
    plant_init(&plant, &machine, 0.0);
    plant.speed_rad_s = 100.0;
    const hal_pwm_compare_t one_switch = compare_of({TICKS, TICKS, 0}, {0, 0, TICKS});
    for (unsigned period = 0; period < 400; period++) {
        plant_set_switches(&plant, &one_switch, TICKS);
        plant_advance(&plant, plant.time_ns + PERIOD_NS);
        for (const double current_A : plant.current_A) {
            ASSERT_EQ(current_A, 0.0);
        }
    }
    EXPECT_EQ(plant.energy_drawn_J, 0.0);
}

TEST(Plant, CurrentEndsWhenTheVoltSecondsAreUsedUp) {
    machine_t machine = machine_of(MAGNETICS_SATURATING);
    machine.resistance_ohm = 0.0;
    machine.inertia_kg_m2 = 1e9;
    for (const uint64_t driven_ns : {7u, 1000u, 123457u, 400001u}) {
        plant_t plant;
        plant_init(&plant, &machine, 70.0 * RAD_PER_DEG);
        const hal_pwm_compare_t compare =
            compare_of({TICKS, TICKS}, {TICKS, TICKS}); // the second current ends in the same way
        plant_set_switches(&plant, &compare, TICKS);
        plant_advance(&plant, driven_ns);
        EXPECT_NEAR(plant_flux_linkage_Wb(&plant, 0), 240e-9 * static_cast<double>(driven_ns), 1e-9);
        plant_open_all(&plant);
        plant_advance(&plant, 2 * driven_ns - 1);
        EXPECT_GT(plant.current_A[0], 0.0);
        EXPECT_GT(plant.current_A[1], 0.0);
        plant_advance(&plant, 2 * driven_ns + 1);
        EXPECT_EQ(plant.current_A[0], 0.0);
        EXPECT_EQ(plant.current_A[1], 0.0);
        EXPECT_NEAR(plant.energy_returned_J, plant.energy_drawn_J, 1e-6 * plant.energy_drawn_J);
        plant_advance(&plant, 10 * driven_ns);
        EXPECT_EQ(plant.current_A[0], 0.0);
    }
}

// At the end of the current the DC link is exactly at the voltage at which the rectifier starts to conduct: the whole
// charge must reach the capacitor.
TEST(Plant, CurrentThatEndsWithinAStepChargesALinkAtItsSupply) {
    machine_t machine = machine_of(MAGNETICS_SATURATING);
    machine.dc_link.capacitance_F = 2.2e-3;
    machine.dc_link.source_resistance_ohm = 0.2;
    plant_t plant;
    plant_init(&plant, &machine, 45.0 * M_PI / 180.0);
    plant.current_A[0] = 1.0;
    plant_advance(&plant, 25000);
    const double charge_As = 0.67e-3 / (2.0 * 240.0);
    EXPECT_EQ(plant.current_A[0], 0.0);
    EXPECT_NEAR(plant.bus_voltage_V - 240.0, charge_As / 2.2e-3, 1e-3 * charge_As / 2.2e-3);
}

TEST(Plant, CurrentsDecayWithoutDcLinkVoltage) {
    const machine_t machine = machine_of(MAGNETICS_SATURATING);
    plant_t plant;
    plant_init(&plant, &machine, 1.0);
    plant_set_supply_voltage(&plant, 0.0);
    plant.current_A[0] = 10.0;
    const hal_pwm_compare_t compare = compare_of({TICKS, TICKS}, {TICKS, TICKS});
    plant_set_switches(&plant, &compare, TICKS);
    for (unsigned ms = 1; ms < 20; ms++) {
        const double flux_Wb = plant_flux_linkage_Wb(&plant, 0);
        plant_advance(&plant, ms * 1000000u);
        EXPECT_LT(plant_flux_linkage_Wb(&plant, 0), flux_Wb);
        EXPECT_GT(plant.current_A[0], 0.0);
        EXPECT_EQ(plant.current_A[1], 0.0);
    }
}

TEST(Plant, TorqueAndFluxLinkageAreThoseOfTheMagneticsAtTheRotorAngle) {
    const machine_t machine = machine_of(MAGNETICS_SATURATING);
    magnetics_model_t model;
    magnetics_prepare(&model, &machine.magnetics, machine.rotor_poles);
    plant_t plant;
    plant_init(&plant, &machine, 1.1);
    double torque_Nm = 0.0;
    for (unsigned phase = 0; phase < 3; phase++) {
        plant.current_A[phase] = 5.0 + phase;
        magnetics_point_t point;
        magnetics_evaluate(&model, 1.1 - phase * 30.0 * RAD_PER_DEG, 5.0 + phase, &point);
        torque_Nm += point.torque_Nm;
        EXPECT_NEAR(plant_flux_linkage_Wb(&plant, phase), point.flux_linkage_Wb, 1e-15);
        EXPECT_NEAR(plant_phase_angle_rad(&plant, phase), 1.1 - phase * 30.0 * RAD_PER_DEG, 1e-15);
    }
    EXPECT_NEAR(plant_torque_Nm(&plant), torque_Nm, 1e-13);
}

// --- Operating cycle: start, chopping, braking, at speed ---

struct Energies {
    double turnover_J, missing_J;
};

double stored_J(const plant_t &plant) {
    return plant_field_energy_J(&plant) + plant_kinetic_energy_J(&plant);
}

// Simple controller that covers all operating modes: motoring with two pulses per period, and braking, both at varying
// speed.
Energies live(plant_t &plant, unsigned periods) {
    const plant_t before = plant;
    for (unsigned period = 0; period < periods; period++) {
        hal_pwm_compare_t compare = {};
        const bool braking = period % 4000 > 2600;
        for (unsigned phase = 0; phase < 3; phase++) {
            const double angle_deg = std::fmod(plant_phase_angle_rad(&plant, phase) / RAD_PER_DEG + 9e4, 90.0);
            const double from_deg = braking ? 5.0 : 46.0;
            if (angle_deg >= from_deg && angle_deg < from_deg + 30.0) {
                compare.upper[phase] = static_cast<uint16_t>(2100 + (period * 37) % 500);
                compare.lower[phase] = plant.current_A[phase] > 40.0 ? 0 : static_cast<uint16_t>(900 + period % 700);
            }
        }
        plant_set_switches(&plant, &compare, TICKS);
        plant.load_torque_Nm = period > 3000 ? 4.0 : 0.0;
        plant_set_supply_voltage(&plant, period % 1000 > 500 ? 240.0 : 210.0);
        plant_advance(&plant, plant.time_ns + PERIOD_NS);
    }
    const auto change = [&](double plant_t::*energy_J) { return plant.*energy_J - before.*energy_J; };
    const double drawn_J = change(&plant_t::energy_drawn_J), returned_J = change(&plant_t::energy_returned_J);
    const double spent_J =
        change(&plant_t::energy_copper_J) + change(&plant_t::energy_load_J) + change(&plant_t::energy_friction_J);
    return {drawn_J + returned_J, drawn_J - returned_J - spent_J - (stored_J(plant) - stored_J(before))};
}

class OperatingCycle : public testing::TestWithParam<magnetics_form_t> {
  protected:
    OperatingCycle() : machine(machine_of(GetParam())) { plant_init(&plant, &machine, 0.9); }
    const machine_t machine;
    plant_t plant;
};

INSTANTIATE_TEST_SUITE_P(Forms, OperatingCycle,
                         testing::Values(MAGNETICS_LINEAR_COSINE, MAGNETICS_LINEAR_TRAPEZOID, MAGNETICS_SATURATING),
                         [](const auto &form) { return form_name(form.param); });

TEST_P(OperatingCycle, ConservesEnergy) {
    const Energies energies = live(plant, 12000);
    EXPECT_GT(energies.turnover_J, 100.0);
    EXPECT_GT(plant.energy_returned_J, 10.0);
    EXPECT_GT(std::fabs(plant.rotor_angle_rad), 2.0 * M_PI);
    EXPECT_LT(std::fabs(energies.missing_J), 2e-8 * energies.turnover_J)
        << energies.missing_J << " J of " << energies.turnover_J << " J";
}

TEST_P(OperatingCycle, ConservesEnergyWhileADynamometerHoldsTheShaft) {
    for (const double speed_rad_s : {-60.0, 15.0, 150.0}) {
        for (const double acceleration_rad_s2 : {-400.0, 0.0, 400.0}) {
            plant_init(&plant, &machine, 0.9);
            plant_hold(&plant, speed_rad_s, acceleration_rad_s2);
            const Energies energies = live(plant, 12000);
            const double duration_s = static_cast<double>(plant.time_ns) * 1e-9;
            EXPECT_NEAR(plant.speed_rad_s, speed_rad_s + acceleration_rad_s2 * duration_s, 1e-9);
            EXPECT_GT(energies.turnover_J, 10.0);
            EXPECT_GT(std::fabs(plant.energy_load_J), 1.0);
            EXPECT_LT(std::fabs(energies.missing_J), 2e-7 * energies.turnover_J)
                << energies.missing_J << " J of " << energies.turnover_J << " J";
        }
    }
}

TEST(Plant, ShaftTorqueIsWhatTheDynamometerTakes) {
    machine_t machine = machine_of(MAGNETICS_SATURATING);
    plant_t plant;
    plant_init(&plant, &machine, -20.0 * RAD_PER_DEG);
    plant.current_A[0] = 20.0;
    plant.load_torque_Nm = 2.5;
    EXPECT_EQ(plant_shaft_torque_Nm(&plant), 2.5) << "a free shaft";
    plant_hold(&plant, 100.0, 50.0);
    const double taken_Nm = plant_torque_Nm(&plant) - machine.friction_Nm_s * 100.0 - machine.inertia_kg_m2 * 50.0;
    EXPECT_GT(plant_torque_Nm(&plant), 1.0);
    EXPECT_NEAR(plant_shaft_torque_Nm(&plant), taken_Nm, 1e-12) << "the load is a part of it";
    plant_release(&plant);
    EXPECT_EQ(plant.speed_rad_s, 100.0);
    EXPECT_EQ(plant_shaft_torque_Nm(&plant), 2.5);
}

TEST_P(OperatingCycle, EqualInputsGiveEqualBits) {
    live(plant, 2000);
    plant_t again;
    plant_init(&again, &machine, 0.9);
    live(again, 2000);
    EXPECT_EQ(std::memcmp(plant.current_A, again.current_A, sizeof plant.current_A), 0);
    EXPECT_EQ(plant.rotor_angle_rad, again.rotor_angle_rad);
    EXPECT_EQ(plant.speed_rad_s, again.speed_rad_s);
    EXPECT_EQ(plant.energy_drawn_J, again.energy_drawn_J);
}

// --- Gains on the values of the machine file ---

TEST_P(OperatingCycle, GainsAreEquivalentToAScaledMachineFile) {
    machine_t other = machine;
    other.magnetics.unaligned_inductance_H *= 1.1;
    other.magnetics.aligned_inductance_H *= 1.1;
    other.magnetics.saturated_inductance_H *= 1.1;
    other.magnetics.flux_linkage_max_Wb *= 1.1;
    other.resistance_ohm *= 1.5;
    other.inertia_kg_m2 *= 0.5;
    other.friction_Nm_s *= 3.0;
    plant_t of_file;
    plant_init(&of_file, &other, 0.9);
    const plant_gains_t gains = {1.1, 1.5, 0.5, 3.0};
    plant_set_gains(&plant, &gains);
    live(plant, 2000);
    live(of_file, 2000);
    // Equal except for rounding, whose effect grows over a cycle of this length.
    EXPECT_NEAR(plant.speed_rad_s, of_file.speed_rad_s, 1e-7);
    EXPECT_NEAR(plant.rotor_angle_rad, of_file.rotor_angle_rad, 1e-9);
    EXPECT_NEAR(plant.energy_copper_J, of_file.energy_copper_J, 1e-7);
    EXPECT_NEAR(plant.energy_friction_J, of_file.energy_friction_J, 1e-7);
    EXPECT_NEAR(stored_J(plant), stored_J(of_file), 1e-7);
    EXPECT_GT(plant.energy_friction_J, 0.01);
}

TEST_P(OperatingCycle, GainsOfOneChangeNoBit) {
    plant_t untouched = plant;
    const plant_gains_t other = {1.3, 0.7, 2.0, 0.0}, one = {1.0, 1.0, 1.0, 1.0};
    plant_set_gains(&plant, &other);
    plant_set_gains(&plant, &one);
    EXPECT_EQ(std::memcmp(&plant, &untouched, sizeof plant), 0);
}

TEST_P(OperatingCycle, ConservesEnergyBetweenChangesOfTheMachine) {
    live(plant, 3000);
    for (const plant_gains_t gains : {plant_gains_t{1.1, 1.0, 1.0, 1.0}, plant_gains_t{1.1, 2.0, 0.3, 1.0},
                                      plant_gains_t{0.7, 0.5, 1.0, 5.0}, plant_gains_t{1.0, 1.0, 3.0, 0.0}}) {
        const double field_J = plant_field_energy_J(&plant), kinetic_J = plant_kinetic_energy_J(&plant);
        const double before = plant.gains.inertia, flux_Wb = plant_flux_linkage_Wb(&plant, 1);
        const double flux_before = plant.gains.flux_linkage;
        ASSERT_GT(field_J, 1e-3);
        ASSERT_GT(kinetic_J, 0.01);
        plant_set_gains(&plant, &gains);
        EXPECT_NEAR(plant_kinetic_energy_J(&plant), kinetic_J * gains.inertia / before, 1e-12 * kinetic_J);
        EXPECT_NEAR(plant_field_energy_J(&plant), field_J * gains.flux_linkage / flux_before, 1e-12 * field_J);
        EXPECT_NEAR(plant_flux_linkage_Wb(&plant, 1), flux_Wb * gains.flux_linkage / flux_before, 1e-12);
        const Energies energies = live(plant, 3000);
        EXPECT_GT(energies.turnover_J, 50.0);
        EXPECT_LT(std::fabs(energies.missing_J), 1e-7 * energies.turnover_J);
    }
}

// --- Observation ---

struct Watch {
    std::vector<uint64_t> times_ns;
    std::vector<double> angles_rad;
};

void watch(void *context, const plant_t *plant) {
    auto *seen = static_cast<Watch *>(context);
    seen->times_ns.push_back(plant->time_ns);
    seen->angles_rad.push_back(plant->rotor_angle_rad);
}

TEST_P(OperatingCycle, ObservationChangesNoBit) {
    Watch seen;
    plant_observe(&plant, 0, 777, watch, &seen);
    live(plant, 2000);
    plant_t unwatched;
    plant_init(&unwatched, &machine, 0.9);
    live(unwatched, 2000);
    EXPECT_EQ(seen.times_ns.size(), 2000 * PERIOD_NS / 777 + 1);
    EXPECT_EQ(std::memcmp(plant.current_A, unwatched.current_A, sizeof plant.current_A), 0);
    EXPECT_EQ(plant.rotor_angle_rad, unwatched.rotor_angle_rad);
    EXPECT_EQ(plant.speed_rad_s, unwatched.speed_rad_s);
}

TEST(PlantObserve, SamplesExactlyOnItsGrid) {
    const machine_t machine = machine_of(MAGNETICS_SATURATING);
    plant_t plant;
    plant_init(&plant, &machine, 0.0);
    plant.speed_rad_s = 10.0;
    Watch seen;
    plant_observe(&plant, 300, 1000, watch, &seen);
    plant_advance(&plant, 299);
    EXPECT_TRUE(seen.times_ns.empty());
    plant_advance(&plant, 300);
    EXPECT_EQ(seen.times_ns.size(), 1u);
    plant_advance(&plant, 300);
    plant_advance(&plant, 25000);
    ASSERT_EQ(seen.times_ns.size(), 25u);
    for (unsigned n = 0; n < 25; n++) {
        EXPECT_EQ(seen.times_ns[n], 300 + 1000 * n);
        const double time_s = 1e-9 * static_cast<double>(seen.times_ns[n]);
        EXPECT_NEAR(seen.angles_rad[n], 10.0 * -std::expm1(-time_s), 1e-14);
    }
}

void expect_switches_of_the_pattern(void *context, const plant_t *plant) {
    ++*static_cast<unsigned *>(context);
    const half_bridge_pattern_t &pattern = plant->pattern[0];
    unsigned switches = pattern.first;
    for (unsigned edge = 0; edge < pattern.count; edge++) {
        switches = plant->time_ns >= plant->pattern_ns + pattern.delay_ns[edge] ? pattern.switches[edge] : switches;
    }
    EXPECT_EQ(plant->switches[0], switches) << plant->time_ns;
}

TEST(PlantObserve, SamplesHaveTheSwitchesOfTheirTime) {
    const machine_t machine = machine_of(MAGNETICS_SATURATING);
    plant_t plant;
    plant_init(&plant, &machine, 0.3);
    const hal_pwm_compare_t compare = {.upper = {2}, .lower = {1500}};
    unsigned samples = 0;
    plant_observe(&plant, 100, 330, expect_switches_of_the_pattern, &samples);
    for (unsigned period = 0; period < 10; period++) {
        plant_set_switches(&plant, &compare, TICKS);
        ASSERT_GT(plant.pattern[0].count, 1u);
        plant_advance(&plant, plant.time_ns + PERIOD_NS);
    }
    EXPECT_GT(samples, 10 * PERIOD_NS / 330 - 2);
}

TEST(PlantObserve, StartInThePastContinuesOnTheGridAndStepZeroStops) {
    const machine_t machine = machine_of(MAGNETICS_SATURATING);
    plant_t plant;
    plant_init(&plant, &machine, 0.0);
    plant_advance(&plant, 10500);
    Watch seen;
    plant_observe(&plant, 200, 1000, watch, &seen);
    plant_advance(&plant, 12500);
    EXPECT_EQ(seen.times_ns, (std::vector<uint64_t>{11200, 12200}));
    plant_observe(&plant, 0, 0, watch, &seen);
    plant_advance(&plant, 30000);
    EXPECT_EQ(seen.times_ns.size(), 2u);
    plant_observe(&plant, 30000, 5000, watch, &seen); // the present belongs to the next advance
    plant_advance(&plant, 30001);
    EXPECT_EQ(seen.times_ns.back(), 30000u);
}

} // namespace
