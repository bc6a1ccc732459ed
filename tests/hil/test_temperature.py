"""Measured temperatures of windings and switches: limit of the torque, trip, sensors that fail. [SR-17]"""

from __future__ import annotations

import math

import pytest

from salient.machine.drive_data import derive
from salient.machine.file import load_machine, machine_path
from salient.machine.heat import thermal_constants

PARTS = {"winding": 155.0, "inverter": 100.0}
"""Default limits."""
FAULTS = {"winding": "winding_overload", "inverter": "inverter_overload"}
SENSOR_LIMIT_S = 0.1


def start(bench) -> None:
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.15)
    assert bench.drive.state == "run"


def cause_s(bench) -> float:
    return bench.telemetry["DRIVE_FAULT_CAUSE.time_us"].last * 1e-6


@pytest.mark.parametrize("part", PARTS)
def test_torque_is_limited_within_20_K_of_the_limit_and_trips_at_it(bench, part):
    start(bench)
    full_Nm = bench.telemetry["torque_limit_Nm"].last
    assert full_Nm == pytest.approx(bench.drive.parameters["torque_max_Nm"], rel=0.01)
    limit_C = PARTS[part]
    for below_K, share in ((21.0, 1.0), (15.0, 0.75), (5.0, 0.25)):
        setattr(bench.rig, f"held_{part}_C", limit_C - below_K)
        bench.run_for(0.2)
        assert bench.drive.state == "run"
        assert bench.telemetry["torque_limit_Nm"].last == pytest.approx(share * full_Nm, abs=0.01 * full_Nm)
        assert bench.telemetry[f"DRIVE_THERMAL.{part}_temperature_C"].last == pytest.approx(limit_C - below_K, abs=1.0)
        assert bench.truth[f"{part}_temperature_C"].last == pytest.approx(limit_C - below_K, abs=0.07)
    begin_s = bench.time_s
    setattr(bench.rig, f"held_{part}_C", limit_C + 0.2)
    bench.run_for(0.05)
    assert bench.drive.fault == FAULTS[part]
    assert 0.0 < cause_s(bench) - begin_s < 0.02


@pytest.mark.parametrize("part", PARTS)
def test_over_temperature_is_cleared_only_20_K_below_its_limit(bench, part):
    start(bench)
    setattr(bench.rig, f"held_{part}_C", PARTS[part] + 1.0)
    bench.run_for(0.05)
    for below_K, state in ((19.0, "fault"), (21.0, "ready")):
        setattr(bench.rig, f"held_{part}_C", PARTS[part] - below_K)
        bench.drive.off()
        bench.run_for(0.05)
        bench.drive.clear_fault()
        bench.run_for(0.05)
        assert bench.drive.state == state, below_K


# [SR-18]
@pytest.mark.parametrize("phase", ["a", "c"])
@pytest.mark.parametrize("kind", ["open", "shorted"])
@pytest.mark.parametrize("part", PARTS)
def test_open_and_shorted_sensors_are_faults_within_100_ms_that_name_the_sensor(bench, part, kind, phase):
    start(bench)
    begin_s = bench.time_s
    fault = bench.fault(f"{part}_temperature_sensor_{kind}", phase=phase)
    bench.run_for(0.15)
    assert bench.drive.fault == "temperature_sensor"
    assert 0.01 < cause_s(bench) - begin_s < SENSOR_LIMIT_S
    failed = {f"{each}_sensor_{letter}": bench.telemetry[f"{each}_sensor_{letter}"].last
              for each in PARTS for letter in "abcd"}
    assert {name for name, value in failed.items() if value} == {f"{part}_sensor_{phase}"}
    bench.drive.off()
    bench.drive.clear_fault()
    bench.run_for(0.05)
    assert bench.drive.state == "fault", "the cause lasts"
    fault.clear()
    bench.drive.off()
    bench.run_for(0.03)
    bench.drive.clear_fault()
    bench.run_for(0.05)
    assert bench.drive.state == "ready"
    assert bench.drive.fault_log[-1].self_test == (f"{part}_sensor_{phase}",)


# [SR-18]
def test_an_open_sensor_keeps_a_drive_from_starting_and_is_named_by_its_status(make_bench):
    bench = make_bench()
    bench.fault("inverter_temperature_sensor_open", phase="b")
    bench.run_for(0.01)
    bench.rig.drive_reset = 1
    bench.run_for(0.2)
    assert bench.drive.state == "initialise"
    assert bench.telemetry["start_inhibited_by"].last_name == "temperature_sensor"
    assert bench.telemetry["inverter_sensor_b"].last == 1


# [SR-18]
def test_an_interruption_of_less_than_20_ms_is_no_fault(bench):
    start(bench)
    bench.fault("winding_temperature_sensor_open", phase="b", duration_s=0.019)
    bench.run_for(0.2)
    assert bench.drive.state == "run"


def test_a_sensor_with_an_offset_acts_as_it_reads(bench):
    """Only a reading out of range is a failed sensor: what is stuck or displaced within it cannot be told from a
    temperature, and the models of the currents remain."""
    start(bench)
    bench.fault("winding_temperature_sensor_offset", phase="b", offset_K=120.0)
    bench.run_for(0.2)
    limit_Nm = bench.telemetry["torque_limit_Nm"].last
    assert limit_Nm == pytest.approx(0.5 * bench.drive.parameters["torque_max_Nm"], rel=0.03)
    assert bench.truth["winding_temperature_C"].last < 30.0
    bench.fault("winding_temperature_sensor_stuck", phase="b", code=20480)
    bench.run_for(0.2)
    assert bench.telemetry["torque_limit_Nm"].last > 1.9 * limit_Nm


def test_limits_are_parameters(bench):
    bench.drive.parameters["winding_limit_C"] = 80
    bench.rig.held_winding_C = 70
    start(bench)
    assert bench.telemetry["torque_limit_Nm"].last == pytest.approx(
        0.5 * bench.drive.parameters["torque_max_Nm"], rel=0.03)
    bench.rig.held_winding_C = 81
    bench.run_for(0.05)
    assert bench.drive.fault == "winding_overload"


def test_a_loaded_winding_heats_as_its_copper_loss_says_and_cools_to_the_surroundings(bench):
    machine = load_machine(machine_path("saturating"))
    data = derive(machine)
    capacity_J_K = thermal_constants(machine, data.parameters, data.supply_max_V)["winding_capacity_J_K"]
    bench.rig.held_speed_rpm = 0  # one or two phases carry the torque
    bench.run_for(0.01)
    bench.drive.torque_reference_Nm = 8
    bench.run_for(0.1)
    before_C, begin_s = bench.truth["winding_temperature_C"].last, bench.time_s
    bench.run_for(3.0)
    risen_K = bench.truth["winding_temperature_C"].last - before_C
    currents_A = [bench.truth[f"current_{phase}_A"].between(begin_s, math.inf).value for phase in "abc"]
    loss_W = max(machine.resistance_ohm * float((current_A**2).mean()) for current_A in currents_A)
    assert loss_W > 5.0
    assert risen_K == pytest.approx(loss_W * 3.0 / capacity_J_K, rel=0.1, abs=0.13)
    assert risen_K > 0.5
    bench.drive.off()
    bench.rig.ambient_C = -20
    hot_C = bench.truth["winding_temperature_C"].last
    bench.run_for(1.0)
    assert -2.0 < bench.truth["winding_temperature_C"].last - hot_C < -0.4
