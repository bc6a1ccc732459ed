// The reference model of the controller in the units of other machines. Machine: saturating.
#include <algorithm>
#include <cmath>
#include <cstddef>

#include <gtest/gtest.h>

#include "support/closed_loop.h"

namespace {

using closed_loop::Bench;
using closed_loop::reference_drive_t;
using closed_loop::setup_t;
using reference_model::observer_t;
using reference_model::units_t;

// With `units.current_A` times the current and `units.voltage_V` times the voltage, at the same angles and times.
machine_t similar_machine(const units_t &units) {
    const double ohm = units.voltage_V / units.current_A;
    machine_t machine = machine_plant;
    machine.resistance_ohm *= ohm;
    machine.inertia_kg_m2 *= units.torque_Nm;
    machine.friction_Nm_s *= units.torque_Nm;
    machine.supply_voltage_V *= units.voltage_V;
    machine.magnetics.unaligned_inductance_H *= ohm;
    machine.magnetics.aligned_inductance_H *= ohm;
    machine.magnetics.saturated_inductance_H *= ohm;
    machine.magnetics.flux_linkage_max_Wb *= units.voltage_V;
    machine.magnetics.current_at_flux_linkage_max_A *= units.current_A;
    machine.sensors.current_limit_A *= units.current_A;
    machine.ranges.current_A *= units.current_A;
    machine.ranges.dc_link_V *= units.voltage_V;
    machine.ranges.load_torque_Nm *= units.torque_Nm;
    return machine;
}

TEST(SalientReference, on_a_similar_machine_in_its_units_differs_by_the_unit_of_torque_only) {
    ASSERT_NE(machine_plant.magnetics.form, MAGNETICS_MAP);
    for (const units_t units : {units_t{.current_A = 4.0, .voltage_V = 2.0, .torque_Nm = 8.0},
                                units_t{.current_A = 0.25, .voltage_V = 0.125, .torque_Nm = 0.03125}}) {
        const machine_t machine = similar_machine(units);
        setup_t setup;
        Bench<reference_drive_t> bench(setup);
        setup.machine = &machine;
        setup.units = units;
        Bench<reference_drive_t> similar(setup);
        bench.reference_rpm = similar.reference_rpm = 150.0;
        for (const double load_Nm : {0.0, 8.0}) {
            bench.plant.load_torque_Nm = load_Nm;
            similar.plant.load_torque_Nm = load_Nm * units.torque_Nm;
            const double to_s = bench.now_s() + 0.04;
            bench.run_until(to_s);
            similar.run_until(to_s);
        }
        double largest_Nm = 0.0;
        ASSERT_EQ(bench.trace.torque_Nm.size(), similar.trace.torque_Nm.size());
        for (size_t i = 0; i < bench.trace.torque_Nm.size(); i++) {
            ASSERT_NEAR(similar.trace.torque_Nm[i] / units.torque_Nm, bench.trace.torque_Nm[i], 1e-6) << i;
            ASSERT_NEAR(similar.trace.speed_rad_s[i], bench.trace.speed_rad_s[i], 1e-6) << i;
            largest_Nm = std::max(largest_Nm, bench.trace.torque_Nm[i]);
        }
        EXPECT_GT(largest_Nm, 15.0);
    }
}

TEST(SalientReference, observer_estimates_the_same_in_another_unit_of_speed) {
    constexpr double UNIT = 8.0; // rad/s; inertia and friction are in 1 / UNIT of kg m^2 and N m s
    observer_t observer = observer_t::ideal(1000.0, 40000.0, 0.02, 0.03);
    observer_t scaled = observer_t::ideal(1000.0, 40000.0, 0.02 * UNIT, 0.03 * UNIT, UNIT);
    for (unsigned i = 0; i < 4000; i++) {
        const double angle_rev = std::floor(131072.0 * 0.25 * i * i / 4000.0 / 4000.0) / 131072.0;
        const double torque_Nm = 5.0 * std::sin(0.01 * i);
        observer.step(angle_rev, torque_Nm);
        scaled.step(angle_rev, torque_Nm);
        ASSERT_NEAR(scaled.angle, observer.angle, 1e-12);
        ASSERT_NEAR(scaled.speed * UNIT, observer.speed, 1e-9);
        ASSERT_NEAR(scaled.load_torque, observer.load_torque, 1e-9);
    }
    EXPECT_GT(observer.speed, 10.0);
}

} // namespace
