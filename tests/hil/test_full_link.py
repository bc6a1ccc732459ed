"""Braking into a DC link that cannot take the energy: the torque falls before the over-voltage trip."""

from __future__ import annotations

import numpy as np
import pytest

from salient.bench.bench import Bench
from salient.paths import MACHINES

OVER_VOLTAGE_V = 300.0
CAPACITANCE_F = 2.2e-3


def running(bench: Bench, speed_rpm: float) -> None:
    """Without a chopper from here on: what is left is the capacitor, 35.6 J from 240 to 300 V, and the losses."""
    bench.drive.speed_reference_rpm = speed_rpm
    bench.run_until(lambda: abs(bench.truth["speed_rpm"].last - speed_rpm) < 5, timeout=3)
    bench.run_for(0.05)
    bench.fault("chopper_open")
    bench.rig.truth_period_us = 250


# [SR-14]
@pytest.mark.in_turns
@pytest.mark.parametrize("inertia", [0.3, 1.0, 4.0])
@pytest.mark.parametrize("speed_rpm", [600, 1500, 2500, -1500])
@pytest.mark.parametrize("target", ["standstill", "reverse"])
def test_braking_without_a_chopper_stays_below_the_trip(make_bench, inertia, speed_rpm, target):
    bench = make_bench(machine="finite_element", controller="salient")
    bench.rig.inertia_gain = inertia
    running(bench, speed_rpm)
    before_s = bench.time_s
    bench.drive.speed_reference_rpm = 0 if target == "standstill" else -speed_rpm
    bench.run_for(0.6)
    assert (bench.drive.state, bench.drive.fault) == ("run", "none")
    voltage = bench.truth["RIG_TRUTH_BENCH.bus_voltage_V"].between(before_s, bench.time_s + 1e-9).value
    assert np.max(voltage) < 0.999 * OVER_VOLTAGE_V
    assert np.max(voltage) > 241
    assert bench.truth["speed_rpm"].last / speed_rpm < 0.995, "friction and losses brake"


# [SR-14]
@pytest.mark.parametrize(("speed_rpm", "torque_Nm"), [(1500, -4), (1500, -16), (-1500, 16)])
def test_a_commanded_braking_torque_falls_as_the_link_fills(make_bench, speed_rpm, torque_Nm):
    """The dynamometer holds the speed, so that the energy does not end."""
    bench = make_bench(machine="finite_element", controller="salient")
    bench.rig.held_speed_rpm = speed_rpm
    bench.run_for(0.25)
    bench.fault("chopper_open")
    bench.drive.torque_reference_Nm = torque_Nm
    bench.run_for(0.6)
    assert (bench.drive.state, bench.drive.fault) == ("run", "none")
    voltage = bench.truth["RIG_TRUTH_BENCH.bus_voltage_V"]
    assert 0.97 * OVER_VOLTAGE_V < max(voltage.value) < 0.999 * OVER_VOLTAGE_V
    assert bench.telemetry["torque_reference_Nm"].last / torque_Nm < 0.75


# [SR-14]
@pytest.mark.parametrize("supply_V", [265, 290])
def test_a_supply_that_rises_while_the_drive_brakes_is_no_trip(make_bench, supply_V):
    bench = make_bench(machine="finite_element", controller="salient")
    running(bench, 1500)
    bench.rig.supply_voltage_V = supply_V
    bench.drive.speed_reference_rpm = -1500
    bench.run_for(0.4)
    assert (bench.drive.state, bench.drive.fault) == ("run", "none")
    assert supply_V - 1 < max(bench.truth["RIG_TRUTH_BENCH.bus_voltage_V"].value) < 0.999 * OVER_VOLTAGE_V


# [SR-14]
@pytest.mark.parametrize("controller", ["traditional", "paper"])
def test_single_quadrant_controllers_regenerate_only_what_their_fields_hold(make_bench, controller):
    bench = make_bench(machine="finite_element", controller=controller)
    running(bench, 1500)
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.4)
    assert bench.drive.fault == "none"
    assert 239 < max(bench.truth["RIG_TRUTH_BENCH.bus_voltage_V"].value) < 250


# [SR-14]
def test_a_chopper_that_opens_while_it_conducts_takes_no_more(make_bench):
    bench = make_bench(machine="finite_element", controller="traditional")
    bench.rig.truth_period_us = 250
    bench.rig.supply_voltage_V = 292
    bench.run_for(0.1)
    bench.rig.supply_voltage_V = 240
    bench.run_for(0.001)  # the chopper conducts, down to 270 V
    conducting_V = bench.truth["RIG_TRUTH_BENCH.bus_voltage_V"].last
    bench.fault("chopper_open")
    bench.run_for(0.1)
    voltage_V = bench.truth["RIG_TRUTH_BENCH.bus_voltage_V"].last
    assert 275 < conducting_V < 292
    assert voltage_V == pytest.approx(conducting_V, abs=0.1)


# [SR-14]
@pytest.mark.in_turns
@pytest.mark.parametrize("chopper_ohm", [12.0, 16.0, 24.0, None])
@pytest.mark.parametrize("speed_rpm", [2250, 3000])
def test_the_largest_braking_torque_of_the_current_limit_at_once_is_no_trip(
        make_bench, tmp_path, chopper_ohm, speed_rpm):
    """Three times the torque that the fields are reckoned with by default, above base speed, at a held speed."""
    text = (MACHINES / "finite_element.toml").read_text()
    if chopper_ohm is None:
        text = "\n".join(line for line in text.splitlines() if not line.startswith("chopper_"))
    (tmp_path / "finite_element.csv").write_bytes((MACHINES / "finite_element.csv").read_bytes())
    file = tmp_path / "finite_element.toml"
    file.write_text(text.replace("chopper_resistance_ohm = 12.0", f"chopper_resistance_ohm = {chopper_ohm}"))
    bench = make_bench(machine=str(file), controller="salient")
    bench.drive.parameters["torque_max_Nm"] = 100
    bench.rig.truth_period_us = 200
    bench.rig.held_speed_rpm = speed_rpm
    bench.run_for(0.4)
    bench.drive.torque_reference_Nm = -100
    bench.run_for(0.4)
    assert (bench.drive.state, bench.drive.fault) == ("run", "none")
    assert 0.96 * OVER_VOLTAGE_V < max(bench.truth["RIG_TRUTH_BENCH.bus_voltage_V"].value) < OVER_VOLTAGE_V


# [SR-14]
def test_windings_dissipate_what_the_chopper_does_not_take(make_bench):
    """At twice the base speed; 290 V at 12 ohm are 22.3 N m, and pulses of the least current lose 1.5 N m."""
    bench = make_bench(machine="finite_element", controller="salient")
    bench.drive.parameters["torque_max_Nm"] = 100
    bench.rig.truth_period_us = 50
    bench.rig.held_speed_rpm = 3000
    bench.run_for(0.4)
    bench.drive.torque_reference_Nm = -100
    bench.run_for(0.1)
    begin_s = bench.time_s
    bench.run_for(0.1)
    assert bench.drive.fault == "none"
    torque_Nm = bench.truth["RIG_TRUTH_MOTION.torque_Nm"].between(begin_s, bench.time_s).value
    assert 24.95 < -np.mean(torque_Nm) < 27.12, "0.92 of the bound of torque_speed, and the bound"
    voltage_V = bench.truth["RIG_TRUTH_BENCH.bus_voltage_V"].between(begin_s, bench.time_s).value
    assert 288 < np.min(voltage_V) < np.max(voltage_V) < 293, "it is steady"


# [SR-14]
@pytest.mark.parametrize("references_rpm", [(-300,), (300, 0, -300), (-300, 0, 300)])
def test_a_full_link_leaves_a_drive_at_rest_the_torque_to_start_in_either_direction(make_bench, references_rpm):
    bench = make_bench(controller="salient")
    bench.rig.supply_voltage_V = 0.99 * OVER_VOLTAGE_V
    for reference_rpm in references_rpm:
        bench.drive.speed_reference_rpm = reference_rpm
        bench.run_for(3.0 if reference_rpm == 0 else 0.3)  # it coasts to rest
    assert bench.drive.state == "run"
    assert bench.truth["speed_rpm"].last == pytest.approx(references_rpm[-1], rel=0.01)
