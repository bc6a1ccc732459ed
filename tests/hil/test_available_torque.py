"""Available torque in telemetry: its size in each direction, and what limits it."""

from __future__ import annotations

import pytest

from salient.bench.bench import Bench
from salient.machine.drive_data import derive
from salient.machine.file import load_machine
from salient.paths import ROOT

AVAILABLE = "DRIVE_AVAILABLE_TORQUE."


def available_Nm(bench: Bench, side: str) -> float:
    return bench.telemetry[f"{AVAILABLE}{side}_Nm"].last


def limited_by(bench: Bench, side: str) -> str:
    return bench.telemetry[f"{AVAILABLE}{side}_limited_by"].last_name


def peak_Nm(machine: str = "saturating") -> float:
    return derive(load_machine(ROOT / f"tools/machines/{machine}.toml")).torque_peak_Nm


# [SR-09]
@pytest.mark.parametrize("machine", ["saturating", "finite_element"])
def test_at_low_speed_both_directions_have_the_torque_of_the_current_limit(make_bench, machine):
    bench = make_bench(machine=machine, controller="salient")
    bench.drive.speed_reference_rpm = 100
    bench.run_for(0.4)
    assert available_Nm(bench, "forward") == pytest.approx(peak_Nm(machine), rel=1e-3)
    assert available_Nm(bench, "backward") == pytest.approx(-peak_Nm(machine), rel=1e-3)
    assert limited_by(bench, "forward") == limited_by(bench, "backward") == "current"
    assert bench.telemetry[f"{AVAILABLE}load_exceeds"].last == 0


# [SR-09]
@pytest.mark.parametrize("controller", ["traditional", "paper"])
def test_a_controller_of_one_quadrant_has_no_torque_backwards(make_bench, controller):
    bench = make_bench(controller=controller)
    bench.drive.speed_reference_rpm = 100
    bench.run_for(0.4)
    assert available_Nm(bench, "backward") == 0
    assert limited_by(bench, "backward") == "controller"
    assert limited_by(bench, "forward") == "current"


# [SR-09]
@pytest.mark.parametrize("sign", [1, -1])
def test_far_above_base_speed_the_voltage_limits_the_torque_that_drives(make_bench, sign):
    bench = make_bench(machine="linear_cosine", controller="salient")
    bench.rig.held_speed_rpm = sign * 3000
    bench.run_for(0.1)
    bench.drive.torque_reference_Nm = sign * 100
    bench.run_for(0.4)
    side = "forward" if sign > 0 else "backward"
    assert limited_by(bench, side) == "voltage"
    assert sign * available_Nm(bench, side) == pytest.approx(sign * bench.truth["torque_Nm"].last, rel=0.1)
    assert sign * available_Nm(bench, side) < 0.99 * peak_Nm("linear_cosine")


# [SR-09]
@pytest.mark.parametrize("sign", [1, -1])
def test_a_load_that_drives_into_a_full_link_is_told_before_over_speed(make_bench, sign):
    """Without a chopper: the load feeds the link until it takes the losses of the windings only."""
    bench = make_bench(machine="finite_element", controller="salient")
    bench.drive.speed_reference_rpm = sign * 600
    bench.run_for(0.5)
    bench.fault("chopper_open")
    bench.rig.load_torque_Nm = -sign * 8
    bench.run_until(lambda: bench.drive.state == "fault", timeout=20)
    assert bench.drive.fault == "over_speed"
    against = "backward" if sign > 0 else "forward"
    limits, exceeds = (bench.telemetry[f"{AVAILABLE}{name}"] for name in (f"{against}_limited_by", "load_exceeds"))
    told = [
        (time, limits.choices[int(limit)])
        for time, limit, exceeding in zip(exceeds.time_s, limits.value, exceeds.value, strict=True)
        if exceeding
    ]
    assert told[0][0] < 0.61 < bench.time_s - 0.1, "within 100 ms, a period of the frame"
    assert {limit for _, limit in told} == {"dc_link"}


# [SR-09]
def test_a_load_that_the_torque_holds_is_not_told(make_bench):
    bench = make_bench(controller="salient")
    bench.drive.speed_reference_rpm = 150
    bench.run_for(0.3)
    for load_Nm in (0.9 * peak_Nm(), -0.9 * peak_Nm(), 0.0):
        bench.rig.load_torque_Nm = load_Nm
        bench.run_for(0.4)
    assert set(bench.telemetry[f"{AVAILABLE}load_exceeds"].value) == {0}


# [SR-09]
def test_heat_is_named_when_it_takes_torque(make_bench):
    bench = make_bench(controller="salient")
    bench.drive.parameters["winding_time_constant_s"] = 1
    bench.drive.parameters["winding_current_A"] = 12
    bench.rig.held_speed_rpm = 150
    bench.run_for(0.01)
    bench.drive.torque_reference_Nm = 10
    bench.run_for(2)
    assert limited_by(bench, "forward") == limited_by(bench, "backward") == "heat"
    limit_Nm = bench.telemetry["DRIVE_THERMAL.torque_limit_Nm"].last
    assert available_Nm(bench, "forward") == pytest.approx(limit_Nm, abs=0.05 * peak_Nm())
    assert limit_Nm < 0.95 * peak_Nm()


# [SR-09]
def test_a_lost_phase_is_named_with_the_mean_torque_of_the_others(make_bench):
    bench = make_bench(controller="salient")
    bench.drive.parameters["degraded_running"] = 1
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.4)
    bench.fault("winding_open", phase="b")
    bench.run_for(0.5)
    assert limited_by(bench, "forward") == limited_by(bench, "backward") == "degraded"
    assert available_Nm(bench, "forward") == bench.telemetry["DRIVE_DEGRADED.torque_mean_Nm"].last
