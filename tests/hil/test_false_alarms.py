"""Healthy drives that are no fault: most are a seed of `tools/salient campaign --healthy` that tripped once."""

from __future__ import annotations

import pytest

from salient.experiments.campaign.runner import run_world, world
from salient.experiments.compare.every_machine import EXAMPLES


def expect_no_fault(seed: int, machine: str, controller: str, rate_hz: int) -> None:
    drawn = world(seed, kind="healthy")
    assert (drawn["machine"], drawn["controller"], drawn["control_rate_hz"]) == (machine, controller, rate_hz)
    result = run_world(seed, kind="healthy")
    assert result["violations"] == [] and result["causes"] == []
    assert result["virtual_us"] == pytest.approx(drawn["duration_us"], abs=1000)


@pytest.mark.in_turns
@pytest.mark.parametrize(("seed", "machine", "controller"), [
    (323, "linear_cosine", "paper"), (655, "random_07", "paper"), (716, "random_07", "traditional"),
    (350, "random_08", "paper"), (1625, "saturating", "paper"), (5988, "map86", "traditional")])
def test_no_current_reaches_the_trip_at_20_khz(seed, machine, controller):
    expect_no_fault(seed, machine, controller, 20_000)


@pytest.mark.in_turns
@pytest.mark.parametrize(("seed", "machine", "controller", "rate_hz"), [
    (8679, "saturating", "salient", 20_000), (46979, "finite_element", "salient", 20_000),
    (14057, "random_01", "traditional", 20_000)])
def test_currents_that_end_between_two_checks_do_not_contradict_the_angle(seed, machine, controller, rate_hz):
    expect_no_fault(seed, machine, controller, rate_hz)


@pytest.mark.in_turns
@pytest.mark.parametrize(("seed", "machine", "controller", "rate_hz"), [
    (164, "fan12", "paper", 50_000), (2712, "spindle", "paper", 100_000), (2425, "random_01", "traditional", 20_000),
    (10423, "spindle", "salient", 100_000), (13801, "traction", "paper", 40_000)])
def test_drift_of_slow_strokes_is_neither_an_encoder_ahead_nor_a_sensor(seed, machine, controller, rate_hz):
    expect_no_fault(seed, machine, controller, rate_hz)


def test_pulses_too_short_for_the_devices_are_no_frozen_encoder():
    expect_no_fault(7015, "traction", "paper", 40_000)


def test_pulses_too_short_for_the_devices_at_100_khz_are_no_open_phase(make_bench):
    bench = make_bench(machine="finite_element", controller="salient", control_rate_hz=100_000)
    bench.drive.parameters["pulses_per_period"] = 1
    bench.drive.speed_reference_rpm = 150
    bench.run_for(0.13)
    bench.load_torque_Nm = 8.0
    bench.run_for(0.1)
    assert bench.drive.state == "run"
    assert 149 < bench.truth["speed_rpm"].last < 151


def test_a_load_held_for_longer_than_a_second_by_warm_windings_is_no_frozen_encoder(make_bench):
    bench = make_bench(machine=EXAMPLES / "servo86.toml", controller="traditional", encoder_bits=13)
    bench.rig.resistance_gain = 1.28
    bench.drive.speed_reference_rpm = 0
    bench.load_torque_Nm = 17.8
    bench.run_for(1.2)
    assert bench.drive.state == "run"
    assert bench.truth["speed_rpm"].last == pytest.approx(0, abs=30)


@pytest.mark.parametrize("angle_deg", [12.0, 84.0, 204.0])
def test_a_heavy_rotor_before_its_first_count_at_100_khz_is_no_frozen_encoder(make_bench, angle_deg):
    bench = make_bench(machine=EXAMPLES / "traction.toml", controller="paper", control_rate_hz=100_000,
                       encoder_bits=11, initial_angle_deg=angle_deg)
    bench.rig.inertia_gain = 1.7
    bench.drive.speed_reference_rpm = 60
    bench.run_for(0.05)
    assert bench.drive.state == "run"
    assert 50 < bench.truth["speed_rpm"].last < 70


def test_a_start_along_a_ramp_at_the_torque_limit_is_no_stall(make_bench):
    bench = make_bench(machine="saturating", controller="traditional")
    bench.rig.inertia_gain = 3.0
    bench.drive.parameters["speed_ramp_rpm_s"] = 17_000
    bench.drive.speed_reference_rpm = 3000
    bench.run_for(0.4)
    assert bench.drive.state == "run"
    assert 800 < bench.truth["speed_rpm"].last < 2000
