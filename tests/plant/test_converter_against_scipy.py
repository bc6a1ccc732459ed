"""Device drops and a DC link charged by regeneration: the plant compared with an independent integration.

The reference has the magnetics of reference_plant.py; SciPy's DOP853 integrates flux linkages, speed, angle and
DC-link voltage from event to event: a flux linkage that reaches zero, the supply's rectifier, the chopper's comparator.
Measured on x86-64 with gcc 12: at most 1.5e-7 of the largest magnitude.
"""

from __future__ import annotations

import ctypes
import math

import numpy as np
import pytest
from link_reference import LinkReference
from reference_plant import (
    Compares,
    Converter,
    DcLink,
    Machine,
    Run,
    State,
    load_library,
    plant_of,
    set_switches,
)
from test_plant_against_scipy import machine_of

pytestmark = pytest.mark.in_turns

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


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    return load_library()


@pytest.mark.parametrize("form", FORMS)
def test_motoring_and_braking_on_a_dc_link_agree(library: ctypes.CDLL, form: str) -> None:
    machine = drive_with_link(form)
    run, measured, state = run_plant(library, machine)
    reference = LinkReference(machine, run)
    expected = [reference.row()]
    for period in range(PERIODS):
        reference.advance_period(period)
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
