"""Braking into a DC link whose capacitor the field of a phase raises by much: no trip, and no less braking power than
chopper and capacitor can take."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from salient.machine.drive_data import derive
from salient.machine.file import load_machine
from salient.machine.fold_back import field_J

MACHINES = {
    "six_four_48_V": (6, 4, 0.06, 3e-4, 2e-4, 0.15e-3, 1.5e-3, 0.08e-3, 0.040, 120.0, 48.0),
    "eight_six_400_V": (8, 6, 0.25, 0.02, 0.005, 1.9e-3, 20e-3, 0.9e-3, 0.75, 150.0, 400.0),
    "twelve_eight_700_V": (12, 8, 0.05, 0.2, 0.02, 0.6e-3, 7e-3, 0.3e-3, 0.9, 600.0, 700.0),
}
"""Poles, ohm, kg m^2, N m s, inductances in H, flux linkage in Wb at a current in A, V."""

TEXT = """name = "small_link"
[poles]
stator = {}
rotor = {}
[winding]
resistance_ohm = {}
[mechanics]
inertia_kg_m2 = {}
friction_Nm_s = {}
[magnetics]
form = "saturating"
unaligned_inductance_H = {}
aligned_inductance_H = {}
saturated_inductance_H = {}
flux_linkage_max_Wb = {}
current_at_flux_linkage_max_A = {}
[converter]
supply_voltage_V = {}
[dc_link]
source_resistance_ohm = 0.05
"""

SMALL = [
    ("six_four_48_V", 2e-3, None), ("six_four_48_V", 4.7e-3, 20.0),
    ("eight_six_400_V", 1e-3, 30.0), ("eight_six_400_V", 2.5e-3, None), ("eight_six_400_V", 0.6e-3, 30.0),
    ("twelve_eight_700_V", 3e-3, None), ("twelve_eight_700_V", 2e-3, 50.0),
]
"""Capacitor and chopper whose fold-back of 3 % of the trip voltage would end in over_voltage."""


@dataclass(frozen=True)
class Run:
    """A bench of a machine and its data."""

    bench: object
    data: object
    machine: object

    def highest_V(self, from_s: float = 0.0) -> float:
        """As a part of the trip."""
        voltage = self.bench.truth["RIG_TRUTH_BENCH.bus_voltage_V"].between(from_s, self.bench.time_s + 1e-9).value
        return float(np.max(voltage)) / self.data.over_voltage_V

    def braking_W(self, rpm: float) -> float:
        """Mechanical, with the largest braking torque commanded at once at a held speed."""
        self.bench.rig.held_speed_rpm = rpm
        self.bench.run_for(0.1)
        self.bench.drive.torque_reference_Nm = -self.data.torque_peak_Nm
        self.bench.run_for(0.15)
        begin_s = self.bench.time_s
        self.bench.run_for(0.3)
        torque = self.bench.truth["RIG_TRUTH_MOTION.torque_Nm"].between(begin_s, self.bench.time_s).value
        return -float(np.mean(torque)) * rpm * math.pi / 30.0


@pytest.fixture
def make_run(make_bench, tmp_path):
    def make(name: str, capacitance_F: float, chopper_ohm: float | None, rate_hz: int = 40_000) -> Run:
        values = MACHINES[name]
        text = TEXT.format(*values) + f"capacitance_F = {capacitance_F}\n"
        if chopper_ohm is not None:
            text += (f"chopper_resistance_ohm = {chopper_ohm}\nchopper_on_V = {1.15 * values[-1]}\n"
                     f"chopper_off_V = {1.1 * values[-1]}\n")
        file = tmp_path / "small_link.toml"
        file.write_text(text)
        machine = load_machine(file)
        bench = make_bench(machine=str(file), controller="salient", control_rate_hz=rate_hz)
        bench.rig.truth_period_us = 200
        bench.run_for(0.02)
        return Run(bench, derive(machine), machine)

    return make


@pytest.mark.in_turns
@pytest.mark.parametrize("rate_hz", [20_000, 40_000])
@pytest.mark.parametrize(("name", "capacitance_F", "chopper_ohm"), SMALL)
def test_reversal_from_the_highest_speed_fills_a_small_link_without_a_trip(make_run, name, capacitance_F, chopper_ohm,
                                                                            rate_hz):
    run = make_run(name, capacitance_F, chopper_ohm, rate_hz)
    highest_rpm = 0.998 * min(run.data.speed_max_rpm, 60.0 * rate_hz / 25.0 / run.machine.rotor_poles)
    run.bench.drive.speed_reference_rpm = highest_rpm
    run.bench.run_until(lambda: run.bench.truth["speed_rpm"].last > 0.98 * highest_rpm, timeout=3)
    begin_s = run.bench.time_s
    run.bench.drive.speed_reference_rpm = -highest_rpm
    run.bench.run_for(0.3)
    assert (run.bench.drive.state, run.bench.drive.fault) == ("run", "none")
    assert 0.9 < run.highest_V(begin_s) < 0.999
    assert run.bench.truth["speed_rpm"].last < 0.97 * highest_rpm, "it brakes"


@pytest.mark.in_turns
@pytest.mark.parametrize("speed", [0.3, 1.0, 2.0])
@pytest.mark.parametrize(("name", "capacitance_F", "chopper_ohm"), SMALL)
def test_braking_torque_at_once_at_a_held_speed_is_no_trip_and_at_least_half_of_what_a_chopper_takes(
        make_run, name, capacitance_F, chopper_ohm, speed):
    run = make_run(name, capacitance_F, chopper_ohm)
    rpm = speed * run.data.speed_base_rpm
    braking_W = run.braking_W(rpm)
    assert (run.bench.drive.state, run.bench.drive.fault) == ("run", "none")
    assert run.highest_V() < 0.999
    if chopper_ohm is None:
        assert run.highest_V() > 0.85
    else:
        wanted_W = run.data.torque_peak_Nm * rpm * math.pi / 30.0
        taken_W = (1.15 * run.machine.supply_voltage_V) ** 2 / chopper_ohm
        assert 0.5 * min(wanted_W, taken_W) < braking_W < 1.02 * wanted_W


def test_a_strong_chopper_brakes_with_the_whole_torque_though_the_link_is_small(make_run):
    run = make_run("eight_six_400_V", 1.5e-3, 10.0)
    rise = field_J(run.machine, run.data.parameters["current_limit_A"]) / (1.5e-3 * run.data.over_voltage_V**2)
    assert 0.05 < rise < 0.065, "of the trip voltage, by the field of a phase"
    assert run.braking_W(run.data.speed_base_rpm) > 0.95 * 2.0 * math.pi / 60.0 * (
        run.data.torque_peak_Nm * run.data.speed_base_rpm)
    assert run.highest_V() < 0.95


@pytest.mark.parametrize("chopper_ohm", [None, 50.0])
def test_a_large_link_is_filled_to_the_last_three_per_cent(make_run, chopper_ohm):
    run = make_run("twelve_eight_700_V", 10e-3, chopper_ohm)
    run.braking_W(run.data.speed_base_rpm)
    assert run.bench.drive.fault == "none"
    assert 0.97 < run.highest_V() < 0.99
