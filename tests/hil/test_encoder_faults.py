"""Encoder faults at standstill and at speed: fault, time, motion and true current, bounded on both sides; and none of a
healthy encoder. Lower bounds are physics: the flux linkage that contradicts the encoder appears with motion, and the
torque limit turns the inertia by an angle in sqrt(2 angle J / T) at least. [SR-22]
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from salient.bench.bench import Bench
from salient.experiments.compare.case import machine_of
from salient.paths import ROOT

CONTROLLERS = ["traditional", "paper", "salient"]
MACHINES = ["saturating", "finite_element", "linear_cosine", "linear_trapezoid"]
EXAMPLES = ROOT / "tools" / "examples" / "machines"
TORQUE_MAX_NM = 19.1
TRIP_A = 75.0


def motion_deg(bench: Bench, from_s: float, to_s: float) -> float:
    """Largest distance of the rotor from where it was."""
    angle = bench.truth["rotor_angle_deg"].between(from_s, to_s)
    travel_deg = np.unwrap(angle.value, period=360.0)
    return float(np.abs(travel_deg - travel_deg[0]).max())


def peak_A(bench: Bench) -> float:
    return max(float(np.max(bench.truth[f"RIG_TRUTH_CURRENTS.current_{phase}_A"].value)) for phase in "abc")


def fault_s(bench: Bench) -> float:
    return float(bench.telemetry["DRIVE_FAULT_CAUSE.time_us"].last) * 1e-6


def run_until_fault(bench: Bench, timeout_s: float) -> None:
    bench.run_until(lambda: bench.drive.state == "fault", timeout=timeout_s)
    bench.run_for(0.004)


# --- Frozen before the start ---


# [SR-21]
@pytest.mark.parametrize("initial_angle_deg", [0.0, 10.0, 22.0])
@pytest.mark.parametrize("speed_rpm", [10, 1500])
@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("machine", MACHINES)
def test_encoder_frozen_before_the_start_is_a_fault_before_the_rotor_has_turned_by_5_5_degrees(
        make_bench, machine, controller, speed_rpm, initial_angle_deg):
    bench = make_bench(machine=machine, controller=controller, initial_angle_deg=initial_angle_deg)
    bench.rig.truth_period_us = 100
    bench.fault("encoder_stuck")
    bench.drive.speed_reference_rpm = speed_rpm
    run_until_fault(bench, 0.3)
    assert bench.drive.fault == "encoder"
    assert 0.2 < motion_deg(bench, 0.0, fault_s(bench)) < 5.5
    assert peak_A(bench) < TRIP_A
    # From the start of the run; half a degree at the torque limit takes this long.
    inertia_kg_m2 = machine_of(machine).inertia_kg_m2
    started_s = next(t for t, state in zip(bench.telemetry["state"].time_s, bench.telemetry["state"].value, strict=True)
                     if state >= 2) - 0.001
    least_s = math.sqrt(2.0 * math.radians(0.2) * inertia_kg_m2 / (1.6 * TORQUE_MAX_NM))
    assert least_s < fault_s(bench) - started_s < 0.03


# [SR-21]
@pytest.mark.parametrize("load_Nm", [6.0, 12.0])
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_encoder_frozen_before_a_start_against_static_friction_is_found_once_the_rotor_moves(make_bench, controller,
                                                                                            load_Nm):
    bench = make_bench(controller=controller, initial_angle_deg=20.0)
    bench.rig.truth_period_us = 100
    bench.fault("encoder_stuck")
    bench.fault("static_friction", torque_Nm=load_Nm)
    bench.drive.speed_reference_rpm = 600
    run_until_fault(bench, 0.3)
    assert bench.drive.fault == "encoder"
    assert 0.2 < motion_deg(bench, 0.0, fault_s(bench)) < 5.0


# [SR-21]
@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("machine", ["saturating", "finite_element"])
def test_locked_shaft_is_a_stall_and_no_fault_of_the_encoder(make_bench, machine, controller):
    bench = make_bench(machine=machine, controller=controller)
    bench.fault("shaft_locked")
    bench.drive.speed_reference_rpm = 600
    run_until_fault(bench, 0.2)
    assert bench.drive.fault == "stall"
    assert fault_s(bench) > 0.1


# --- At speed ---


@dataclass(frozen=True)
class Case:
    """time_s: from the fault to its detection, inclusive bounds, of all controllers."""

    kind: str
    fault: str
    time_s: tuple[float, float]
    attributes: dict[str, float] = field(default_factory=dict)


# 60 deg/s pass the tolerated 2 degrees after 33 ms, 4 degrees of salient after 67 ms. Reversed, the angle errs by 7.2
# degrees a millisecond. Every third of a turn of 600 r/min a phase begins to conduct after another one.
CASES = {
    "reversed": Case("encoder_reversed", "encoder_angle", (0.0003, 0.015)),
    "slips_forwards": Case("encoder_slip", "encoder_angle", (0.033, 0.2), {"slip_deg_s": 60.0}),
    "slips_backwards": Case("encoder_slip", "encoder_angle", (0.033, 0.16), {"slip_deg_s": -60.0}),
    "loses_counts": Case("encoder_lost_counts", "encoder_angle", (0.0146, 0.07), {"counts_per_turn": 5000.0}),
    "jumps_forwards": Case("encoder_jump", "encoder", (0.0, 0.0001), {"angle_deg": 5.0}),
    "jumps_backwards": Case("encoder_jump", "encoder", (0.0, 0.0001), {"angle_deg": -5.0}),
    "no_answer": Case("encoder_no_answer", "encoder", (0.0, 0.001)),
    "noise": Case("encoder_noise", "encoder", (0.0, 0.002), {"deviation_deg": 1.0}),
    "stuck": Case("encoder_stuck", "encoder", (0.00005, 0.001)),
}


# [SR-19] [SR-20] [SR-22]
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_fault_of_the_encoder_at_speed_is_the_first_cause_within_its_time(make_bench, controller, name):
    case = CASES[name]
    bench = make_bench(controller=controller)
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.1)
    bench.load_torque_Nm = 12
    bench.run_for(0.1)
    assert bench.drive.state == "run"
    begin_s = bench.time_s
    bench.fault(case.kind, **case.attributes)
    run_until_fault(bench, 0.4)
    assert bench.drive.fault == case.fault
    assert case.time_s[0] <= fault_s(bench) - begin_s <= case.time_s[1]
    assert peak_A(bench) < TRIP_A
    assert abs(bench.truth["speed_rpm"].value).max() < 700


@pytest.mark.parametrize(("controller", "offset_deg"), [("traditional", -5.0), ("paper", 5.0), ("paper", -5.0)])
def test_encoder_displaced_by_5_degrees_under_load_is_a_fault_within_100_ms(make_bench, controller, offset_deg):
    bench = make_bench(controller=controller, initial_angle_deg=10.0)
    bench.rig.encoder_offset_deg = offset_deg
    bench.load_torque_Nm = 8
    bench.drive.speed_reference_rpm = 600
    run_until_fault(bench, 0.11)
    assert bench.drive.fault == "encoder_angle"
    assert 0.003 < fault_s(bench) < 0.1


@pytest.mark.parametrize(("machine", "controller", "ahead_deg"),
                         [("saturating", "traditional", 5.0), ("finite_element", "traditional", 7.0),
                          ("saturating", "salient", 8.0), ("linear_cosine", "salient", 8.0)])
def test_encoder_ahead_by_more_than_its_tolerance_is_a_fault_within_three_quarters_of_a_second(make_bench, machine,
                                                                                             controller, ahead_deg):
    """When a phase contradicts the angle, or after two windows of the balance: sixteen electrical revolutions, of which
    four or six make a turn of 600 r/min."""
    bench = make_bench(machine=machine, controller=controller, initial_angle_deg=10.0)
    bench.fault("encoder_jump", angle_deg=ahead_deg)
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.12)
    bench.load_torque_Nm = 8
    run_until_fault(bench, 0.9)
    assert bench.drive.fault == "encoder_angle"
    assert 0.01 < fault_s(bench) < 0.75


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_encoder_reversed_before_the_start_is_a_fault_within_half_a_pole_pitch(make_bench, controller):
    bench = make_bench(controller=controller, initial_angle_deg=10.0)
    bench.rig.truth_period_us = 100
    bench.fault("encoder_reversed")
    bench.drive.speed_reference_rpm = 600
    run_until_fault(bench, 0.3)
    assert bench.drive.fault == "encoder_angle"
    assert 1.0 < motion_deg(bench, 0.0, fault_s(bench)) < 22.5
    assert fault_s(bench) < 0.05


# --- Clearing ---


# [SR-20] [SR-41]
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_frozen_encoder_is_not_cleared_before_it_counts_again(make_bench, controller):
    bench = make_bench(controller=controller)
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.15)
    fault = bench.fault("encoder_stuck")
    bench.run_for(0.3)
    for _ in range(3):
        bench.drive.clear_fault()
        bench.run_for(0.1)
        assert (bench.drive.state, bench.drive.fault) == ("fault", "encoder")
    fault.clear()  # the rotor still turns
    bench.run_for(0.02)
    bench.drive.clear_fault()
    bench.run_for(0.005)
    assert bench.drive.state == "ready"


# [SR-20] [SR-41]
def test_encoder_that_was_frozen_at_standstill_is_cleared_once_the_shaft_has_been_turned(make_bench):
    bench = make_bench(initial_angle_deg=10.0)
    fault = bench.fault("encoder_stuck")
    bench.drive.speed_reference_rpm = 600
    run_until_fault(bench, 0.3)
    bench.drive.off()
    bench.held_speed_rpm = 0
    bench.run_for(0.1)
    bench.drive.clear_fault()
    bench.run_for(0.05)
    assert bench.drive.fault == "encoder"
    fault.clear()
    bench.held_speed_rpm = 10
    bench.run_for(0.05)
    bench.drive.clear_fault()
    bench.run_for(0.02)
    assert bench.drive.state == "ready"


# [SR-41]
def test_fault_whose_cause_is_gone_for_less_than_10_ms_is_cleared_only_then(bench):
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.1)
    bench.fault("supply_surged", height_percent=50.0, duration_s=0.005)
    bench.run_for(0.0055)
    assert bench.drive.fault == "over_voltage"
    begin_s = bench.time_s
    bench.drive.clear_fault()
    bench.run_until(lambda: bench.drive.state == "ready", timeout=0.05)
    assert 0.008 < bench.time_s - begin_s < 0.0115


# [SR-41]
def test_clear_fault_in_run_is_refused_and_counted(bench):
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.15)
    refused = bench.telemetry["out_of_range"].last
    bench.drive.ask("clear_fault")
    bench.run_for(0.03)
    assert bench.drive.state == "run"
    assert bench.truth["speed_rpm"].last == pytest.approx(600, abs=3)
    bench.run_for(0.1)
    assert bench.telemetry["out_of_range"].last > refused


# --- Healthy encoders ---


# [SR-30]
@pytest.mark.in_turns
@pytest.mark.parametrize(("machine", "controller", "ahead_deg", "flux_linkage_gain", "speed_rpm"), [
    ("linear_cosine", "paper", 2.0, 0.9, 600),
    ("saturating", "salient", 4.0, 0.9, 600),
    (EXAMPLES / "map86.toml", "salient", 4.0, 0.95, 1120),
    (EXAMPLES / "mill.toml", "salient", 4.0, 0.95, 490),
    (EXAMPLES / "traction.toml", "salient", 4.0, 0.95, 640),
])
def test_encoder_ahead_by_its_tolerance_is_no_fault_of_a_machine_with_less_flux_linkage(
        make_bench, machine, controller, ahead_deg, flux_linkage_gain, speed_rpm):
    bench = make_bench(machine=str(machine), controller=controller)
    bench.rig.encoder_offset_deg = ahead_deg
    bench.rig.flux_linkage_gain = flux_linkage_gain
    bench.drive.speed_reference_rpm = speed_rpm
    bench.run_for(1.2)
    assert bench.drive.state == "run"
    assert bench.truth["speed_rpm"].last == pytest.approx(speed_rpm, rel=0.01)


HEALTHY = [
    ("saturating", "salient", 10, True, 600, 12),
    ("saturating", "traditional", 8, False, 60, 8),
    ("finite_element", "paper", 10, False, 30, 8),
    ("finite_element", "salient", 12, False, 10, 5),
    ("finite_element", "traditional", 11, False, 60, 5),
    ("linear_cosine", "paper", 9, True, 1500, 5),
    ("linear_cosine", "salient", 9, False, -1400, -5),
    ("linear_trapezoid", "salient", 20, True, 3000, 2),
    ("saturating", "salient", 17, False, 0, 15),
    ("finite_element", "salient", 10, False, 0, 15),
]
SPECIFIED = {"current_sensor_gain": 1.05, "current_sensor_offset_A": 0.5, "current_noise_A": 0.03,
             "encoder_eccentricity_deg": 0.5, "encoder_offset_deg": 0.3, "flux_linkage_gain": 0.95,
             "resistance_gain": 1.4, "current_sensor_delay_us": 3.0, "supply_voltage_V": 220.0}


# [SR-30]
@pytest.mark.in_turns
@pytest.mark.parametrize("errors", [{}, SPECIFIED], ids=["ideal", "specified_errors"])
@pytest.mark.parametrize(("machine", "controller", "bits", "edges", "speed_rpm", "load_Nm"), HEALTHY)
def test_healthy_encoder_is_no_fault(  # noqa: PLR0913, PLR0917 - a case has as many parameters
        make_bench, machine, controller, bits, edges, speed_rpm, load_Nm, errors):
    bench = make_bench(machine=machine, controller=controller, encoder_bits=bits, encoder_edges=edges,
                       initial_angle_deg=33.0)
    for name, value in errors.items():
        setattr(bench.rig, name, value)
    bench.drive.speed_reference_rpm = speed_rpm
    bench.run_for(0.25)
    bench.load_torque_Nm = load_Nm
    bench.run_for(0.25)
    bench.load_torque_Nm = 0
    bench.run_for(0.1)
    assert (bench.drive.state, bench.drive.fault) == ("run", "none")
