"""Device drops and a DC link charged by regeneration: the plant compared with an independent integration.

The reference has the magnetics of reference_plant.py; SciPy's DOP853 integrates flux linkages, speed, angle and
DC-link voltage from event to event: a flux linkage that reaches zero, the supply's rectifier, the chopper's comparator.
Measured on x86-64 with gcc 12: at most 1.5e-7 of the largest magnitude.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable

import numpy as np
import pytest
from reference_plant import (
    Compares,
    Converter,
    DcLink,
    Machine,
    Reference,
    Run,
    State,
    load_library,
    pattern,
    plant_of,
    set_switches,
    stop_at,
)
from scipy.integrate import solve_ivp
from test_plant_against_scipy import machine_of

PHASES = 3
FULL = 2500
PERIODS = 1200
BOUND = 1e-6
FORMS = ("linear_cosine", "saturating")


def drive_with_link(form: str) -> Machine:
    machine = machine_of(form, inertia_kg_m2=0.005)
    machine.converter = Converter(1.2, 0.015, 0.8, 0.01, 0.0)
    machine.dc_link = DcLink(0.3e-3, 0.4, 8.0, 262.0, 252.0)
    return machine


def law(period: int, angle_deg: float, currents_A: list[float], rising: list[bool]) -> Compares:
    """Motoring to period 500, then braking by chopping, so that current flows back into the link."""
    upper, lower = [0] * PHASES, [0] * PHASES
    braking = period >= 500
    for phase in range(PHASES):
        at_deg = (angle_deg - 30.0 * phase) % 90.0
        rising[phase] = currents_A[phase] < (24.0 if rising[phase] else 21.0)
        if (3.0 if braking else 46.0) <= at_deg < (33.0 if braking else 74.0):
            upper[phase] = FULL if rising[phase] or not braking else 0
            lower[phase] = 2300 if rising[phase] else 0
    return upper, lower


def run_plant(library: ctypes.CDLL, machine: Machine) -> tuple[Run, np.ndarray, State]:
    """Run of the plant, with its pattern; rows: speed, angle, DC-link voltage, currents at each period's start."""
    compares: list[Compares] = []
    run = Run(FULL, compares, speed_rad_s=60.0, angle_deg=50.0, load_torque_Nm=3.0)
    rows, rising, state = [], [True] * PHASES, State()

    def read(plant: int) -> None:
        library.plant_library_read(plant, ctypes.byref(state))
        rows.append([state.speed_rad_s, state.rotor_angle_rad, state.bus_voltage_V, *state.current_A[:PHASES]])

    with plant_of(library, machine, run) as plant:
        read(plant)
        for period in range(PERIODS):
            compares.append(law(period, math.degrees(state.rotor_angle_rad), rows[-1][3:], rising))
            set_switches(library, plant, compares[-1], FULL)
            library.plant_advance(plant, (period + 1) * run.period_ns)
            read(plant)
    return run, np.array(rows), state


class LinkReference:
    """State: flux linkages, speed, angle, DC-link voltage."""

    def __init__(self, machine: Machine, run: Run) -> None:
        self.magnetics, self.machine, self.run = Reference(machine), machine, run
        self.chopper_on = False
        self.y = np.array([0.0] * PHASES + [run.speed_rad_s, math.radians(run.angle_deg), machine.supply_voltage_V])
        self.chopped_s = self.sourced_s = 0.0

    def currents(self, y: np.ndarray) -> list[float]:
        shapes = [self.magnetics.shape(self.magnetics.phase_angle(y[-2], phase))[0] for phase in range(PHASES)]
        return [self.magnetics.current(f, flux) for f, flux in zip(shapes, y[:PHASES], strict=True)]

    def right_side(self, on: list[int], conducts: list[bool], source: bool) -> Callable[[float, np.ndarray], list]:
        machine, link, converter = self.machine, self.machine.dc_link, self.machine.converter
        chopper_S = 1.0 / link.chopper_resistance_ohm if self.chopper_on else 0.0

        def rates(_: float, y: np.ndarray) -> list[float]:
            fluxes, torque_Nm = [0.0] * PHASES, 0.0
            drawn_A = chopper_S * y[-1]
            for phase in range(PHASES):
                if not conducts[phase]:
                    continue
                f, slope = self.magnetics.shape(self.magnetics.phase_angle(y[-2], phase))
                i = self.magnetics.current(f, y[phase])
                switches = on[phase] * (converter.switch_drop_V + converter.switch_resistance_ohm * i)
                diodes = (2 - on[phase]) * (converter.diode_drop_V + converter.diode_resistance_ohm * i)
                fluxes[phase] = (on[phase] - 1) * y[-1] - switches - diodes - machine.resistance_ohm * i
                drawn_A += (on[phase] - 1) * i
                torque_Nm += self.magnetics.torque(slope, i)
            sourced_A = (machine.supply_voltage_V - y[-1]) / link.source_resistance_ohm if source else 0.0
            drag_Nm = machine.friction_Nm_s * y[-3] + self.run.load_torque_Nm
            return [*fluxes, (torque_Nm - drag_Nm) / machine.inertia_kg_m2, y[-3],
                    (sourced_A - drawn_A) / link.capacitance_F]

        return rates

    def advance(self, on: list[int], length_s: float) -> None:
        link, supply_V = self.machine.dc_link, self.machine.supply_voltage_V
        at_s = 0.0
        while at_s < length_s:
            y = self.y
            if y[-1] >= link.chopper_on_V - 1e-9:
                self.chopper_on = True
            elif y[-1] <= link.chopper_off_V + 1e-9:
                self.chopper_on = False
            conducts = [y[phase] > 0.0 or on[phase] == 2 for phase in range(PHASES)]
            currents = self.currents(y)
            drawn_A = sum((on[phase] - 1) * currents[phase] for phase in range(PHASES))
            drawn_A += y[-1] / link.chopper_resistance_ohm if self.chopper_on else 0.0
            source = y[-1] < supply_V - 1e-9 or (y[-1] <= supply_V + 1e-9 and drawn_A >= 0.0)
            stops = [stop_at(PHASES + 1, self.magnetics.next_corner(y[PHASES + 1], 1))]
            ends = [phase for phase in range(PHASES) if conducts[phase] and on[phase] < 2]
            stops += [stop_at(phase, 0.0) for phase in ends]
            voltages = [link.chopper_off_V if self.chopper_on else link.chopper_on_V, supply_V]
            for voltage_V, falling in zip(voltages, (self.chopper_on, not source), strict=True):
                stop = stop_at(PHASES + 2, voltage_V)
                stop.direction = -1.0 if falling else 1.0  # type: ignore[attr-defined]
                stops.append(stop)
            solution = solve_ivp(self.right_side(on, conducts, source), (at_s, length_s), y, "DOP853", rtol=1e-11,
                                 atol=1e-12, events=stops)
            self.y = solution.y[:, -1]
            for phase, times in zip(ends, solution.t_events[1:], strict=False):
                if len(times) > 0:
                    self.y[phase] = 0.0
            step_s = solution.t[-1] - at_s
            self.chopped_s += step_s if self.chopper_on else 0.0
            self.sourced_s += step_s if source else 0.0
            at_s = solution.t[-1]

    def row(self) -> list[float]:
        return [*self.y[PHASES:], *self.currents(self.y)]


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    return load_library()


@pytest.mark.parametrize("form", FORMS)
def test_motoring_and_braking_on_a_dc_link_agree(library: ctypes.CDLL, form: str) -> None:
    machine = drive_with_link(form)
    run, measured, state = run_plant(library, machine)
    reference = LinkReference(machine, run)
    expected = [reference.row()]
    for upper, lower in run.compares:
        for start_ns, end_ns, on in pattern(run, upper, lower):
            reference.advance(on, (end_ns - start_ns) * 1e-9)
        expected.append(reference.row())
    expected_rows = np.array(expected)

    # The run covers a sagging and a charged DC link, an active chopper, and a blocking supply.
    bus_V = expected_rows[:, 2]
    assert np.min(bus_V) < 238.0 and np.max(bus_V) > 255.0
    assert reference.chopped_s > 1e-4
    assert 0.001 < reference.sourced_s < PERIODS * run.period_ns * 1e-9 - 0.001
    assert state.energy_returned_J > state.energy_chopper_J > 0.1

    magnitude = np.max(np.abs(expected_rows), axis=0)
    magnitude[0] = np.ptp(expected_rows[:, 0])
    magnitude[2] = np.ptp(bus_V)
    magnitude[3:] = np.max(magnitude[3:])
    worst = np.max(np.abs(measured - expected_rows), axis=0) / magnitude
    assert np.max(worst) < BOUND, worst
