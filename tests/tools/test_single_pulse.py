"""The tables of single pulse operation, compared with a simulation that shares no code with their generator: small
steps, one pulse at a time, the braking envelope by its definition."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from salient.experiments.compare.random_machines import COUNT, random_machine
from salient.machine.definition import Machine
from salient.machine.drive_data import derive
from salient.machine.file import load_machine
from salient.machine.partial_pulse import PARTS, PartialPulse, partial_pulse
from salient.machine.pulse_tables import PulseTables, in_units, pulse_tables
from salient.machine.scaling import Exponents, scaling_of
from salient.machine.sharing_window import sharing_window
from salient.machine.single_pulse import POINTS, SinglePulse, single_pulse
from salient.paths import MACHINES, ROOT

FILES = [*sorted(MACHINES.glob("*.toml")), *sorted((ROOT / "tools" / "examples" / "machines").glob("*.toml")),
         *sorted((ROOT / "tests" / "machines").glob("*.toml"))]
COMPARED = ("finite_element", "servo86")
STEP_DEG = 0.5
BEGIN_DEG = np.array([180.0, 360.0])
"""Start of the halves: motoring, braking."""
CURRENT_OVER = 1.03


# --- simulation -----------------------------------------------------------------------------------------------------

@dataclass(frozen=True)
class Result:
    """Result of pulses."""

    mean_Nm: np.ndarray
    least_Nm: np.ndarray
    """And largest: sum of all phases over a stroke."""
    largest_Nm: np.ndarray
    rms_A: np.ndarray
    largest_A: np.ndarray
    end_deg: np.ndarray
    """Last angle with flux linkage."""


class Simulation:
    """One phase of a machine at a voltage."""

    def __init__(self, machine: Machine) -> None:
        self.machine, self.limit_A = machine, derive(machine).parameters["current_limit_A"]
        self.angle_deg = np.arange(0.0, 360.0, STEP_DEG)
        self.grid_A = np.linspace(0.0, 1.5 * self.limit_A, 400)
        self.grid_Wb = machine.magnetics.flux_linkage_Wb(self.rad(self.angle_deg)[:, None], self.grid_A)
        self.limit_Wb = machine.magnetics.flux_linkage_Wb(self.rad(self.angle_deg), self.limit_A)

    def rad(self, angle_deg: np.ndarray) -> np.ndarray:
        """Rotor angle of an electrical one."""
        return angle_deg / 360.0 * self.machine.pitch_rad

    def cap_Wb(self, speed_rad_s: float) -> np.ndarray:
        """By angle from 0 to 540 degrees: the largest flux linkage that keeps the current within its limit under full
        opposite voltage, until the unaligned position."""
        angle_deg = np.arange(0.0, 540.0 + STEP_DEG, STEP_DEG)
        limit_Wb = self.limit_Wb[np.arange(len(angle_deg)) % len(self.limit_Wb)]
        fall_Wb = self.machine.supply_voltage_V / speed_rad_s * self.rad(angle_deg)
        return np.minimum.accumulate((limit_Wb + fall_Wb)[::-1])[::-1] - fall_Wb

    def run(self, speed_rad_s: float, on_deg: np.ndarray, off_deg: np.ndarray) -> Result:
        machine, converter = self.machine, self.machine.converter
        step_s = self.rad(np.array(STEP_DEG)) / speed_rad_s
        cap_Wb = self.cap_Wb(speed_rad_s)
        flux_Wb, current_A = np.zeros(on_deg.shape), np.zeros(on_deg.shape)
        end_deg = np.zeros(on_deg.shape)
        first, count = int(40.0 / STEP_DEG), 2 * len(self.angle_deg)
        currents_A = np.zeros((count, *on_deg.shape))
        for at in range(1, count):
            angle_deg = (first + at) * STEP_DEG
            rise = np.clip((angle_deg - on_deg) / STEP_DEG, 0.0, 1.0)
            fall = np.clip((angle_deg - off_deg) / STEP_DEG, 0.0, 1.0)
            rise = rise - fall
            supply_V = machine.supply_voltage_V
            rise_V = supply_V - 2.0 * converter["switch_drop_V"] - current_A * (
                machine.resistance_ohm + 2.0 * converter["switch_resistance_ohm"])
            fall_V = supply_V + 2.0 * converter["diode_drop_V"] + current_A * (
                machine.resistance_ohm + 2.0 * converter["diode_resistance_ohm"])
            next_Wb = flux_Wb + (rise * rise_V - fall * fall_V) * step_s
            if first + at < len(cap_Wb):
                chopped_Wb = np.maximum(cap_Wb[first + at], flux_Wb - fall_V * step_s)
                next_Wb = np.where(rise > 0.0, np.minimum(next_Wb, chopped_Wb), next_Wb)
            flux_Wb = np.maximum(next_Wb, 0.0)
            end_deg = np.where(flux_Wb > 0.0, angle_deg, end_deg)
            current_A = np.interp(flux_Wb, self.grid_Wb[(first + at) % len(self.angle_deg)], self.grid_A)
            currents_A[at] = current_A
        angles_rad = self.rad((first + np.arange(count)) * STEP_DEG)[:, None]
        torque_Nm = machine.magnetics.torque_Nm(angles_rad, currents_A)
        stroke_Nm = torque_Nm.reshape(-1, len(self.angle_deg) // machine.phases, *on_deg.shape).sum(axis=0)
        return Result(stroke_Nm.mean(axis=0), stroke_Nm.min(axis=0), stroke_Nm.max(axis=0),
                      np.sqrt((currents_A**2).sum(axis=0) / len(self.angle_deg)), currents_A.max(axis=0), end_deg)


# --- machines -------------------------------------------------------------------------------------------------------

@lru_cache
def simulation(name: str) -> Simulation:
    (path,) = (path for path in FILES if path.stem == name)
    return Simulation(load_machine(path))


@lru_cache
def pulses(name: str) -> SinglePulse:
    machine = simulation(name).machine
    return single_pulse(machine, derive(machine))


def speeds(name: str) -> np.ndarray:
    """Speeds of the points, rad/s."""
    return pulses(name).speed_per_voltage * simulation(name).machine.supply_voltage_V


def at_point(name: str, point: int) -> Result:
    """Simulation of both pulses of a point."""
    on_deg, off_deg = BEGIN_DEG - pulses(name).lead_deg[:, point], BEGIN_DEG + pulses(name).end_deg[:, point]
    return simulation(name).run(speeds(name)[point], on_deg, off_deg)


# --- torque ---------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("name", COMPARED)
@pytest.mark.parametrize("point", [1, 4, 8, 11, 14, 16])
def test_torques_are_those_of_the_pulse(name: str, point: int):
    found, of = at_point(name, point), pulses(name)
    assert of.mean_Nm[:, point] == pytest.approx(np.abs(found.mean_Nm), rel=0.01)
    assert of.peak_Nm[:, point] == pytest.approx(np.maximum(found.largest_Nm, -found.least_Nm), rel=0.02)


@pytest.mark.in_turns
@pytest.mark.parametrize("name", COMPARED)
@pytest.mark.parametrize("point", [3, 8, 12, 16])
@pytest.mark.parametrize("half", [0, 1], ids=["motoring", "braking"])
def test_no_pair_of_angles_makes_more_torque_and_none_as_much_with_less_current(name: str, point: int, half: int):
    lead_deg, end_deg = (grid.ravel() for grid in np.meshgrid(np.arange(0.0, 150.0, 5.0), np.arange(20.0, 180.0, 5.0)))
    others = simulation(name).run(speeds(name)[point], BEGIN_DEG[half] - lead_deg, BEGIN_DEG[half] + end_deg)
    allowed = (others.largest_A <= CURRENT_OVER * simulation(name).limit_A) & (
        others.end_deg < BEGIN_DEG[half] - lead_deg + 360.0)
    torque_Nm = np.where(allowed, np.abs(others.mean_Nm), 0.0)
    found = at_point(name, point)
    assert 0.995 * torque_Nm.max() < abs(found.mean_Nm[half]) < 1.01 * torque_Nm.max()
    as_good = torque_Nm >= abs(found.mean_Nm[half])
    assert found.rms_A[half] < 1.01 * others.rms_A[as_good].min(initial=math.inf)
    assert found.rms_A[half] > 0.95 * others.rms_A[torque_Nm.argmax()]


@pytest.mark.in_turns
@pytest.mark.parametrize("name", COMPARED)
@pytest.mark.parametrize("point", [2, 6, 10, 15])
def test_smooth_torque_is_the_largest_minimum_without_lead(name: str, point: int):
    ends_deg = np.arange(50.0, 180.0, 4.0)
    for half, sign in enumerate((1.0, -1.0)):
        begin_deg = np.full(ends_deg.shape, BEGIN_DEG[half])
        found = simulation(name).run(speeds(name)[point], begin_deg, begin_deg + ends_deg)
        least_Nm = (found.least_Nm if sign > 0.0 else -found.largest_Nm).max()
        assert pulses(name).smooth_Nm[half, point] == pytest.approx(least_Nm, rel=0.03)


def test_torques_are_those_of_a_bound_found_elsewhere():
    """finite_element, ideal converter, 240 V, 52 A: best on and off angles by a program in C."""
    machine = simulation("finite_element").machine
    ideal = replace(machine, converter=dict.fromkeys(machine.converter, 0.0))
    of = single_pulse(ideal, replace(derive(ideal), speed_base_rpm=3700.0))
    speed_rpm = of.speed_per_voltage * 240.0 * 30.0 / math.pi
    for rpm, expected_Nm in ((1000.0, 30.0), (2000.0, 29.3), (2500.0, 28.9), (2900.0, 28.5), (4000.0, 23.4),
                             (6000.0, 15.4)):
        assert np.interp(rpm, speed_rpm, of.mean_Nm[0]) == pytest.approx(expected_Nm, rel=0.02)


# --- braking envelope -----------------------------------------------------------------------------------------------

@pytest.mark.parametrize("name", COMPARED)
@pytest.mark.parametrize("point", [14, 15, 16])
def test_current_reaches_its_limit_from_the_envelope_and_exceeds_it_from_above(name: str, point: int):
    """Under full opposite voltage alone, without resistance and drops, which lower the current."""
    of, speed_rad_s = pulses(name), speeds(name)[point]
    sim = simulation(name)
    per_deg_Wb = sim.machine.supply_voltage_V / speed_rad_s * sim.rad(np.array(1.0))
    for before_deg in (0.0, 20.0, 40.0, 60.0):
        for factor, low, high in ((1.0, 0.99, 1.01), (1.05, 1.02, 1.5), (0.95, 0.7, 0.99)):
            currents_A = []
            start_Wb = factor * (of.braking_flux_Wb[point] + per_deg_Wb * before_deg)
            for angle_deg in np.arange(of.braking_end_deg[point] - before_deg, 180.0, STEP_DEG):
                gone_deg = angle_deg - (of.braking_end_deg[point] - before_deg)
                row = round(angle_deg / STEP_DEG)
                flux_Wb = max(start_Wb - per_deg_Wb * gone_deg, 0.0)
                currents_A.append(np.interp(flux_Wb, sim.grid_Wb[row], sim.grid_A))
            assert low < max(currents_A) / sim.limit_A < high, (before_deg, factor)


@pytest.mark.parametrize("name", COMPARED)
def test_envelope_needs_nothing_at_low_speed_and_comes_nearer_with_the_speed(name: str):
    of = pulses(name)
    sim, per_Wb = simulation(name), np.diff(simulation(name).limit_Wb[: len(simulation(name).limit_Wb) // 2 + 1])
    assert np.all(np.diff(of.braking_end_deg) >= 0.0) and np.all(np.diff(of.braking_flux_Wb) <= 0.0)
    steepest_deg = of.braking_end_deg[0]
    assert per_Wb[round(steepest_deg / STEP_DEG)] == pytest.approx(per_Wb.min(), rel=0.02)
    line_Wb = sim.machine.supply_voltage_V / speeds(name)[1:] * sim.rad(np.array(STEP_DEG))
    needs_nothing = line_Wb > -per_Wb.min()
    assert 0 < needs_nothing.sum() < POINTS - 1
    assert np.all(of.braking_end_deg[1:][needs_nothing] == steepest_deg)
    assert np.all(of.braking_end_deg[1:][~needs_nothing] > steepest_deg)


# --- parts of the largest torque ------------------------------------------------------------------------------------

@lru_cache
def parts(name: str) -> PartialPulse:
    machine = simulation(name).machine
    return partial_pulse(machine, derive(machine), pulses(name), sharing_window(machine, derive(machine)))


@pytest.mark.in_turns
def test_voltage_makes_each_part_of_the_torque_between_its_angles_whose_reference_is_raised():
    """The reference takes away what is too much. Where it is not raised, it shapes the current instead."""
    compared = 0
    for name in (*COMPARED, "linear_cosine"):
        of = parts(name)
        base = int(np.searchsorted(pulses(name).speed_per_voltage, pulses(name).base_speed_per_voltage))
        for half in (0, 1):
            for point in range(base, POINTS, 2):
                raised = of.ripple[half, :, point] > 0.1
                found = simulation(name).run(speeds(name)[point], BEGIN_DEG[half] + of.on_deg[half, :, point],
                                             BEGIN_DEG[half] + of.off_deg[half, :, point])
                made = np.abs(found.mean_Nm) / pulses(name).mean_Nm[half, point] / PARTS
                assert np.all(made[raised] > 0.94), (name, half, point, made)
                assert np.all(found.largest_A[raised] < 1.05 * simulation(name).limit_A), (name, half, point)
                compared += int(raised.sum())
    assert compared >= 15


@pytest.mark.in_turns
def test_a_saturating_machine_makes_parts_by_smooth_torque_and_one_with_a_sine_of_the_angle_by_narrower_pulses():
    for name, narrow, raised in (("saturating", False, 0.01), ("linear_cosine", True, 0.2)):
        of = pulses(name)
        at = np.searchsorted(of.speed_per_voltage, 1.3 * of.base_speed_per_voltage)
        part = parts(name)
        assert np.all(np.abs(part.ripple[:, :, at]) < raised), name
        width_deg = part.off_deg[0, :, at] - part.on_deg[0, :, at]
        assert np.all((width_deg < 130.0) == narrow), name
    assert np.all(parts("linear_cosine").ripple[0, :, at] > 0.015)


# --- every machine --------------------------------------------------------------------------------------------------

def every_machine(folder: Path) -> list[Path]:
    """The bundled ones, the examples, the extremes and random ones."""
    numbers = range(0, COUNT, 3)
    files = [folder / f"random_{number:02}.toml" for number in numbers]
    for number, file in zip(numbers, files, strict=True):
        file.write_text(random_machine(number))
    return [*FILES, *files]


@pytest.mark.in_turns
def test_pulses_of_every_machine_are_in_order_and_good_between_the_points(tmp_path: Path):
    for path in every_machine(tmp_path):
        machine = load_machine(path)
        data = derive(machine)
        of, sim = single_pulse(machine, data), Simulation(machine)
        context = path.stem
        assert np.array_equal(of.lead_deg[:, 0], [0.0, 0.0]), context
        assert np.all((of.lead_deg >= 0.0) & (of.lead_deg <= [[120.0], [160.0]])), context
        assert np.all((of.end_deg > 0.0) & (of.end_deg <= 180.0)), context
        assert np.all(of.lead_deg + of.end_deg < 320.0), context
        assert np.all((of.smooth_Nm >= 0.0) & (of.smooth_Nm <= 1.01 * of.mean_Nm)), context
        assert np.all(of.mean_Nm <= of.peak_Nm), context
        assert np.all(np.diff(of.mean_Nm, axis=1) <= 0.006 * of.mean_Nm[:, :-1]), context
        assert np.all(of.smooth_Nm[:, 0] >= data.torque_peak_Nm), context
        base = np.searchsorted(of.speed_per_voltage * machine.supply_voltage_V, data.speed_base_rpm * math.pi / 30.0)
        assert 3 <= base <= 6, context
        if "speed_base_rpm" not in machine.drive:
            assert np.all(of.mean_Nm[:, base] > 0.9 * of.mean_Nm[:, 0]), context
        assert np.all((of.braking_end_deg > 30.0) & (of.braking_end_deg <= 180.0)), context
        part = partial_pulse(machine, data, of, sharing_window(machine, data))
        assert np.all((part.on_deg > -160.0) & (part.on_deg < 80.0)), context
        assert np.all((part.off_deg > 30.0) & (part.off_deg <= 180.0)), context
        assert np.all(part.off_deg - part.on_deg > 20.0), context
        assert np.all((part.ripple > -0.25) & (part.ripple < 2.0)), context

        for point in (0, 5, 8, 11, 15):
            middle = [0.5 * (values[..., point] + values[..., point + 1]) for values in (
                of.speed_per_voltage * machine.supply_voltage_V, of.lead_deg, of.end_deg, of.mean_Nm)]
            speed_rad_s, lead_deg, end_deg, mean_Nm = middle
            found = sim.run(float(speed_rad_s), BEGIN_DEG - lead_deg, BEGIN_DEG + end_deg)
            assert np.abs(found.mean_Nm) == pytest.approx(mean_Nm, rel=0.03), (context, point)
            assert np.all(found.largest_A <= CURRENT_OVER * sim.limit_A), (context, point)
            assert np.all(found.end_deg < BEGIN_DEG - lead_deg + 360.0), (context, point)


@pytest.mark.in_turns
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("change", [
    {"resistance_ohm": 40.0},
    {"supply_voltage_V": 10.0, "converter": {"switch_drop_V": 5.0, "switch_resistance_ohm": 1.0, "diode_drop_V": 5.0,
                                             "diode_resistance_ohm": 1.0, "minimum_pulse_ns": 0.0}},
    {"drive": {"speed_base_rpm": 8000.0}}, {"drive": {"speed_base_rpm": 10.0}},
    {"drive_parameters": {"current_limit_A": 0.5}},
], ids=lambda change: next(iter(change)))
def test_machine_of_odd_proportions_has_pulses_in_order(change: dict):
    machine = load_machine(MACHINES / "saturating.toml")
    machine = replace(machine, **change)
    of = single_pulse(machine, derive(machine))
    for values in vars(of).values():
        assert np.all(np.isfinite(values)) and np.all(np.asarray(values) >= 0.0)
    assert np.all(of.lead_deg + of.end_deg < 360.0)
    assert np.all(of.mean_Nm[:, 0] >= 0.995 * of.mean_Nm.max(axis=1)) and np.all(of.mean_Nm <= of.peak_Nm)
    assert np.all(of.smooth_Nm <= 1.01 * of.mean_Nm)
    part = partial_pulse(machine, derive(machine), of, sharing_window(machine, derive(machine)))
    for values in vars(part).values():
        assert values.shape == (2, len(PARTS), POINTS) and np.all(np.isfinite(values))
    assert np.all((part.off_deg > part.on_deg) & (part.off_deg <= 180.0) & (part.ripple > -1.0))


# --- units ----------------------------------------------------------------------------------------------------------

def index_q8(tables: PulseTables, exponents: Exponents, speed_rad_s: float, voltage_V: float) -> int:
    """As the firmware computes it."""
    speed_q22 = round(math.ldexp(speed_rad_s, 22 - exponents.speed))
    voltage_q6 = round(math.ldexp(voltage_V, 6 - exponents.voltage))
    return ((speed_q22 * tables.index_scale) >> 32) // voltage_q6


@pytest.mark.in_turns
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_tables_are_the_pulses_in_the_units_of_the_machine(path: Path):
    machine = load_machine(path)
    scaling = scaling_of(path, machine)
    of, exponents = single_pulse(machine, scaling.data), scaling.exponents
    part = partial_pulse(machine, scaling.data, of, sharing_window(machine, scaling.data))
    tables = in_units(of, part, exponents)
    assert 1 << 20 < tables.index_scale < 1 << 31
    for share in (0.7, 1.0, 1.1):
        voltage_V = share * machine.supply_voltage_V
        for point in (0, 1, 7, 16):
            index = index_q8(tables, exponents, of.speed_per_voltage[point] * voltage_V, voltage_V)
            assert abs(index - 256 * point) <= 1 + 0.003 * index
    assert tables.pulse[..., 0] * 360.0 / 65536.0 == pytest.approx(of.lead_deg, abs=0.003)
    assert tables.pulse[..., 1] * 360.0 / 65536.0 == pytest.approx(of.end_deg, abs=0.003)
    for column, torque_Nm in ((2, of.smooth_Nm), (3, of.mean_Nm), (4, of.peak_Nm)):
        lsb_Nm = math.ldexp(1.0, exponents.torque - 8)
        assert tables.pulse[..., column] * lsb_Nm == pytest.approx(torque_Nm, abs=0.501 * lsb_Nm)
        assert lsb_Nm < 1e-3 * scaling.data.torque_peak_Nm
    assert tables.braking_end * 360.0 / 65536.0 == pytest.approx(of.braking_end_deg, abs=0.003)
    for column, values, lsb in ((0, part.on_deg, 360.0 / 256.0), (1, part.off_deg, 360.0 / 256.0),
                                (2, np.clip(part.ripple, -0.25, 223.0 / 128.0) + 0.25, 1.0 / 128.0)):
        assert tables.partial[..., column] * lsb == pytest.approx(values, abs=0.501 * lsb)
    lsb_Wb = math.ldexp(1.0, exponents.voltage - 13)
    assert tables.braking_flux * lsb_Wb == pytest.approx(of.braking_flux_Wb, abs=0.501 * lsb_Wb)


@pytest.mark.in_turns
def test_index_of_a_machine_that_is_slow_for_its_voltage_fits(tmp_path: Path):
    """Its points are further apart than its speeds are."""
    text = (MACHINES / "saturating.toml").read_text()
    assert text.count("speed_base_rpm = 1500.0") == 1
    path = tmp_path / "slow.toml"
    path.write_text(text.replace("speed_base_rpm = 1500.0", "speed_base_rpm = 20.0"))
    machine = load_machine(path)
    scaling = scaling_of(path, machine)
    tables = pulse_tables(machine, scaling, sharing_window(machine, scaling.data))
    assert tables.index_scale == (1 << 31) - 1
    last = 2.0**28 / tables.index_scale
    of = single_pulse(machine, scaling.data, last)
    assert of.speed_per_voltage[-1] == last > single_pulse(machine, scaling.data).speed_per_voltage[-1]
    assert abs(index_q8(tables, scaling.exponents, last * 240.0, 240.0) - 4096) <= 1


def test_what_exceeds_a_format_is_its_largest_value():
    of = pulses("finite_element")
    beyond = replace(of, mean_Nm=of.mean_Nm + 1000.0, end_deg=of.end_deg + 180.0, lead_deg=of.lead_deg - 300.0,
                     braking_flux_Wb=of.braking_flux_Wb + 8.0)
    far = PartialPulse(*(np.full((2, len(PARTS), POINTS), value) for value in (-200.0, 200.0, 2.5)))
    tables = in_units(beyond, far, Exponents())
    assert np.all(tables.partial == [-128, 128, 255])
    assert np.all(tables.pulse[..., 3] == 65535) and np.all(tables.pulse[..., 1] == 32768)
    assert np.all(tables.pulse[..., 0] == 0) and np.all(tables.braking_flux == 65535)
