"""Torque mode: reference, limits, slew rate, change of the mode in a run, protections; a held shaft."""

import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from salient.bench.drive import DriveError
from salient.bench.rig import RigError
from salient.config import CONTROLLERS
from salient.machine.file import load_machine, machine_path

MACHINE = load_machine(machine_path("saturating"))
PERIOD_S = 25e-6
TORQUE_MAX_NM = 19.1


def held(make_bench, speed_rpm, controller="salient", **options):
    """A bench whose shaft has the held speed."""
    bench = make_bench(controller=controller, **options)
    bench.held_speed_rpm = speed_rpm
    bench.run_for(abs(speed_rpm) / 10_000 + 0.005)
    return bench


def mean_torque_Nm(bench, duration_s=0.05):
    bench.run_for(duration_s)
    return bench.truth["torque_Nm"].between(bench.time_s - duration_s, bench.time_s).value.mean()


def reference_Nm(bench):
    return bench.telemetry["DRIVE_TORQUE.torque_reference_Nm"]


# --- reference and limits -------------------------------------------------------------------------------------------

@pytest.mark.parametrize(("controller", "tolerance_Nm"), [("traditional", 0.6), ("paper", 0.15), ("salient", 0.02)])
def test_mean_torque_is_the_reference_without_friction_or_load(make_bench, controller, tolerance_Nm):
    bench = held(make_bench, 600, controller)
    bench.load_torque_Nm = 5  # against the dynamometer, which holds the speed: no matter to the drive
    for torque_Nm in (2, 12):
        bench.drive.torque_reference_Nm = torque_Nm
        bench.run_for(0.05)
        assert mean_torque_Nm(bench) == pytest.approx(torque_Nm, abs=tolerance_Nm)
    assert (bench.drive.state, bench.drive.mode) == ("run", "torque")
    assert bench.telemetry["DRIVE_MOTION.speed_reference_rpm"].last == 0


@pytest.mark.parametrize(("speed_rpm", "torque_Nm"), [(600, -8), (-600, 8), (-600, -8), (0, 5)])
def test_salient_drives_and_brakes_in_both_directions_and_at_standstill(make_bench, speed_rpm, torque_Nm):
    bench = held(make_bench, speed_rpm)
    bench.drive.torque_reference_Nm = torque_Nm
    bench.run_for(0.05)
    assert mean_torque_Nm(bench) == pytest.approx(torque_Nm, abs=0.03)
    assert bench.truth["speed_rpm"].last == pytest.approx(speed_rpm, abs=1e-3)


@pytest.mark.parametrize("controller", ["traditional", "paper"])
def test_negative_torque_is_none_to_a_controller_that_drives_forwards_only(make_bench, controller):
    bench = held(make_bench, 600, controller)
    bench.drive.torque_reference_Nm = -8
    bench.run_for(0.02)
    assert bench.drive.state == "run"
    assert reference_Nm(bench).last == 0
    assert mean_torque_Nm(bench) == pytest.approx(0, abs=0.01)


# [SR-09]
def test_reference_is_limited_to_the_torque_limit(make_bench):
    bench = held(make_bench, 300)
    bench.drive.parameters["torque_max_Nm"] = 7
    for sign in (1, -1):
        bench.drive.torque_reference_Nm = sign * 100
        bench.run_for(0.05)
        assert mean_torque_Nm(bench) == pytest.approx(sign * 7, abs=0.03)


def test_slew_rate_of_the_reference(make_bench):
    bench = held(make_bench, 300)
    bench.drive.parameters["torque_slew_rate_Nm_s"] = 100
    bench.drive.torque_reference_Nm = 0
    bench.run_for(0.01)
    for start_Nm, end_Nm in ((0, 8), (8, -8)):
        start_s = bench.time_s
        bench.drive.torque_reference_Nm = end_Nm
        bench.run_for(abs(end_Nm - start_Nm) / 100 + 0.01)
        ramp = reference_Nm(bench).between(start_s + 0.005, start_s + 0.07)
        slope_Nm_s = np.polyfit(ramp.time_s, ramp.value, 1)[0]
        assert slope_Nm_s == pytest.approx(math.copysign(100, end_Nm - start_Nm), rel=0.01)
        assert reference_Nm(bench).last == pytest.approx(end_Nm, abs=0.02)


# --- the voltage ----------------------------------------------------------------------------------------------------

def voltage_bound_s(torque_Nm, angle_deg):
    """Time in which the supply drives the flux linkage of a phase at standstill to a torque's: the integral of
    d psi / (V - R i)."""
    magnetics, angle_rad = MACHINE.magnetics, math.radians(angle_deg)
    needed_A = brentq(lambda i: float(magnetics.torque_Nm(angle_rad, i)) - torque_Nm, 0.01, 80)

    def rate(i):
        inductance_H = float(magnetics.flux_linkage_Wb(angle_rad, i + 0.01)
                             - magnetics.flux_linkage_Wb(angle_rad, i - 0.01)) / 0.02
        return inductance_H / (MACHINE.supply_voltage_V - MACHINE.resistance_ohm * i)

    return quad(rate, 0.01, needed_A)[0]


@pytest.mark.parametrize("torque_Nm", [10, 15, 19])
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_torque_steps_within_the_bound_of_the_voltage_and_two_periods(make_bench, controller, torque_Nm):
    """From the control interrupt with the new reference, whose voltage acts a period later. Only phase A makes torque
    at this angle. The BP-PID takes a period more: it reduces the duty before the torque is there."""
    bench = make_bench(controller=controller, initial_angle_deg=-22.5)
    bench.held_speed_rpm = 0
    bench.run_for(0.005)
    bench.drive.torque_reference_Nm = 0
    bench.run_for(0.005)
    bench.rig.truth_period_us = 1
    bench.drive.torque_reference_Nm = torque_Nm
    bench.run_for(0.003)
    current, torque = bench.truth["current_a_A"], bench.truth["torque_Nm"]
    start_s = current.time_s[np.argmax(current.value > 0)] - 1e-6
    reached_s = torque.time_s[np.argmax(torque.value > 0.99 * torque_Nm)]
    bound_s = voltage_bound_s(0.99 * torque_Nm, -22.5)
    assert torque.value.max() > 0.99 * torque_Nm
    assert bound_s - 2e-6 < reached_s - start_s  # the voltage does not make it in less
    assert reached_s - start_s + PERIOD_S < bound_s + (3 if controller == "paper" else 2) * PERIOD_S


# --- change of the mode ---------------------------------------------------------------------------------------------

@pytest.mark.parametrize("controller", CONTROLLERS)
def test_torque_mode_begins_in_a_run_without_a_step_of_the_torque(make_bench, controller):
    bench = make_bench(controller=controller)
    bench.drive.parameters["torque_slew_rate_Nm_s"] = 20
    bench.drive.speed_reference_rpm = 300
    bench.run_for(0.2)
    bench.load_torque_Nm = 6
    bench.run_for(0.3)
    before = reference_Nm(bench).between(bench.time_s - 0.05, bench.time_s).value
    assert before.mean() == pytest.approx(6.6, abs=0.3)
    start_s = bench.time_s
    bench.drive.torque_reference_Nm = 12
    bench.run_for(0.1)
    assert (bench.drive.state, bench.drive.mode) == ("run", "torque")
    entry = reference_Nm(bench).between(start_s - 0.001, bench.time_s).value
    assert np.abs(np.diff(entry)).max() <= 20 * 0.001 + np.ptp(before) + 2 / 256
    assert entry[-1] == pytest.approx(before.mean() + 20 * 0.1, abs=0.1 + np.ptp(before))


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_speed_mode_begins_in_a_run_without_a_step_of_the_torque(make_bench, controller):
    """On a held shaft with its speed as the reference, both modes ask for the same torque."""
    bench = held(make_bench, 300, controller)
    bench.drive.torque_reference_Nm = 6
    bench.run_for(0.1)
    start_s = bench.time_s
    bench.drive.speed_reference_rpm = bench.telemetry["DRIVE_MOTION.speed_rpm"].last
    bench.run_for(0.02)
    assert (bench.drive.state, bench.drive.mode) == ("run", "speed")
    leave = reference_Nm(bench).between(start_s - 0.001, bench.time_s).value
    assert leave[0] == pytest.approx(6, abs=0.02)
    assert leave == pytest.approx(6, abs={"traditional": 0.3, "paper": 0.9, "salient": 0.2}[controller])


def test_speed_ramp_begins_at_the_present_speed_after_torque_mode(make_bench):
    bench = make_bench()
    bench.drive.parameters["speed_ramp_rpm_s"] = 500
    bench.drive.torque_reference_Nm = 8
    bench.run_for(0.1)
    start_rpm, start_s = bench.telemetry["DRIVE_MOTION.speed_rpm"].last, bench.time_s
    assert start_rpm > 200
    bench.drive.speed_reference_rpm = 600
    bench.run_for(0.1)
    reference = bench.telemetry["DRIVE_MOTION.speed_reference_rpm"].between(start_s + 0.002, bench.time_s)
    assert reference.value == pytest.approx(start_rpm + 500 * (reference.time_s - start_s), abs=6)
    assert bench.truth["speed_rpm"].value[-20:] == pytest.approx(reference.value[-20:], abs=2)


def test_run_starts_in_torque_mode_from_zero_torque_under_a_load(make_bench):
    bench = make_bench()
    bench.drive.parameters["torque_slew_rate_Nm_s"] = 50
    bench.load_torque_Nm = 8
    bench.run_for(0.02)
    start_s = bench.time_s
    bench.drive.torque_reference_Nm = 8
    bench.run_for(0.02)
    reference = reference_Nm(bench).between(start_s, bench.time_s)
    assert reference.value.max() < 50 * 0.02
    assert (np.diff(reference.value) >= 0).all()


# [SR-06]
def test_stop_in_torque_mode_ends_at_standstill(make_bench):
    bench = make_bench()
    bench.drive.torque_reference_Nm = 8
    bench.run_until(lambda: bench.drive.state == "run", timeout=0.02)
    bench.run_for(0.05)
    assert bench.truth["speed_rpm"].last > 100
    bench.drive.stop()
    bench.run_until(lambda: bench.drive.state == "ready", timeout=0.2)
    assert bench.truth["speed_rpm"].last == pytest.approx(0, abs=10)


# --- protections ----------------------------------------------------------------------------------------------------

# [SR-08]
@pytest.mark.parametrize("sign", [1, -1])
def test_driving_torque_ends_below_the_over_speed_limit(make_bench, sign):
    """Free shaft, no load: the torque is reduced from 7/8 of the limit on, to none at 15/16."""
    bench = make_bench()
    bench.drive.parameters["over_speed_rpm"] = 800
    bench.drive.torque_reference_Nm = sign * 15
    bench.run_for(1.0)
    assert bench.drive.state == "run"
    assert 800 * 7 / 8 < sign * bench.truth["speed_rpm"].last < 800 * 15 / 16
    drag_Nm = MACHINE.friction_Nm_s * abs(bench.truth["speed_rpm"].last) * math.pi / 30
    assert sign * mean_torque_Nm(bench) == pytest.approx(drag_Nm, abs=0.05)


# [SR-08]
def test_shaft_driven_by_its_load_ends_in_over_speed(make_bench):
    bench = make_bench()
    bench.drive.parameters["over_speed_rpm"] = 800
    bench.drive.torque_reference_Nm = 2
    bench.load_torque_Nm = -6
    bench.run_until(lambda: bench.drive.state == "fault", timeout=1)
    assert bench.drive.fault == "over_speed"


# [SR-05]
def test_commands_that_stop_coming_end_torque_mode(make_bench):
    bench = held(make_bench, 300)
    bench.drive.torque_reference_Nm = 5
    bench.run_for(0.05)
    bench.drive.silence()
    bench.run_for(0.49)
    assert bench.drive.state == "run"
    bench.run_for(0.02)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "command_timeout")
    assert mean_torque_Nm(bench) == pytest.approx(0, abs=1e-6)


def test_reference_beyond_the_range_of_the_signal_is_refused(make_bench):
    bench = make_bench()
    with pytest.raises(DriveError, match=r"torque_reference_Nm 200: must be -128 to 128 N m"):
        bench.drive.torque_reference_Nm = 200


def test_held_shaft_does_not_change_what_the_drive_has_learned(make_bench):
    """The speed of a held shaft does not show the ripple of the torque."""
    bench = held(make_bench, 300, encoder_bits=20)
    bench.rig.encoder_offset_deg = 0.3
    bench.drive.torque_reference_Nm = 8
    bench.run_for(0.5)
    assert bench.telemetry["DRIVE_ADAPTATION.misalignment_deg"].last == 0


# --- the dynamometer ------------------------------------------------------------------------------------------------

def test_dynamometer_holds_the_speed_and_shows_what_it_takes(bench):
    assert math.isnan(bench.held_speed_rpm)
    bench.held_speed_rpm = 600
    bench.drive.torque_reference_Nm = 10
    bench.run_for(0.05)
    assert bench.truth["speed_rpm"].last == pytest.approx(10_000 * 0.05, abs=1)
    bench.run_for(0.1)
    assert bench.truth["speed_rpm"].value[-50:] == pytest.approx(600, abs=1e-3)
    drag_Nm = MACHINE.friction_Nm_s * 600 * math.pi / 30
    assert mean_torque_Nm(bench) == pytest.approx(10, abs=0.03)
    taken_Nm = bench.truth["load_torque_Nm"].value[-50:].mean()
    assert taken_Nm == pytest.approx(10 - drag_Nm, abs=0.03)
    assert bench.telemetry["load_torque_estimate_Nm"].last == pytest.approx(10 - drag_Nm, abs=0.1)
    bench.held_speed_rpm = math.nan
    bench.run_for(0.01)
    assert bench.truth["speed_rpm"].last == pytest.approx(600 + (10 - drag_Nm) / 0.02 * 0.01 * 30 / math.pi, rel=0.02)
    assert bench.truth["load_torque_Nm"].last == 0


def test_held_speed_beyond_its_range_is_refused(bench):
    with pytest.raises(RigError, match="held_speed_rpm 100000: must be"):
        bench.held_speed_rpm = 1e5
    with pytest.raises(RigError, match="load_torque_Nm nan"):
        bench.load_torque_Nm = math.nan
