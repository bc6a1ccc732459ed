"""The emulated plant compared with an independent integration of the same equations (reference_plant.py), bundled
machines.

Deviations are relative to the largest magnitude of the quantity in the run (speed: to its change). Measured on x86-64
with gcc 12: at most 9e-7 (the speed in the chopping of the saturating machine), also for samples within steps.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import replace

import numpy as np
import pytest
from reference_plant import (
    FORMS,
    PHASES_MAX,
    TICK_NS,
    Compares,
    Machine,
    Magnetics,
    Run,
    State,
    Trace,
    load_library,
    plant_of,
    run_plant,
    run_reference,
    set_switches,
)

pytestmark = pytest.mark.in_turns

PHASES = 3


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    return load_library()


def machine_of(form: str, inertia_kg_m2: float = 0.02) -> Machine:
    saturating = form == "saturating"
    trapezoid = form == "linear_trapezoid"
    return Machine(
        name=form.encode(),
        stator_poles=6,
        rotor_poles=4,
        phases=PHASES,
        resistance_ohm=0.05,
        inertia_kg_m2=inertia_kg_m2,
        friction_Nm_s=0.02,
        supply_voltage_V=240.0,
        magnetics=Magnetics(
            form=FORMS.index(form),
            unaligned_inductance_H=0.67e-3 if saturating else 0.676e-3,
            aligned_inductance_H=23.6e-3,
            flat_deg=1.0 if trapezoid else 0.0,
            blend_deg=2.0 if trapezoid else 0.0,
            saturated_inductance_H=0.15e-3 if saturating else 0.0,
            flux_linkage_max_Wb=0.486 if saturating else 0.0,
            current_at_flux_linkage_max_A=450.0 if saturating else 0.0,
        ),
    )


# --- The runs ---


def start_from_standstill(library: ctypes.CDLL, machine: Machine) -> Run:
    """Several strokes from rest, phases on from 45 to 75 degrees, current held near 35 A by hysteresis at 40 kHz.
    The switching pattern is recorded on the plant and applied to both sides. A light rotor makes 40 ms sufficient."""
    full, low_A, high_A = 2500, 32.0, 38.0
    run = Run(full, [], speed_rad_s=0.0, angle_deg=50.0, load_torque_Nm=1.0)
    compares: list[Compares] = []
    rising = [True] * PHASES

    def law(state: State) -> Compares:
        upper, lower = [0] * PHASES, [0] * PHASES
        for phase in range(PHASES):
            angle_deg = (math.degrees(state.rotor_angle_rad) - 30.0 * phase) % 90.0
            rising[phase] = state.current_A[phase] < (high_A if rising[phase] else low_A)
            if 45.0 <= angle_deg < 75.0:
                upper[phase] = full
                lower[phase] = full if rising[phase] else 0
        compares.append((upper, lower))
        return compares[-1]

    with plant_of(library, machine, run) as plant:
        state = State()
        for period in range(1600):
            library.plant_library_read(plant, ctypes.byref(state))
            set_switches(library, plant, law(state), full)
            library.plant_advance(plant, (period + 1) * run.period_ns)
    return replace(run, compares=compares)


def chopping_stroke() -> Run:
    """A stroke at 150 r/min: 40 kHz, both switches of phase A with partial duty, so that two pulses and two
    freewheels lie within each period, while phase C's current is driven to zero within each period by its diodes."""
    full = 2500
    compares: list[Compares] = []
    for period in range(120):
        upper, lower = [0] * PHASES, [0] * PHASES
        if period < 8:
            upper[0], lower[0] = full, full
        elif period < 100:
            upper[0], lower[0] = 2000 + 3 * period, 400 + (37 * period) % 200
        if 10 <= period < 60:
            upper[2], lower[2] = 1801, 1202
        elif 60 <= period < 90:
            upper[2] = 333
        compares.append((upper, lower))
    return Run(full, compares, speed_rad_s=15.7, angle_deg=55.0, load_torque_Nm=8.0)


def single_pulse(full: int = 2500, driven_ns: int = 850_000) -> Run:
    """One pulse of 12 degrees from 45 degrees on, at 2390 r/min, then the diodes until the current ends."""
    driven = driven_ns // (2 * full * TICK_NS)
    compares = [([full, 0, 0], [full, 0, 0])] * driven + [([0] * PHASES, [0] * PHASES)] * (2 * driven)
    return Run(full, compares, speed_rad_s=250.0, angle_deg=45.0, load_torque_Nm=2.0)


def run_of(library: ctypes.CDLL, name: str, form: str) -> tuple[Machine, Run]:
    if name == "start":
        machine = machine_of(form, inertia_kg_m2=0.005)
        return machine, start_from_standstill(library, machine)
    return machine_of(form), {"chopping": chopping_stroke, "single_pulse": single_pulse}[name]()


def deviation(measured: Trace, expected: Trace) -> dict[str, float]:
    """Largest deviation of each quantity relative to its largest magnitude; speed relative to its change."""
    assert np.array_equal(measured["time_ns"], expected["time_ns"])
    worst = {}
    for name in ("speed", "torque", "currents"):
        magnitude = np.ptp(expected[name]) if name == "speed" else np.max(np.abs(expected[name]))
        worst[name] = float(np.max(np.abs(measured[name] - expected[name])) / magnitude)
    return worst


# --- The tests ---

NAMES = ("start", "chopping", "single_pulse")
BOUND = 2e-6
SAMPLE_BOUND = 3e-6  # cubic interpolation between the ends of a step


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", NAMES)
def test_currents_torque_and_speed_agree(library: ctypes.CDLL, name: str, form: str) -> None:
    machine, run = run_of(library, name, form)
    expected, ends = run_reference(machine, run)
    measured, _ = run_plant(library, machine, run)
    assert np.max(expected["currents"]) > 10.0
    assert len(ends) >= 1, "the run is to contain an end of conduction"
    worst = deviation(measured, expected)
    assert max(worst.values()) < BOUND, worst


@pytest.mark.parametrize("form", FORMS)
def test_conduction_ends_at_the_same_nanosecond(library: ctypes.CDLL, form: str) -> None:
    machine, state, run = machine_of(form), State(), single_pulse()
    _, ends = run_reference(machine, run)
    ((phase, end_ns),) = ends
    assert phase == 0
    with plant_of(library, machine, run) as plant:
        for period, compares in enumerate(run.compares):
            set_switches(library, plant, compares, run.period_ticks)
            start_ns = period * run.period_ns
            if start_ns <= end_ns < start_ns + run.period_ns:
                library.plant_advance(plant, math.floor(end_ns) - 1)
                library.plant_library_read(plant, ctypes.byref(state))
                assert state.current_A[phase] > 0.0
                library.plant_advance(plant, math.ceil(end_ns) + 1)
                library.plant_library_read(plant, ctypes.byref(state))
                assert state.current_A[phase] == 0.0
            library.plant_advance(plant, start_ns + run.period_ns)
        library.plant_library_read(plant, ctypes.byref(state))
        assert list(state.current_A) == [0.0] * PHASES_MAX


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", ["chopping", "single_pulse"])
def test_samples_within_steps_agree_and_leave_the_run_unchanged(library: ctypes.CDLL, name: str, form: str) -> None:
    machine, run = run_of(library, name, form)
    expected, _ = run_reference(machine, run, sample_ns=1000)
    measured, watched = run_plant(library, machine, run, sample_ns=1000)
    worst = deviation(measured, expected)
    assert max(worst.values()) < SAMPLE_BOUND, worst
    _, unwatched = run_plant(library, machine, run)
    assert bytes(watched) == bytes(unwatched)


@pytest.mark.parametrize("form", FORMS)
def test_error_falls_with_the_fourth_power_of_the_step(library: ctypes.CDLL, form: str) -> None:
    # Long periods, so that the step limits determine the step, not the switch edges.
    machine, run = machine_of(form), single_pulse(full=40_000, driven_ns=800_000)
    expected, _ = run_reference(machine, run)
    # Over four halvings: the number of whole steps between two switch edges makes each of them irregular.
    coarse, fine = (
        max(deviation(run_plant(library, machine, run, factor)[0], expected).values()) for factor in (8, 0.5)
    )
    assert 3.4 < math.log(coarse / fine, 16) < 4.5, (coarse, fine)
