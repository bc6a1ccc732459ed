"""Degraded running: with one phase lost the drive goes on with the others, if it may. [SR-31]"""

from __future__ import annotations

import pytest

from salient.bench.bench import Bench
from salient.paths import ROOT

CONTROLLERS = ["traditional", "paper", "salient"]
MACHINES = ["saturating", "finite_element", "linear_cosine", "linear_trapezoid"]
FOUR_PHASES = ROOT / "tools" / "examples" / "machines" / "map86.toml"
STROKES_S = 0.025
"""An electrical revolution of a rotor with four poles at 600 r/min."""
DEAD_ZONE_DEG = 6.0
"""In the middle of the angles at which phase b alone makes torque, on `saturating`."""


def loaded(make_bench, load_Nm: float = 6.0, allowed: bool = True, **options) -> Bench:
    """At 600 r/min, phase b about to be lost."""
    bench = make_bench(**options)
    if allowed:
        bench.drive.parameters["degraded_running"] = 1
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.15)
    bench.load_torque_Nm = load_Nm
    bench.run_for(0.1)
    assert bench.drive.state == "run"
    return bench


def degraded(bench: Bench, name: str = "degraded") -> float:
    return float(bench.telemetry[f"DRIVE_DEGRADED.{name}"].last)


def current_b(bench: Bench, from_s: float):
    return bench.truth["RIG_TRUTH_CURRENTS.current_b_A"].between(from_s, bench.time_s).value


# Without its phase the rotor slows down under the load for less than a stroke: 8.3 ms of 6 N m take 24 r/min from
# 0.02 kg m^2.
@pytest.mark.in_turns
@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("machine", MACHINES)
def test_lost_phase_under_load_leaves_the_speed_at_its_reference(make_bench, machine, controller):
    bench = loaded(make_bench, machine=machine, controller=controller)
    begin_s = bench.time_s
    bench.fault("winding_open", phase="b")
    bench.run_for(0.6)
    assert (bench.drive.state, bench.drive.fault) == ("run", "none")
    lost = {phase for phase in "abcd" if degraded(bench, f"lost_phase_{phase}")}
    assert degraded(bench) == 1 and lost == {"b"}
    speed_rpm = bench.truth["RIG_TRUTH_MOTION.speed_rpm"].between(begin_s + 0.2, bench.time_s).value
    assert 592 < speed_rpm.mean() < 601
    assert 570 < speed_rpm.min() < 595 and 599 < speed_rpm.max() < 606
    assert not current_b(bench, begin_s + STROKES_S).any()


# [SR-09] [SR-31]
@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("machine", ["saturating", "finite_element"])
def test_reported_torque_is_what_the_other_phases_make(make_bench, machine, controller):
    """Torque of a shaft that is held below the reference, so that the torque is at its limit."""
    bench = make_bench(machine=machine, controller=controller)
    for name, value in {"degraded_running": 1, "winding_current_A": 70, "switch_current_A": 70}.items():
        bench.drive.parameters[name] = value
    bench.held_speed_rpm = 300
    bench.run_for(0.05)
    bench.drive.speed_reference_rpm = 500
    bench.run_for(0.1)
    bench.fault("winding_open", phase="b")
    bench.rig.truth_period_us = 100
    bench.run_for(0.4)
    assert bench.drive.state == "run"
    torque_Nm = bench.truth["torque_Nm"].between(bench.time_s - 0.2, bench.time_s).value
    mean_Nm = degraded(bench, "torque_mean_Nm")
    assert 12.0 < mean_Nm < 17.0
    assert torque_Nm.mean() == pytest.approx(mean_Nm, rel=0.06)
    # With windows up to the aligned position a current ends a little past it.
    assert torque_Nm.min() > -0.6
    # paper charges a phase shortly before its unaligned position, where it brakes by less than a tenth of 1 N m.
    tolerance_Nm = 0.1 if controller == "paper" else 0.05
    assert degraded(bench, "torque_least_Nm") == pytest.approx(max(torque_Nm.min(), 0.0), abs=tolerance_Nm)


def test_loss_of_a_phase_is_a_fault_by_default(make_bench):
    bench = loaded(make_bench, allowed=False)
    bench.fault("winding_open", phase="b")
    bench.run_for(0.05)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "phase_open")
    bench.run_for(0.1)
    assert degraded(bench) == 0


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_loss_of_a_second_phase_is_a_fault(make_bench, controller):
    bench = loaded(make_bench, controller=controller)
    bench.fault("winding_open", phase="b")
    bench.run_for(0.2)
    assert bench.drive.state == "run"
    bench.fault("switch_open", phase="c", leg="low")
    bench.run_for(0.06)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "phase_open")


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize(("kind", "attributes", "faults"), [
    ("switch_shorted", {"leg": "low"}, {"phase_shorted"}),  # cannot be switched off
    ("current_sensor_stuck", {"code": 1000.0}, {"current_sensor"}),  # the end of the current does not show
    # Two phases; where the rotor is decides whether a current becomes too large before that shows.
    ("current_sensor_swapped", {"with_phase": "c"}, {"current_sensor", "over_current"}),
])
def test_what_cannot_be_run_on_with_is_a_fault(make_bench, controller, kind, attributes, faults):
    bench = loaded(make_bench, controller=controller)
    bench.fault(kind, phase="b", **attributes)
    bench.run_for(0.06)
    assert bench.drive.state == "fault"
    assert bench.drive.fault in faults


@pytest.mark.in_turns
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_of_four_phases_the_three_that_remain_show_a_sensor_with_a_wrong_gain(make_bench, controller):
    bench = loaded(make_bench, machine=str(FOUR_PHASES), controller=controller, load_Nm=4.0)
    bench.fault("winding_open", phase="b")
    bench.run_for(0.3)
    assert bench.drive.state == "run" and degraded(bench) == 1
    bench.fault("current_sensor_gain", phase="c", gain=0.7)
    bench.run_for(0.4)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "current_sensor")


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_phase_with_a_dead_sensor_is_switched_off_within_a_stroke(make_bench, controller):
    bench = loaded(make_bench, controller=controller, load_Nm=4.0)
    begin_s = bench.time_s
    bench.fault("current_sensor_open", phase="b")
    bench.run_for(0.4)
    assert bench.drive.state == "run" and degraded(bench) == 1
    assert current_b(bench, begin_s).max() < 75.0
    assert not current_b(bench, begin_s + STROKES_S).any()


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_clear_fault_gives_a_whole_phase_back_and_a_new_run_alone_does_not(make_bench, controller):
    bench = loaded(make_bench, controller=controller, load_Nm=0.0)
    bench.fault("switch_open", phase="b", leg="low", duration_s=0.1)
    bench.load_torque_Nm = 4.0
    bench.run_for(0.2)
    assert degraded(bench) == 1
    bench.load_torque_Nm = 0.0
    bench.drive.off()
    bench.run_for(0.02)
    bench.drive.speed_reference_rpm = 500
    bench.run_for(0.2)
    assert bench.drive.state == "run" and degraded(bench) == 1
    assert not current_b(bench, bench.time_s - 0.1).any()
    bench.drive.off()
    bench.run_for(0.02)
    bench.drive.clear_fault()
    bench.run_for(0.15)
    assert degraded(bench) == 0
    bench.drive.speed_reference_rpm = 600
    bench.load_torque_Nm = 4.0
    bench.run_for(0.4)
    assert bench.drive.state == "run"
    assert current_b(bench, bench.time_s - 0.1).max() > 10.0
    speed_rpm = bench.truth["RIG_TRUTH_MOTION.speed_rpm"].between(bench.time_s - 0.1, bench.time_s).value
    assert speed_rpm.min() > 594 and speed_rpm.max() < 606


def test_phase_is_given_back_outside_a_run_when_the_parameter_no_longer_allows_it_and_its_loss_is_a_fault(make_bench):
    bench = loaded(make_bench, load_Nm=0.0)
    bench.fault("winding_open", phase="b")
    bench.load_torque_Nm = 4.0
    bench.run_for(0.2)
    assert (bench.drive.state, degraded(bench)) == ("run", 1)
    bench.load_torque_Nm = 0.0
    bench.drive.off()
    bench.run_for(0.15)
    assert degraded(bench) == 1
    bench.drive.parameters["degraded_running"] = 0
    bench.run_for(0.15)
    assert degraded(bench) == 0
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.2)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "phase_open")


# [SR-09] [SR-31]
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_start_where_only_the_lost_phase_has_torque_is_a_stall_and_stated_before(make_bench, controller):
    bench = make_bench(controller=controller, initial_angle_deg=DEAD_ZONE_DEG)
    bench.drive.parameters["degraded_running"] = 1
    bench.fault("winding_open", phase="b")
    bench.run_for(0.01)
    bench.drive.speed_reference_rpm = 300
    bench.run_until(lambda: bench.drive.state == "fault", timeout=0.5)
    assert bench.drive.fault == "stall"
    assert degraded(bench) == 1 and degraded(bench, "torque_here_Nm") == 0.0
    travel_deg = abs(bench.truth["rotor_angle_deg"].last - DEAD_ZONE_DEG)
    assert travel_deg < 3.0


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_start_beside_the_dead_zone_reaches_the_reference(make_bench, controller):
    bench = make_bench(controller=controller, initial_angle_deg=DEAD_ZONE_DEG + 30.0)
    bench.drive.parameters["degraded_running"] = 1
    bench.fault("winding_open", phase="b")
    bench.run_for(0.01)
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.5)
    assert bench.drive.state == "run" and degraded(bench) == 1
    speed_rpm = bench.truth["RIG_TRUTH_MOTION.speed_rpm"].between(bench.time_s - 0.1, bench.time_s).value
    assert speed_rpm.min() > 290 and speed_rpm.max() < 310
