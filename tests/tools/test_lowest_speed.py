"""The lowest speed that a coarse encoder allows."""

from __future__ import annotations

import numpy as np
import pytest

from salient.machine.definition import Machine
from salient.machine.file import load_machine, machine_path
from salient.machine.lowest_speed import error_growth_1_s, lowest_speed_rpm


def test_the_growth_is_that_of_the_steepest_torque_over_the_angle_at_fixed_currents():
    # With the windows of the least current: 25.1 N m / rad on 0.02 kg m^2, 123.7 on 0.00401.
    assert error_growth_1_s(load_machine(machine_path("saturating"))) == pytest.approx(35.4, rel=0.03)
    assert error_growth_1_s(load_machine(machine_path("finite_element"))) == pytest.approx(175.6, rel=0.03)


def test_a_heavier_rotor_is_steady_at_lower_speeds(monkeypatch):
    machine: Machine = load_machine(machine_path("saturating"))
    growth = error_growth_1_s(machine)
    assert error_growth_1_s(type(machine)(**{**vars(machine), "inertia_kg_m2": 4 * machine.inertia_kg_m2})) == (
        pytest.approx(growth / 2.0))


def test_the_lowest_speed_halves_with_each_bit_and_is_higher_without_smooth_torque():
    of_bits = [lowest_speed_rpm("finite_element", bits, "salient") for bits in range(8, 13)]
    assert np.diff(np.log2(of_bits)) == pytest.approx(-1.0, abs=0.02)  # rounded up to 0.01 r/min
    assert of_bits[1] == pytest.approx(60.0 * 175.6 / 4.5 / 512.0, rel=0.03)
    assert lowest_speed_rpm("finite_element", 9, "paper") == pytest.approx(2.0 * of_bits[1], abs=0.02)
    assert lowest_speed_rpm("finite_element", 9, "traditional") == pytest.approx(3.0 * of_bits[1], abs=0.03)
    for bits in (0, 13, 17):
        assert lowest_speed_rpm("finite_element", bits, "salient") == 0.0
