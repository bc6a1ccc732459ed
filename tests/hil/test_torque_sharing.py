"""Torque sharing with the windows of the machine: copper loss against its bound, smooth torque up to the limit, also of
machines whose poles overlap in a part of the half only."""

from __future__ import annotations

import math

import numpy as np
import pytest

from salient.experiments.compare.random_maps import random_map_files
from salient.machine.drive_data import derive
from salient.machine.file import load_machine, machine_path
from salient.machine.torque_speed import smooth_torque_Nm
from salient.reference.copper_bound import least_square_A2

NARROW_64, NARROW_86, NARROW_128 = (str(path) for path in random_map_files(range(3)))
RPM = 30.0 / math.pi


def held(bench, machine, speed_rpm: float, torque_Nm: float):
    """Torque and sum of the squares of the currents over whole electrical revolutions of a held shaft."""
    turn_s = 60.0 / (speed_rpm * machine.rotor_poles)
    bench.held_speed_rpm = speed_rpm
    bench.run_for(0.02 + speed_rpm / 10_000.0)
    bench.drive.torque_reference_Nm = torque_Nm
    bench.run_for(max(0.15, turn_s))
    bench.rig.truth_period_us = 50 if turn_s > 0.02 else 10
    bench.run_for(0.001)
    begin_s = bench.time_s
    window_s = math.ceil(0.02 / turn_s) * turn_s
    bench.run_for(window_s)
    made_Nm = bench.truth["torque_Nm"].between(begin_s, begin_s + window_s).value
    square_A2 = sum(np.mean(bench.truth[f"current_{'abcd'[phase]}_A"].between(begin_s, begin_s + window_s).value ** 2)
                    for phase in range(machine.phases))
    return np.asarray(made_Nm, dtype=float), float(square_A2)


@pytest.mark.in_turns
@pytest.mark.parametrize(("name", "of_base", "part", "ripple_max"), [
    ("saturating", 0.1, 0.5, 0.01), ("finite_element", 0.1, 0.5, 0.012), ("finite_element", 1.0, 0.25, 0.035),
    (NARROW_64, 0.1, 0.5, 0.01), (NARROW_64, 1.0, 0.5, 0.04), (NARROW_86, 0.5, 0.25, 0.04),
    (NARROW_128, 0.1, 0.75, 0.01), (NARROW_128, 1.0, 0.75, 0.04)])
def test_sum_of_squares_of_the_currents_is_within_6_percent_of_the_least_without_ripple(
        make_bench, name, of_base, part, ripple_max):
    machine = load_machine(machine_path(name))
    data = derive(machine)
    speed_rpm, torque_Nm = of_base * data.speed_base_rpm, part * data.torque_rated_Nm
    made_Nm, square_A2 = held(make_bench(machine=name, controller="salient"), machine, speed_rpm, torque_Nm)
    assert made_Nm.mean() == pytest.approx(torque_Nm, rel=0.01)
    assert np.ptp(made_Nm) < ripple_max * torque_Nm
    least_A2 = least_square_A2(machine, made_Nm.mean(), speed_rpm / RPM, machine.supply_voltage_V,
                               data.parameters["current_limit_A"])
    assert 0.98 < square_A2 / least_A2 < 1.06


@pytest.mark.in_turns
@pytest.mark.parametrize("name", [NARROW_64, NARROW_128])
def test_largest_torque_by_default_is_made_at_every_angle_and_is_what_the_current_limit_gives(make_bench, name):
    machine = load_machine(machine_path(name))
    data = derive(machine)
    largest_Nm = data.parameters["torque_max_Nm"]
    smooth_Nm = smooth_torque_Nm(machine.magnetics, machine.phases, data.parameters["current_limit_A"])
    assert 0.969 * smooth_Nm <= largest_Nm <= smooth_Nm
    made_Nm, _ = held(make_bench(machine=name, controller="salient"), machine, 0.05 * data.speed_base_rpm, largest_Nm)
    assert 0.99 * largest_Nm < made_Nm.min() and made_Nm.max() < 1.02 * largest_Nm


def test_narrow_poles_carry_most_of_the_largest_load_at_low_speed_without_a_stall(make_bench):
    data = derive(load_machine(machine_path(NARROW_128)))
    bench = make_bench(machine=NARROW_128, controller="salient")
    speed_rpm = round(0.05 * data.speed_base_rpm, 2)
    bench.drive.speed_reference_rpm = speed_rpm
    bench.at(0.3).load_torque_Nm = 0.9 * data.parameters["torque_max_Nm"]
    bench.run_for(1.5)
    assert bench.drive.state == "run"
    speeds_rpm = bench.truth["speed_rpm"].between(0.6, 1.5).value
    assert speeds_rpm.mean() == pytest.approx(speed_rpm, rel=0.01)
    assert speeds_rpm.min() > 0.8 * speed_rpm


def test_paper_leaves_out_the_angles_without_torque(make_bench):
    machine = load_machine(machine_path(NARROW_128))
    data = derive(machine)
    speed_rpm, torque_Nm = 0.1 * data.speed_base_rpm, 0.5 * data.torque_rated_Nm
    made_Nm, square_A2 = held(make_bench(machine=NARROW_128, controller="paper"), machine, speed_rpm, torque_Nm)
    assert made_Nm.mean() == pytest.approx(torque_Nm, rel=0.06)
    least_A2 = least_square_A2(machine, made_Nm.mean(), speed_rpm / RPM, machine.supply_voltage_V,
                               data.parameters["current_limit_A"])
    assert 0.98 < square_A2 / least_A2 < 1.5
